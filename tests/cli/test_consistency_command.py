"""``gaitgauge consistency`` as a user runs it."""

import json

import pytest
import torch
from gaitgauge.backends import BackendError, make_backend
from gaitgauge.studies.consistency import open_loop, variants

SUITE = """
extends = "robogauge-1.1"
name = "tiny"
title = "a second"
goals = [{ name = "max_velocity", phases = [0.1, 0.04] }, { name = "target_pos_velocity", phases = [] }]
[matrix]
frictions = [0.6]
[settling]
longest = 0.1
[scoring]
bootstrap = 50
[metrics]
interval = 20
"""


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(SUITE)
    return path


def test_two_settings_of_the_c_engine(run, refused, tmp_path, policy, tiny, monkeypatch):
    monkeypatch.setattr(open_loop, "DURATION", 0.3)
    out = tmp_path / "study"
    command = (
        "consistency",
        policy,
        "--backends",
        "mujoco,mujoco@timestep=0.005",
        "--suite",
        tiny,
        "--terrain",
        "flat",
    )
    command += ("--seeds", 2, "--threads", 1, "--factor", "timestep-5ms", "--out", out)
    done = run(*command, "--json")
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout)
    assert printed == json.loads((out / "consistency.json").read_text())
    assert printed["reference"] == "mujoco"
    row = printed["policies"][0]["attribution"][0]
    # the reference with the compared engine's timestep is the compared engine
    assert row["to"]["mujoco@timestep=0.005"]["gap_after"] == 0.0
    assert "<html" in (out / "consistency.html").read_text()

    assert "--resume" in refused(*command)
    again = run(*command, "--resume")
    assert again.exit_code == 0, again.output
    for words in ("models: the largest difference from mujoco", "open loop", "closed loop", "attribution", "gap"):
        assert words in again.stdout
    assert "mujoco – mujoco@timestep=0.005" in again.stdout
    assert str(out / "consistency.html") in again.stdout.replace("\n", "")


def test_an_engine_that_is_left_out_is_told(run, tmp_path, policy, tiny, monkeypatch):
    monkeypatch.setattr(open_loop, "DURATION", 0.3)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)

    def make(name, scene, **options):
        if scene.physics.cone == "pyramidal":
            raise BackendError("it knows no pyramids")
        return make_backend(name, scene, **options)

    monkeypatch.setattr(variants, "make_backend", make)
    engines = "mujoco,mujoco-warp,mujoco@timestep=0.005,mujoco@cone=pyramidal"
    command = (
        "consistency",
        policy,
        "--backends",
        engines,
        "--suite",
        tiny,
        "--terrain",
        "flat",
        "--seeds",
        2,
        "--threads",
        1,
    )
    for more in ((), ("--resume", "--json")):
        done = run(*command, "--out", tmp_path / "study", *more)
        assert done.exit_code == 0, done.output
        assert "mujoco-warp is left out" in done.stderr
        assert "6 runs of 2 episodes take about" in done.stderr  # three engines, three draws of the floor
        assert "in all it would take with --attribution about" in done.stderr and "--seeds 10 about" in done.stderr
        told = done.stderr if more else done.stdout
        assert "mujoco@cone=pyramidal is left out: it knows no pyramids" in told
        assert more or "mujoco-warp is left out" in done.stdout


def test_bad_input_is_one_sentence(refused, policy, tmp_path):
    out = ("--out", tmp_path / "none")
    assert "two engines" in refused("consistency", policy, "--backends", "mujoco", *out)
    for command, option in (("consistency", "--backends"), ("jury", "--engines")):
        assert "'' names no engine" in refused(command, policy, option, "", *out)
    assert "unknown backend 'nonsense'" in refused("consistency", policy, "--backends", "mujoco,nonsense", *out)
    assert "@option=value" in refused("consistency", policy, "--backends", "mujoco,mujoco@speed=1", *out)
    assert "--seeds" in refused("consistency", policy, "--backends", "mujoco,mujoco@cone=pyramidal", "--seeds", 1, *out)
    flat = ("--backends", "mujoco,mujoco@cone=pyramidal", "--terrain", "flat")
    assert "no levels" in refused("consistency", policy, *flat, "--level", 2, *out)
    assert "missing.pt" in refused("consistency", "missing.pt", "--backends", "mujoco,mujoco@cone=pyramidal", *out)
    assert not (tmp_path / "none").exists()
