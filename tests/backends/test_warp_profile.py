"""The profile of the mujoco-warp engine: its cases, its terrains, and one small run on the CPU."""

import json
from dataclasses import replace

import numpy as np
import pytest
import solver_speed
import warp_profile as profile
from gaitgauge.terrains.training_tiles import make_tile


def test_every_scene_is_measured_and_shares_sum_to_one():
    cases = profile.standard_cases()
    assert {c.scene for c in cases} == set(profile.SCENES)
    for name in profile.SCENES:
        terrains, shares = profile.make_ground(name, None)
        assert len(terrains) == len(shares)
        assert shares.sum() == pytest.approx(1.0)
        has_field = [t.height_field is not None for t in terrains]
        assert any(has_field) == (name not in ("gauge-boxes", "tiles-boxes"))
        assert all(has_field) == (name in ("gauge-wave", "tiles-fields"))


def test_a_coarser_field_has_its_nodes_on_the_old_surface():
    tile = make_tile("wave", 5)
    coarse = profile.respaced(tile, 0.4)
    assert coarse.height_field.heights.shape == (29, 29)
    assert np.allclose(coarse.height_field.heights, tile.height_field.heights[::4, ::4])
    assert profile.respaced(tile, 0.05).height_field.heights.shape == (225, 225)


def test_only_iterations_and_tolerance_change_without_a_new_scene():
    case = profile.standard_cases()[0]
    assert not profile.needs_new_scene(case, replace(case, iterations=7, tolerance=1e-3))
    assert profile.needs_new_scene(None, case)
    for change in ({"worlds": 3}, {"cone": "pyramidal"}, {"ls_iterations": 5}, {"scene": "gauge-wave"}):
        assert profile.needs_new_scene(case, replace(case, **change))


@pytest.mark.parametrize(
    ("name", "short"),
    [
        ("_solve_done__locals__kernel_0a1b2c3d_cuda_kernel_forward", "_solve_done"),
        ("motor_law_6f7e8d9c_cuda_kernel_forward", "motor_law"),
        ("forward kernel _nxn_broadphase", "_nxn_broadphase"),
        ("Memset (Device)", "Memset (Device)"),
    ],
)
def test_kernel_names_lose_what_tells_variants_apart(name, short):
    assert profile.short_name(name) == short


@pytest.mark.slow
def test_a_small_run_on_the_cpu_times_steps_and_kernels(tmp_path, capsys):
    out = tmp_path / "profile.json"
    arguments = ["--device", "cpu", "--worlds-scale", "0.001", "--steps", "2", "--walk", "2", "--out", str(out)]
    profile.main([*arguments, "--scene", "gauge-wave", "tiles-mix", "--cases", "3", "--time", "300"])
    rows = json.loads(out.read_text())["rows"]
    assert [r["case"]["scene"] for r in rows] == ["tiles-mix", "tiles-mix", "tiles-mix"]
    for row in rows:
        assert row["milliseconds"] > 0.0
        assert 1 <= row["iterations_mean"] <= row["iterations_largest"] <= 10
    names = {k["name"]: k for k in rows[0]["kernels"]["kernels"]}
    assert names["motor_law"]["launches"] == 1.0
    assert any("solve_kernel" in name for name in names)
    assert "kernels of one substep" in capsys.readouterr().out


@pytest.mark.slow
def test_cases_that_do_not_fit_into_the_time_are_named(tmp_path, capsys):
    arguments = ["--device", "cpu", "--worlds-scale", "0.001", "--steps", "1", "--walk", "1", "--scene", "gauge-wave"]
    profile.main([*arguments, "--time", "-1", "--out", str(tmp_path / "profile.json")])
    assert "left out for lack of time: gauge-wave, 3 worlds" in capsys.readouterr().out


@pytest.mark.slow
def test_solvers_are_compared_on_the_cpu(tmp_path, monkeypatch, capsys):
    out = tmp_path / "solver.json"
    arguments = ["--device", "cpu", "--worlds", "6", "--steps", "1", "--walk", "4", "--contacts", "training", "cones"]
    monkeypatch.setattr("sys.argv", ["solver_speed.py", *arguments, "--out", str(out)])
    monkeypatch.setattr(solver_speed.solver, "solve", solver_speed.solver.solve)  # put back afterwards
    solver_speed.main()
    assert "one kernel" in capsys.readouterr().out
    for row in json.loads(out.read_text()):
        assert row["known"] == row["repeats"] == 1.0
        assert row["rows"] > 12.0
        assert row["acceleration, most"] < 1e-4
        assert row["states that differ"] == row["iterations that differ"] == 0.0
