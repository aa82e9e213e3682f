"""Replays of recordings that the project simulates itself, with known parameters."""

import json
from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.robots import load_robot
from gaitgauge.robots.sets import joint_groups
from gaitgauge.studies.reality.chirp import Chirp, simulated_log
from gaitgauge.studies.reality.log import LogError, save_log
from gaitgauge.studies.reality.replaying import fit_delay, replay
from gaitgauge.studies.reality.request import ReplayRequest
from gaitgauge.studies.reality.residuals import Squares, by_band, noise, spectrum
from gaitgauge.studies.reality.rig import FixedRig, acting_parameters, at_rows, beginning, held_targets, num_steps, play

GO2 = load_robot("go2", check=False)
TRUTH = replace(GO2.parameters["gauge"], armature=(0.03,) * 12, delay=0.0065, target_offset=(0.02,) * 12)


@pytest.fixture(scope="module")
def log():
    return simulated_log(GO2, TRUTH, chirp=Chirp(seconds=2.0, last=4.0))


def test_held_targets_are_means_over_steps_and_shift_by_the_delay(log):
    even = replace(log, time=np.arange(4) * 0.002, target=np.array([[0.0], [1.0], [3.0], [3.0]]) * np.ones(12))
    np.testing.assert_allclose(held_targets(even, 0.0, 3)[:, 0], [0.0, 1.0, 3.0])
    np.testing.assert_allclose(held_targets(even, 0.001, 3)[:, 0], [0.0, 0.5, 2.0], atol=1e-12)
    np.testing.assert_allclose(held_targets(even, 0.003, 3)[:, 0], [0.0, 0.0, 0.5], atol=1e-12)
    each = held_targets(even, np.linspace(0.0, 0.003, 12), 3)
    np.testing.assert_allclose(each[:, 0], held_targets(even, 0.0, 3)[:, 0], atol=1e-12)
    np.testing.assert_allclose(each[:, -1], held_targets(even, 0.003, 3)[:, 0], atol=1e-12)


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("newton", marks=pytest.mark.slow)])
def test_a_heavy_trunk_in_an_engine_is_a_fixed_trunk(log, engine):
    short = log.cut(0.0, 0.4 if engine == "newton" else 1.3)  # past the first rehanging
    parameters = GO2.parameters["gauge"]
    motion = play(short, parameters, engine=engine)
    rig = FixedRig(GO2, parameters, threads=1)
    acting = acting_parameters(short, parameters)
    fixed = at_rows(
        short, rig.run([acting], held_targets(short, 0.0, num_steps(short))[None], [beginning(short)])[:, 0]
    )
    tolerance = 2e-3 if engine == "newton" else 1e-4
    np.testing.assert_allclose(motion.position, fixed[0], atol=tolerance)
    np.testing.assert_allclose(motion.torque, fixed[2], atol=100 * tolerance)


def test_true_parameters_replay_to_the_noise_and_others_do_not(log, tmp_path):
    save_log(log, tmp_path / "log.npz")
    (tmp_path / "true.toml").write_text(
        'robot = "go2"\n[parameters.true]\nstiffness = 20.0\ndamping = 0.5\ntorque_limit = 30.0\narmature = 0.03\n'
        'joint_damping = 0.1\nfriction_loss = 0.2\ndelay = 0.0065\ntarget_offset = 0.02\nmeasured = "a test"\n',
        encoding="utf-8",
    )
    request = ReplayRequest(logs=(tmp_path / "log.npz",), parameters=("gauge", f"{tmp_path}/true.toml"))
    results = replay(request, tmp_path / "out")
    nominal, true = results["logs"][0]["variants"]
    for group in ("hip", "thigh", "calf"):
        found = true["groups"][group]["position"]
        assert found["rms"] == pytest.approx(1e-3, rel=0.25)  # the noise of the recording
        assert found["interval"][0] < found["rms"] < found["interval"][1]
        assert found["ratio"]["value"] < 0.3 and found["ratio"]["interval"][1] < 0.5
        assert nominal["groups"][group]["lead"] > 0.003  # nominal motors are early by the delay
        assert results["logs"][0]["floor"]["groups"][group]["position"] == pytest.approx(1e-3, rel=0.3)
    page = (tmp_path / "out" / "replay.html").read_text(encoding="utf-8")
    assert "polyline" in page and "FL_hip_joint" in page
    assert json.loads((tmp_path / "out" / "replay.json").read_text(encoding="utf-8"))["robot"] == "go2"


def test_a_delay_is_found_to_half_a_step(log):
    assert fit_delay(log, replace(TRUTH, delay=0.0), threads=1) == pytest.approx(0.0065, abs=5e-4)


def test_a_standing_robot_stands(log):
    still = replace(log, target=np.tile(GO2.default_joint_position, (len(log.time), 1)), held="standing").cut(0.0, 0.3)
    motion = play(still, GO2.parameters["gauge"])
    weight = 15.2 * 9.81
    assert np.abs(motion.velocity[-1]).max() < 0.5
    assert np.abs(motion.torque[-1]).sum() > weight * 0.05  # legs carry the robot
    with pytest.raises(LogError, match="of a standing robot"):
        fit_delay(still, GO2.parameters["gauge"])


def test_figures_of_known_errors(log):
    error = np.zeros_like(log.position)
    error[:, 2] = 0.01 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 3.0 * log.time)
    joints = joint_groups(GO2)["calf"]
    assert joints == [2, 5, 8, 11]
    assert Squares(log, error).rms([2]) == pytest.approx(0.01, rel=0.01)
    assert Squares(log, error).rms(joints) == pytest.approx(0.005, rel=0.01)
    bands = by_band(*spectrum(log, error), [2])
    assert bands[2] == pytest.approx(0.01, rel=0.05) and max(bands[0], bands[4]) < 0.002
    assert noise(log, joints)["velocity"] == pytest.approx(0.05, rel=0.1)
