"""Reads the controller settings of unitree_rl_gym and its kin (``g1.yaml``, ``go2.yaml``), whose policies legged_gym trains."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...robots.anatomy.body_plan import body_plan
from ...robots.base import HeldJoint, Robot
from ..base import PolicyError
from ..contract import History, ObservationTerm, PolicyContract
from .bodies import choose_robot, sdk_joints
from .terms import checked, listed

_PERIOD = 0.8
"""Gait cycle of the controller, which stands in its code [s]."""


def is_legged_gym(data: Mapping[str, Any]) -> bool:
    """Return whether a table is one."""
    return {"kps", "kds", "default_angles", "num_obs", "num_actions"} <= data.keys()


def read_legged_gym(data: Mapping[str, Any], path: Path, asked: Robot | None) -> PolicyContract:
    """Return the contract that the settings describe.

    A frame is turning speed, gravity, command, joint positions, joint speeds, last action, and with two more entries sine and
    cosine of a gait clock of 0.8 s. As many actions as joints of the legs drive these; others are held.
    ``leg_joint2motor_idx`` gives the motor of each of the policy's joints; without it the joints are in the robot's order. Some such
    files write the default angles by motor; the order that is nearer to the standing pose counts.

    Raises:
        PolicyError: the file is malformed, is for another robot, or its width is that of another observation.
    """
    with checked(path, "unitree_rl_gym's settings"):
        found = re.search(r"/robots/([a-z0-9]+)", str(data.get("xml_path", ""))) or re.match(
            r"(go2w?|go1|g1|h1|b2w?|a1)(?=[._-])", path.name
        )
        return _read(data, path, choose_robot(asked, found[1] if found else None, path))


def _read(data: Mapping[str, Any], path: Path, robot: Robot) -> PolicyContract:
    motors, joints = data.get("leg_joint2motor_idx"), int(data["num_actions"])
    names, held = _driven(robot, joints, path)
    if motors is not None:
        names = sdk_joints(robot, list(motors), path, "leg_joint2motor_idx")
    frame = 9 + 3 * joints
    width = int(data["num_obs"])
    frames, rest = divmod(width, frame)
    if rest not in (0, 2) or (rest == 2 and frames != 1):
        raise PolicyError(
            f"'{path}' has num_obs {width}; {frame} entries a frame, or {frame + 2} with a gait clock, are understood: give a "
            "contract.toml that describes its observation (gaitgauge contract new)"
        )
    assumed = ["the observation of unitree_rl_gym's controller"]
    assumed += [f"the {len(held)} joints of robot '{robot.name}' beside its legs are held"] if held else []
    standing = dict(zip(robot.joint_names, robot.default_joint_position, strict=True))
    angles = [float(v) for v in data["default_angles"]]
    gains: tuple[Any, ...] = (data["kps"], data["kds"])
    if motors is not None and robot.sdk_joint_names is not None:
        by_motor = dict(zip(robot.sdk_joint_names, angles, strict=True))
        off = sum(abs(standing[n] - a) for n, a in zip(names, angles, strict=True))
        if off > sum(abs(standing[n] - by_motor[n]) for n in names):
            angles = [by_motor[n] for n in names]
            gains = tuple([dict(zip(robot.sdk_joint_names, g, strict=True))[n] for n in names] for g in gains)
            assumed.append("default angles and gains by motor, since so they are a standing pose")
    terms = [
        ObservationTerm(name="base_angular_velocity_b", scale=(float(data["ang_vel_scale"]),)),
        ObservationTerm(name="projected_gravity_b", scale=(1.0,)),
        ObservationTerm(name="command", scale=tuple(float(v) for v in data["cmd_scale"])),
        ObservationTerm(name="joint_position", scale=(float(data["dof_pos_scale"]),)),
        ObservationTerm(name="joint_velocity", scale=(float(data["dof_vel_scale"]),)),
        ObservationTerm(name="last_action", scale=(1.0,)),
    ]
    if rest == 2:
        terms.append(ObservationTerm(name="gait_phase", scale=(1.0,), period=_PERIOD))
        assumed.append(f"a gait clock of {_PERIOD:g} s")
    if frames > 1:
        assumed.append("whole frames, oldest first, from zeros")
    limits = data.get("max_cmd")
    if limits is None:
        assumed.append(f"command limits of robot '{robot.name}'")
    period = data.get("control_dt") or float(data["simulation_dt"]) * int(data["control_decimation"])
    forward, sideways, turning = (float(v) for v in limits or robot.command_limits)
    return PolicyContract(
        robot=robot.name,
        joint_names=tuple(names),
        default_joint_position=tuple(angles),
        action_scale=tuple(float(v) for v in listed(data["action_scale"], 0.25, joints)),
        stiffness=tuple(float(v) for v in gains[0]),
        damping=tuple(float(v) for v in gains[1]),
        control_period=round(float(period), 9),
        observation=tuple(terms),
        history=History(length=max(frames, 1)),
        command_limits=(forward, sideways, turning),
        held=held,
        provenance={"adapter": "unitree_rl_gym settings", "file": path.name, "assumed": ", ".join(assumed)},
    )


def _driven(robot: Robot, joints: int, path: Path) -> tuple[Sequence[str], tuple[HeldJoint, ...]]:
    """Return the joints of a policy of so many actions, in the robot's order, and those that are held: all, or those of its legs."""
    legs = sorted(joint for leg in body_plan(robot).legs for joint in leg)
    if joints not in (robot.num_joints, len(legs)):
        raise PolicyError(
            f"'{path}' has {joints} actions and robot '{robot.name}' {robot.num_joints} joints, {len(legs)} of them in its legs; give "
            "another robot's robot.toml (--robot)"
        )
    if joints == robot.num_joints:
        return robot.joint_names, ()
    motors, pose, names = robot.parameters[robot.default_parameters], robot.default_joint_position, robot.joint_names
    rest = [j for j in range(robot.num_joints) if j not in legs]
    held = (
        HeldJoint(name=names[j], position=pose[j], stiffness=motors.stiffness[j], damping=motors.damping[j])
        for j in rest
    )
    return [names[j] for j in legs], tuple(held)
