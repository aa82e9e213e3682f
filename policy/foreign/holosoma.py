"""Reads the metadata that holosoma writes into an ONNX file of its locomotion task.

The metadata name joints, gains and scale of the action. The observation is the one of holosoma's own controller: its terms in the
order of their names, with gait clocks of both feet.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...robots.base import Robot
from ..base import PolicyError
from ..contract import ObservationTerm, PolicyContract
from .bodies import choose_robot, matching_joint
from .terms import checked, listed

_PERIOD = 1.0
"""Gait cycle of its controller [s]."""
_SCALES = {"g1": (0.25, 0.05), "t1": (1.0, 0.1)}
"""Factors on turning speed and joint speed, by robot."""


def holosoma_contract(metadata: Mapping[str, str], asked: Robot | None, *, source: str) -> PolicyContract | None:
    """Return the contract that the metadata describe; None if they are not there.

    Raises:
        PolicyError: the metadata are incomplete or malformed.
    """
    if not {"dof_names", "kp", "kd", "action_scale"} <= metadata.keys():
        return None
    with checked(source, "holosoma's metadata"):
        data = {key: json.loads(metadata[key]) for key in ("dof_names", "kp", "kd", "action_scale")}
        named = re.search(r'<robot[^>]*\bname="(\w+)"', metadata.get("robot_urdf", "")[:100_000].replace('\\"', '"'))
        family = (named[1] if named else asked.name if asked else "").lower()[:2]
        robot = choose_robot(asked, None if asked else (named[1] if named else "holosoma's robot"), source)
        return _holosoma_contract(data, metadata, robot, family, source)


def _holosoma_contract(
    data: Mapping[str, Any], metadata: Mapping[str, str], robot: Robot, family: str, source: str
) -> PolicyContract:
    if family not in _SCALES:
        raise PolicyError(
            f"'{source}' is holosoma's for a robot {family!r} whose observation scales are not known ({', '.join(_SCALES)} are); "
            "give a contract.toml (--contract)"
        )
    turning, speed = _SCALES[family]
    names = tuple(matching_joint(str(n), robot) for n in data["dof_names"])
    ranges = json.loads(metadata.get("command_ranges", "null")) or {}
    axes = ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")
    limits = [
        max(abs(float(v)) for v in ranges[axis]) if ranges.get(axis) else robot.command_limits[i]
        for i, axis in enumerate(axes)
    ]
    clock: dict[str, Any] = {
        "name": "gait_phase",
        "scale": (1.0,),
        "period": _PERIOD,
        "offsets": (0.0, 0.5),
        "at_rest": "half",
    }
    terms = (
        ObservationTerm(name="last_action", scale=(1.0,)),
        ObservationTerm(name="base_angular_velocity_b", scale=(turning,)),
        ObservationTerm(name="command_turning", scale=(1.0,)),
        ObservationTerm(name="command_linear", scale=(1.0,)),
        ObservationTerm(**clock, waves=("cos",)),
        ObservationTerm(name="joint_position", scale=(1.0,)),
        ObservationTerm(name="joint_velocity", scale=(speed,)),
        ObservationTerm(name="projected_gravity_b", scale=(1.0,)),
        ObservationTerm(**clock, waves=("sin",)),
    )
    standing = dict(zip(robot.joint_names, robot.default_joint_position, strict=True))
    return PolicyContract(
        robot=robot.name,
        joint_names=names,
        default_joint_position=tuple(standing.get(name, 0.0) for name in names),
        action_scale=tuple(float(v) for v in listed(data["action_scale"], 0.25, len(names))),
        stiffness=tuple(float(v) for v in data["kp"]),
        damping=tuple(float(v) for v in data["kd"]),
        control_period=0.02,
        observation=terms,
        command_limits=(limits[0], limits[1], limits[2]),
        provenance={
            "adapter": "holosoma metadata",
            "file": Path(source).name,
            "assumed": f"observation of holosoma's controller for {family.upper()}, gait cycle {_PERIOD:g} s, control period 0.02 s, "
            f"standing pose of robot '{robot.name}'" + ("" if ranges else " and its command limits"),
        },
    )
