"""Preflight: logs of simulated robots with one mistake each."""

from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from gaitgauge.studies.reality.acting_delay import acting_delay
from gaitgauge.studies.reality.chirp import Chirp, simulated_log
from gaitgauge.studies.reality.log import LogError, save_log
from gaitgauge.studies.reality.preflight import checks, preflight
from gaitgauge.studies.reality.request import PreflightRequest
from scipy.spatial.transform import Rotation

GO2 = load_robot("go2", check=False)


@pytest.fixture(scope="module")
def contract():
    return load_policy("pretrained").contract


@pytest.fixture(scope="module")
def log(contract):
    gains = {"stiffness": contract.stiffness[0], "damping": contract.damping[0]}
    truth = replace(GO2.parameters["gauge"], delay=0.004)
    made = simulated_log(GO2, truth, chirp=Chirp(seconds=2.0, last=2.0), **gains)
    angles = np.stack([0.1 * np.sin(2 * np.pi * f * made.time) for f in (0.7, 1.1, 0.9)], axis=1)
    turns = Rotation.from_rotvec(angles)
    rate = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(made.time)[:, None]
    gyro = np.vstack([rate, rate[-1:]])
    return replace(made, quaternion=turns.as_quat(scalar_first=True), angular_velocity=gyro)


def wrong(log, contract):
    return {f.check: f.sentence for f in checks(log, contract) if f.verdict == "wrong"}


def test_a_sound_log_passes(log, contract):
    found = list(checks(log, contract))
    assert not [f for f in found if f.verdict == "wrong"]
    assert {f.check for f in found if f.verdict == "fine"} >= {
        "gains",
        "signs",
        "pose",
        "orientation",
        "gyroscope",
        "delay",
        "offsets",
    }
    assert "another program" in next(f.sentence for f in found if f.check == "control period")


def test_each_mistake_is_named(log, contract):
    mirrored = log.position.copy()
    mirrored[:, 0] = 2 * mirrored[:, 0].mean() - mirrored[:, 0]
    still = log.position.copy()
    still[:, 1] = still[0, 1]
    off = log.position + np.where(np.arange(12) == 5, 0.15, 0.0)
    away = np.where(np.arange(12) == 4, 1.3, 0.0)
    cases = {
        "gains": (replace(log, stiffness=np.full(12, 33.0)), "was 33 N·m/rad, and the policy was made for"),
        "signs": (replace(log, position=mirrored), "FL_hip moves against its target"),
        "response": (
            replace(log, position=still + 1e-6 * np.arange(len(still))[:, None] % 2e-6),
            "FL_thigh does not follow",
        ),
        "offsets": (replace(log, position=off), r"FR_calf by \+0.1"),
        "pose": (
            replace(log, target=log.target + away, position=log.position + away, held="standing"),
            "targets of FR_thigh lie around",
        ),
        "orientation": (
            replace(log, quaternion=log.quaternion[:, [1, 0, 3, 2]]),
            r"gravity points along .* another one",
        ),
        "gyroscope": (replace(log, angular_velocity=np.rad2deg(log.angular_velocity)), "looks like degrees"),
        "delay": (replace(log, target=np.roll(log.target, -11, axis=0), held="hung"), r"targets act after 2\d"),
    }
    for check, (bad, sentence) in cases.items():
        found = wrong(bad, contract)
        assert check in found, (check, found)
        with pytest.raises(AssertionError, match=sentence):
            raise AssertionError(found[check])
    listed = replace(log, quaternion=np.roll(log.quaternion, -1, axis=1))
    assert "in the order xyzw" in wrong(listed, contract)["gyroscope"]
    swapped = replace(log, angular_velocity=log.angular_velocity[:, [1, 0, 2]])
    assert "frame is not the base's" in wrong(swapped, contract)["gyroscope"]
    assert "wrong sign" in wrong(replace(log, angular_velocity=-log.angular_velocity), contract)["gyroscope"]


@pytest.mark.parametrize(
    ("rate", "torque", "last", "told"),
    [(500.0, True, 2.0, True), (500.0, False, 5.0, True), (50.0, True, 5.0, True), (500.0, False, 1.0, False)],
)
def test_the_delay_needs_no_guess_of_rotors_and_friction(rate, torque, last, told):
    truth = replace(GO2.parameters["gauge"], armature=(0.03,) * 12, friction_loss=(0.4,) * 12, delay=0.012)
    made = simulated_log(GO2, truth, chirp=Chirp(seconds=4.0, last=last, rate=rate), stiffness=20.0, damping=0.5)
    delay = acting_delay(made if torque else replace(made, torque=None))
    assert (delay is not None) == told
    assert delay is None or abs(delay - 0.012) <= 0.002


def test_targets_change_at_the_control_period(log, contract):
    slow = log.target[np.arange(len(log.time)) // 25 * 25]  # 50 ms
    assert (
        "the policy's period is 20 ms" in wrong(replace(log, target=slow, held="standing"), contract)["control period"]
    )


def test_a_log_of_another_robot_is_refused(log, tmp_path):
    save_log(log, tmp_path / "log.npz")
    results = preflight(PreflightRequest(policy="pretrained", log=tmp_path / "log.npz"), tmp_path / "out")
    assert results["passed"] and (tmp_path / "out" / "preflight.json").is_file()
    page = (tmp_path / "out" / "preflight.html").read_text(encoding="utf-8")
    assert "Nothing is wrong in log.npz" in page and page.count("<svg") == 12
    names = np.array([name.replace("calf", "shin") for name in GO2.joint_names])
    gains = {"stiffness": log.stiffness, "damping": log.damping}
    np.savez(tmp_path / "b.npz", time=log.time, target=log.target, position=log.position, joint_names=names, **gains)
    with pytest.raises(LogError, match="is not of robot 'go2': FL_calf"):
        preflight(PreflightRequest(policy="pretrained", log=tmp_path / "b.npz"), tmp_path / "out")
