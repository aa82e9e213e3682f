"""Hold the first seconds of a robot's own log against what a policy's contract expects, before anything walks."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...files.provenance import provenance
from ...files.writing import json_text, write_files
from ...policy.contract import PolicyContract, check_robot
from ...policy.loading import load_policy, own_contract
from ...policy.robot_of import robot_for
from ...robots import Robot
from .acting_delay import acting_delay
from .log import Array, Log, LogError
from .page import render_preflight
from .replaying import read_logs
from .request import PreflightRequest
from .rig import FixedRig, acting_parameters, at_rows, beginning, held_targets, num_steps

Verdict = Literal["fine", "wrong", "not told"]
_RESPONSE = 0.3
"""Least correlation of a joint's position with its target, at the best delay, of a joint that obeys."""
_MOVES = 0.02
"""Least standard deviation of a target that says anything about its joint [rad]."""
_OFFSET = 0.06
"""Largest offset of a joint's position that load and friction explain [rad]."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One check."""

    check: str
    verdict: Verdict
    sentence: str


def preflight(request: PreflightRequest, folder: Path, *, command: Sequence[str] = ()) -> dict[str, Any]:
    """Check a log against a policy; return the content of ``preflight.json``.

    Raises:
        LogError: the log cannot be used at all.
        PolicyError, ContractError, RobotError: nor the policy, or it is for another robot.
    """
    began = time.perf_counter()
    policy = load_policy(
        request.policy, trust=request.trust, contract_file=own_contract(request.policy, request.contract)
    )
    robot = robot_for(policy.contract, request.robot)
    log = read_logs([request.log], replace(request, robot=request.robot or robot.name))[0]
    if log.robot.name != robot.name:
        raise LogError(f"log '{log.name}' is of robot '{log.robot.name}', but the policy is for '{robot.name}'")
    findings = list(checks(log, policy.contract))
    results = {
        "schema": 1,
        "policy": policy.path,
        "robot": robot.name,
        "log": {"name": log.name, "defects": log.defects(), "held": log.held, "seconds": float(log.time[-1])},
        "findings": [asdict(finding) for finding in findings],
        "passed": not any(finding.verdict == "wrong" for finding in findings),
        "provenance": provenance(command=command, seconds=round(time.perf_counter() - began, 2)),
    }
    page = render_preflight(results, log, _pose_of(policy.contract, robot))
    write_files(folder, {"preflight.json": json_text(results), "preflight.html": page}, LogError)
    return results


def _pose_of(contract: PolicyContract, robot: Robot) -> Array:
    """Return the pose around which the policy acts, in the robot's order of joints [rad], (J,)."""
    pose = np.array(robot.default_joint_position)
    pose[list(check_robot(contract, robot))] = contract.action_offset or contract.default_joint_position
    return pose


def checks(log: Log, contract: PolicyContract) -> Iterator[Finding]:
    """Yield all findings on a log."""
    order = check_robot(contract, log.robot)
    yield _gains(log, contract, order)
    yield _period(log, contract)
    yield from _response(log)
    yield _pose(log, contract, order)
    yield _upright(log)
    yield _gyroscope(log)
    yield from _motors(log, contract)


def _finding(check: str, wrong: str, fine: str, *, told: bool = True) -> Finding:
    verdict: Verdict = "wrong" if wrong else "fine" if told else "not told"
    return Finding(check=check, verdict=verdict, sentence=wrong or fine)


def _names(log: Log, joints: Any) -> str:
    if len(joints) == log.robot.num_joints > 1:
        return "every joint"
    return ", ".join(log.robot.joint_names[j].removesuffix("_joint") for j in joints)


def _gains(log: Log, contract: PolicyContract, order: Sequence[int]) -> Finding:
    parts = []
    for key, unit in (("stiffness", "N·m/rad"), ("damping", "N·m·s/rad")):
        sent = getattr(log, key)[list(order)]
        wanted = np.asarray(getattr(contract, key))
        apart = np.abs(sent - wanted) > 0.02 * np.maximum(wanted, 0.01)
        beyond = [order[p] for p in np.flatnonzero(apart).tolist()]
        if beyond:
            first = list(order).index(beyond[0])
            parts.append(
                f"{key} of {_names(log, beyond)} was {sent[first]:g} {unit}, and the policy was made for {wanted[first]:g}"
            )
    return _finding("gains", "; ".join(parts), "the motors ran with the policy's gains")


def _period(log: Log, contract: PolicyContract) -> Finding:
    """Compare the time between changes of the targets with the control period; a recording by another program says nothing."""
    changed = np.flatnonzero((np.diff(log.target, axis=0) != 0).any(axis=1))
    wanted = contract.control_period
    if len(changed) < 5:
        return _finding("control period", "", "the targets hardly change", told=False)
    found = float(np.median(np.diff(log.time[changed])))
    if found < 0.75 * wanted:
        words = f"targets change every {1e3 * found:.1f} ms, faster than the policy's {1e3 * wanted:g} ms: another program sent them"
        return _finding("control period", "", words, told=False)
    wrong = (
        ""
        if found < 1.25 * wanted
        else f"targets change every {1e3 * found:.1f} ms; the policy's period is {1e3 * wanted:g} ms"
    )
    return _finding("control period", wrong, f"targets change every {1e3 * found:.1f} ms")


def _response(log: Log) -> Iterator[Finding]:
    """Check that each joint moves as its own target does, after at most 60 ms."""
    target, position = log.target - log.target.mean(axis=0), log.position - log.position.mean(axis=0)
    moving = np.flatnonzero(target.std(axis=0) > _MOVES)
    if not len(moving):
        yield _finding("joint order and signs", "", "no target moves; record a slow sine", told=False)
        return
    best = np.zeros((len(moving), len(moving)))
    lags = range(max(round(0.06 / log.period), 1))
    for lag in lags:
        early, late = target[: len(target) - lag, moving], position[lag:, moving]
        scale = np.outer(late.std(axis=0).clip(1e-9), early.std(axis=0).clip(1e-9))
        found = (late.T @ early) / len(early) / scale
        best = np.where(np.abs(found) > np.abs(best), found, best)
    own = np.diagonal(best)
    reversed_ = moving[own < -_RESPONSE]
    still = moving[np.abs(own) <= _RESPONSE]
    yield _finding(
        "signs",
        f"{_names(log, reversed_)} moves against its target" if len(reversed_) else "",
        f"{len(moving)} joints follow their targets",
    )
    yield _finding(
        "response",
        f"{_names(log, still)} does not follow its target" if len(still) else "",
        "every moving joint responds",
    )
    rest = sorted(set(range(log.robot.num_joints)) - set(moving.tolist()))
    if rest:
        yield _finding("joints at rest", "", f"{_names(log, rest)} had no moving target", told=False)


def _pose(log: Log, contract: PolicyContract, order: Sequence[int]) -> Finding:
    """Compare where targets lie with the pose around which the policy acts."""
    offset = np.asarray(contract.action_offset or contract.default_joint_position)
    middle = np.median(log.target, axis=0)[list(order)]
    reach = np.maximum(4.0 * np.abs(np.asarray(contract.action_scale)), 0.6)
    beyond = np.flatnonzero(np.abs(middle - offset) > reach)
    wrong = ""
    if len(beyond):
        p = int(beyond[0])
        joints = _names(log, [order[b] for b in beyond.tolist()])
        wrong = f"targets of {joints} lie around {middle[p]:.2f} rad, where the policy acts around {offset[p]:.2f} rad"
    return _finding("pose", wrong, "targets lie around the policy's pose")


def _upright(log: Log) -> Finding:
    """Check the orientation of the base: a robot that hangs or stands has gravity along −z of its base."""
    if log.quaternion is None:
        return _finding("orientation", "", "the log has no orientation of the base", told=False)
    norm = np.linalg.norm(log.quaternion, axis=1)
    if np.abs(norm - 1.0).max() > 0.05:
        return _finding(
            "orientation", f"quaternions have lengths of {norm.min():.2f} to {norm.max():.2f}; they must be 1", ""
        )
    down = np.median(_down(log.quaternion), axis=0)
    if down[2] < -0.8:
        return _finding("orientation", "", f"gravity points along −z of the base, {down[2]:.2f}")
    other = np.median(_down(np.roll(log.quaternion, 1, axis=1)), axis=0)
    hint = (
        "; its order looks like xyzw and must be wxyz"
        if other[2] < -0.8
        else "; the base's frame is another one, or it lay down"
    )
    return _finding(
        "orientation", f"gravity points along ({down[0]:.2f}, {down[1]:.2f}, {down[2]:.2f}) of the base{hint}", ""
    )


def _down(quaternion: Array) -> Array:
    """Return the direction of gravity in the base's frame, (T, 3)."""
    from scipy.spatial.transform import Rotation

    found: Array = Rotation.from_quat(quaternion, scalar_first=True).inv().apply(np.array([0.0, 0.0, -1.0]))
    return found


def _gyroscope(log: Log) -> Finding:
    """Compare the gyroscope with the change of the orientation: unit, frame and signs."""
    if log.quaternion is None or log.angular_velocity is None:
        return _finding("gyroscope", "", "the log lacks orientation or angular velocity of the base", told=False)
    shares, power = _shares(log, log.quaternion)
    axes = np.flatnonzero(power > 0.05**2)
    if not len(axes):
        return _finding("gyroscope", "", "the base hardly turned; tilt it by hand while recording", told=False)
    other = np.diagonal(_shares(log, np.roll(log.quaternion, 1, axis=1))[0])
    if not _agree(np.diagonal(shares)[axes]) and _agree(other[axes]):
        return _finding("gyroscope", "it agrees with quaternions in the order xyzw; the log must have wxyz", "")
    for axis in axes:
        share, most = float(shares[axis, axis]), int(np.abs(shares[:, axis]).argmax())
        name = "xyz"[axis]
        if 30.0 < abs(share) < 90.0:
            return _finding(
                "gyroscope", f"turning about {name} reads {share:.0f} times too large; it looks like degrees", ""
            )
        if share < -0.5:
            return _finding("gyroscope", f"turning about {name} has the wrong sign", "")
        if most != axis and abs(shares[most, axis]) > 0.5 > abs(share):
            return _finding(
                "gyroscope",
                f"turning about {name} is read about {'xyz'[most]}; the sensor's frame is not the base's",
                "",
            )
        if not 0.5 < share < 1.5:
            return _finding(
                "gyroscope", f"turning about {name} reads {share:.2f} times the change of the orientation", ""
            )
    return _finding("gyroscope", "", f"agrees with the orientation about {', '.join('xyz'[a] for a in axes)}")


def _shares(log: Log, quaternion: Array) -> tuple[Array, Array]:
    """Return the gyroscope's axes as shares of the orientation's change about each axis, (3, 3), and that change's power, (3,)."""
    from scipy.spatial.transform import Rotation

    every = max(round(0.02 / log.period), 1)
    turns = Rotation.from_quat(quaternion[::every], scalar_first=True)
    time = log.time[::every]
    steps = np.diff(time)[:, None]
    turned = (turns[:-1].inv() * turns[1:]).as_rotvec() / steps
    assert log.angular_velocity is not None
    gyro = np.stack(
        [np.interp(time[:-1] + steps[:, 0] / 2, log.time, column) for column in log.angular_velocity.T], axis=1
    )
    power = (turned**2).mean(axis=0)
    return (gyro[:, :, None] * turned[:, None, :]).mean(axis=0) / power.clip(1e-9), power


def _agree(shares: Array) -> bool:
    return bool(((shares > 0.5) & (shares < 1.5)).all())


def _motors(log: Log, contract: PolicyContract) -> Iterator[Finding]:
    """Compare the delay with the control period, and positions with those of the nominal robot hung by its trunk."""
    delay, most = acting_delay(log), contract.control_period
    wrong = ""
    if delay is not None and delay > most:
        wrong = f"targets act after {1e3 * delay:.0f} ms, longer than the control period of {1e3 * most:g} ms"
    words = "motions up to 5 Hz of a robot that hangs tell it, or torques in rows of 5 ms and less"
    fine = words if delay is None else f"targets act after {1e3 * delay:.0f} ms"
    yield _finding("delay", wrong, fine, told=delay is not None)
    if log.held != "hung":
        yield _finding("offsets", "", "they take a log of a robot that hangs (held)", told=False)
        return
    nominal = log.robot.parameters[log.robot.default_parameters]
    rig = FixedRig(log.robot, nominal, threads=1)
    try:
        targets = held_targets(log, delay or 0.0, num_steps(log))
        series = rig.run([acting_parameters(log, nominal)], targets[None], [beginning(log)])
    finally:
        rig.close()
    offset = np.median(log.position - at_rows(log, series[0, 0]), axis=0)
    beyond = np.flatnonzero(np.abs(offset) > _OFFSET)
    parts = [f"{_names(log, [int(j)])} by {offset[j]:+.2f} rad" for j in beyond]
    wrong = f"positions lie off the simulated ones: {', '.join(parts)}; calibrate the zeros" if parts else ""
    yield _finding("offsets", wrong, f"positions lie within {np.abs(offset).max():.3f} rad of the simulated ones")
