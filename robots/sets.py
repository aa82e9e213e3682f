"""Parameter sets by name or file, in and out: ``gaitgauge identify`` writes what ``--parameters`` reads."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..files.parsing import one_line, parse_toml, read_text
from .base import JointParameters, Robot
from .loading import PER_JOINT, RobotError, parameter_set
from .motor_network import MotorNetwork


def joint_groups(robot: Robot) -> dict[str, list[int]]:
    """Return the joints of each kind: ``hip`` holds the places of all joints whose name ends in it after the leg's name."""
    groups: dict[str, list[int]] = {}
    for place, name in enumerate(robot.joint_names):
        groups.setdefault(name.removesuffix("_joint").partition("_")[2] or name, []).append(place)
    return groups


def find_set(robot: Robot, name: str | None) -> tuple[str, JointParameters]:
    """Return a set's name and constants.

    Args:
        name: of one of the robot's sets, or a file with ``[parameters.NAME]`` tables, ``FILE.toml`` or ``FILE.toml:NAME``;
            None for the robot's default.

    Raises:
        RobotError: no such set or file, several sets in it, or a wrong value.
    """
    name = name or robot.default_parameters
    if name in robot.parameters:
        return name, robot.parameters[name]
    path, _, wanted = name.partition(".toml:") if ".toml:" in name else (name.removesuffix(".toml"), "", "")
    if not name.endswith(".toml") and not wanted:
        known = ", ".join(robot.parameters)
        raise RobotError(
            f"robot '{robot.name}' has no parameter set '{one_line(name, 80)}'; it has {known}, or give FILE.toml"
        )
    file = Path(f"{path}.toml")
    source = f"parameter file '{one_line(file)}'"
    data = parse_toml(read_text(file, "parameter file", RobotError), source, RobotError)
    tables = data.get("parameters")
    if not isinstance(tables, dict) or not tables:
        raise RobotError(f"{source} has no [parameters.NAME] table")
    if (owner := data.get("robot", robot.name)) != robot.name:
        raise RobotError(f"{source} is for robot '{one_line(owner, 80)}', not for '{robot.name}'")
    if not wanted and len(tables) > 1:
        raise RobotError(f"{source} holds {', '.join(tables)}; name one as {file}:NAME")
    wanted = wanted or next(iter(tables))
    if wanted not in tables:
        raise RobotError(f"{source} holds {', '.join(tables)}, not '{one_line(wanted, 80)}'")
    return wanted, parameter_set(robot, tables[wanted], f"{source}: parameters.{wanted}", folder=file.parent)


def set_text(robot: Robot, name: str, values: Mapping[str, Any], provenance: str, *, notes: Sequence[str] = ()) -> str:
    """Return a set as TOML text, its values rounded to five digits.

    Args:
        values: fields of ``JointParameters``: a number, or one for each joint, which become a table by kind of joint where all
            joints of a kind agree.
        provenance: becomes ``measured``.
        notes: become comments.
    """
    groups = joint_groups(robot)
    lines = [f"# {line}" for note in notes for line in note.splitlines()]
    lines += [f'robot = "{robot.name}"', "", f"[parameters.{name}]"]
    for key, value in values.items():
        if isinstance(value, float | int):
            lines.append(f"{key} = {_digits(value)}")
            continue
        texts = [_digits(v) for v in value]
        if len(set(texts)) == 1:
            lines.append(f"{key} = {texts[0]}")
        elif all(len({texts[j] for j in joints}) == 1 for joints in groups.values()):
            kinds = ", ".join(f"{_key(group)} = {texts[joints[0]]}" for group, joints in groups.items())
            lines.append(f"{key} = {{ {kinds} }}")
        else:
            lines.append(f"{key} = [{', '.join(texts)}]")
    return "\n".join([*lines, f"measured = {json.dumps(provenance, ensure_ascii=False)}", ""])


def network_text(robot: Robot, name: str, base: JointParameters, network: MotorNetwork, *, passive: bool) -> str:
    """Return a set with motors by the network ``NAME.npz`` as TOML text.

    Args:
        base: its gains, which say what the motors were commanded with, and its limits stay.
        passive: True keeps rotor inertia and friction too; False leaves them out, because a network of measured torques holds
            friction already and its training had none.
    """
    values = {key: value for key in PER_JOINT if (value := getattr(base, key)) is not None}
    if not passive:
        values |= dict.fromkeys(("armature", "joint_damping", "friction_loss"), (0.0,) * robot.num_joints)
    text = set_text(robot, name, values, network.source)
    return f'{text}motor = "network"\nnetwork = "{name}.npz"\n'


def _digits(value: float) -> str:
    text = f"{float(value):.5g}"
    return text if any(c in text for c in ".e") else f"{text}.0"


def _key(name: str) -> str:
    """Return a name as a key of TOML."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
