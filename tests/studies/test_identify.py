"""Identification of robots that the project simulates itself, with known constants."""

import json
from dataclasses import replace

import identification_coverage as coverage
import numpy as np
import pytest
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.sets import find_set
from gaitgauge.studies.reality.chirp import Chirp, simulated_log
from gaitgauge.studies.reality.identification import _Problem, identify
from gaitgauge.studies.reality.identifying import identify_robot
from gaitgauge.studies.reality.log import LogError, save_log
from gaitgauge.studies.reality.request import IdentifyRequest

GO2 = load_robot("go2", check=False)
NOMINAL = GO2.parameters["gauge"]


@pytest.fixture(scope="module")
def log():
    truth = coverage.random_robot(GO2, 3)
    return simulated_log(GO2, truth, chirp=Chirp(seconds=1.5, last=4.0), noise=(1e-4, 0.01, 0.02))


@pytest.mark.slow
def test_known_constants_lie_inside_their_intervals():
    found = coverage.identify_draw(0, seconds=4.0)
    assert np.mean(list(found["inside"].values())) > 0.85
    assert max(found["delay_error"]) < coverage.HALF_STEP


@pytest.mark.slow
def test_a_log_becomes_a_set_that_replays_it(log, tmp_path):
    save_log(log, tmp_path / "log.npz")
    results = identify_robot(IdentifyRequest(logs=(tmp_path / "log.npz",), draws=20), tmp_path / "out")
    for group in results["logs"][0]["ratios"].values():
        assert group["position"] < 0.3 and group["torque"] < 0.3
    name, found = find_set(GO2, str(tmp_path / "out" / "identified.toml"))
    assert name == "identified" and "log.npz (kp 25, kd 1)" in found.measured
    truth = coverage.random_robot(GO2, 3)
    assert found.delay == pytest.approx(truth.delay, abs=coverage.HALF_STEP)
    assert found.armature[2] == pytest.approx(truth.armature[2], rel=0.3)
    assert any("one kd" in note for note in results["notes"])
    assert json.loads((tmp_path / "out" / "identify.json").read_text(encoding="utf-8"))["base"] == "gauge"
    assert "armature calf" in (tmp_path / "out" / "identify.html").read_text(encoding="utf-8")
    with pytest.raises(RobotError, match="not for 'go1'"):
        find_set(load_robot("go1", check=False), str(tmp_path / "out" / "identified.toml"))


def test_joints_of_a_kind_are_alike_beforehand(log):
    problem = _Problem([log], NOMINAL, 1)
    problem.rig.close()
    labels = [unknown.label for unknown in problem.unknowns]
    covariance = np.linalg.inv(problem.precision(np.arange(len(labels))))
    hip, other = labels.index("stiffness_factor FL_hip"), labels.index("stiffness_factor RR_hip")
    assert covariance[hip, other] == pytest.approx(0.1**2)
    assert covariance[hip, hip] == pytest.approx(0.1**2 + 0.02**2)
    for apart in ("stiffness_factor FL_calf", "damping_factor RR_hip", "armature hip"):
        assert covariance[hip, labels.index(apart)] == pytest.approx(0.0, abs=1e-12)


def test_what_a_log_does_not_tell_stays_at_its_prior(log):
    still = replace(log, target=np.tile(log.target[0], (len(log.time), 1)), torque=None).cut(0.0, 0.6)
    rest = np.tile(log.position[0], (len(still.time), 1))
    noise = np.random.default_rng(0).normal(0.0, 1e-3, rest.shape)
    still = replace(still, position=rest + noise, fresh=np.ones(len(rest), dtype=bool))
    found = identify([still], NOMINAL, draws=20, threads=1)
    told = {u.label: bool(known) for u, known in zip(found.unknowns, found.known, strict=True)}
    assert not told["armature calf"] and not told["stiffness_factor FL_hip"]
    assert found.parameters.armature == NOMINAL.armature
    assert all(
        u.kind.low <= low < high <= u.kind.high for u, (low, high) in zip(found.unknowns, found.intervals, strict=True)
    )


def test_standing_robots_and_odd_names_are_refused(log, tmp_path):
    with pytest.raises(LogError, match="of a standing robot"):
        identify([replace(log, held="standing")], NOMINAL)
    save_log(log, tmp_path / "log.npz")
    with pytest.raises(LogError, match="--name is 'a b'"):
        identify_robot(IdentifyRequest(logs=(tmp_path / "log.npz",), name="a b"), tmp_path / "out")
