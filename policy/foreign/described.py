"""Reads and writes a ``contract.toml``: a description of a policy written by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...files.parsing import did_you_mean, parse_toml, read_text, shown
from ...robots.base import Robot
from ..base import PolicyError
from ..contract import PER_ENTRY, PER_JOINT, ContractError, PolicyContract, reordered, standard_contract
from .bodies import choose_robot
from .presets import find_preset, preset_contract, presets


def described_contract(path: Path, asked: Robot | None) -> PolicyContract:
    """Read a ``contract.toml``: fields of ``PolicyContract``; fields left out are the robot's standard ones. Where
    it lists the joints in an order of its own, standard values per joint go with their joints. One number stands for all
    joints, or for all entries of an observation. With ``preset`` the fields left out are that preset's.

    Raises:
        PolicyError: no such file, or a field is unknown or malformed.
    """
    source = f"contract file '{path}'"
    data = parse_toml(read_text(path, "contract file", PolicyError), source, PolicyError)
    named = data.get("robot")
    robot = choose_robot(asked, named if isinstance(named, str) else None, path)
    return contract_of(data, robot, source, {"adapter": "contract.toml", "file": path.name})


def contract_of(
    data: dict[str, Any], robot: Robot | None, source: str, provenance: Mapping[str, Any]
) -> PolicyContract:
    """Return the contract that a table of a ``contract.toml`` describes.

    Args:
        data: the table; it is changed.
        robot: the robot, under whatever name it is asked for; None where it is not installed and the table says everything.
        source: origin of the table, the beginning of every sentence.

    Raises:
        PolicyError: a field is unknown, missing or malformed.
    """
    names, preset = data.get("joint_names"), data.pop("preset", None)
    usual: dict[str, Any] = {"control_period": 0.02, "history": {}, "provenance": provenance}
    if robot is not None:
        usual = _usual(data, robot, preset, source) | {"provenance": provenance}
        data["robot"] = robot.name
    joints = len(names) if isinstance(names, list) else len(usual.get("joint_names", ()))
    assumed = [str(provenance["assumed"])] if "assumed" in provenance else []
    for name in PER_JOINT:
        if _is_number(given := data.get(name)):
            data[name] = [given] * joints
        elif not isinstance(given, list | tuple | None):
            raise PolicyError(
                f"{source} is wrong: {name} is {shown(given)}; it must be a number, or a list with one per joint"
            )
    limits = data.get("target_range")
    if isinstance(limits, list) and len(limits) == 2 and all(map(_is_number, limits)):
        data["target_range"] = [limits] * joints
    terms = data.get("observation")
    for term in terms if isinstance(terms, list) else []:
        if isinstance(term, dict):
            term.setdefault("scale", 1.0)
            for name in (*PER_ENTRY, "values", "offsets"):
                if _is_number(term.get(name)):
                    term[name] = [term[name]]
            if sentence := _further_commands(term):
                assumed.append(sentence)
    if assumed:
        data["provenance"] = {**provenance, "assumed": ", ".join(assumed)}
    try:
        return PolicyContract.from_dict({**usual, **data})
    except ContractError as error:
        raise PolicyError(f"{source} is wrong: {error}") from error


def _usual(data: dict[str, Any], robot: Robot, preset: object, source: str) -> dict[str, Any]:
    """Return the values of fields that are left out: the robot's standard ones, or those of a preset, whose history is continued."""
    names, history = data.get("joint_names"), data.get("history")
    if preset is None:
        standard = standard_contract(robot)
    elif isinstance(preset, str):
        length = history.get("length", 1) if isinstance(history, dict) else 1
        try:
            standard = preset_contract(find_preset(preset), robot, frames=length if type(length) is int else 1)
        except PolicyError as error:
            raise PolicyError(f"{source}: {error}") from error
        if isinstance(history, dict):
            data["history"] = {**asdict(standard.history), **history}
    else:
        raise PolicyError(f"{source}: preset is {shown(preset)}; it must be one of {', '.join(presets())}")
    for name in names if isinstance(names, list) else ():
        if name not in robot.joint_names:
            raise PolicyError(
                f"{source} is wrong: robot '{robot.name}' has no joint {shown(name)}{did_you_mean(name, robot.joint_names) or ';'} "
                f"it has {', '.join(robot.joint_names)}"
            )
    if isinstance(names, list) and len(names) == robot.num_joints and all(n in names for n in robot.joint_names):
        standard = reordered(standard, names)
    return standard.to_dict()


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _further_commands(term: dict[str, Any]) -> str | None:
    """Let commands that have a scale and no value stand at zero; return a sentence that says so."""
    scale = term.get("scale")
    if term.get("name") != "command" or "values" in term or not isinstance(scale, list) or len(scale) <= 3:
        return None
    term["values"] = [0.0] * (len(scale) - 3)
    count = len(scale) - 3
    which = "the last" if count == 1 else f"the last {count}"
    return f"{which} of {len(scale)} commands stays at 0 (values of the term command)"


# ---- writing --------------------------------------------------------------------------------------------------------


def toml_lines(contract: PolicyContract, other: PolicyContract | None = None) -> list[str]:
    """Return lines of a ``contract.toml``: those that turn ``other`` into this contract, all of it where there is no other.

    Tables come last, as TOML wants them.
    """
    data, old = contract.to_dict(), {} if other is None else other.to_dict()
    if data["joint_names"] != old.get("joint_names"):  # values that the file leaves out would go with their joints
        old = {k: v for k, v in old.items() if k not in PER_JOINT or len(set(v or ())) == 1}
    changed = {k: v for k, v in data.items() if k not in ("provenance", "schema_version") and v != old.get(k)}
    terms = changed.pop("observation", ())
    lines = [f"{key} = {_toml(value)}" for key, value in changed.items() if value is not None]
    for term in terms:
        lines += ["[[observation]]", *(f"{k} = {_toml(v)}" for k, v in term.items() if v is not None)]
    return lines


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return json.dumps(value)  # lists, numbers and texts are written alike


_TEMPLATE = """# How a policy is run on robot '{robot}'. Delete what is as it stands here: left-out fields are these values.
# One number stands for all joints. SI units, radians. docs/reference/contract.md explains each field.

robot = "{robot}"
# Joints in the order in which the network sees and moves them.
joint_names = {joints}
# [rad], in that order: the pose that joint_position is measured from, and the target at an action of zero.
default_joint_position = {pose}
# action_offset = [...]              # target at an action of zero, where it is not that pose
action_scale = {scale}
# action_clip = 100.0                # of the network's output; last_action shows the clipped one
# target_range = [-2.5, 2.5]         # lowest and highest joint target, or a pair per joint
{wheels}  # wheels: their targets and action_scale are speeds [rad/s]
# Gains of the motors: kp [N·m/rad], kd [N·m·s/rad].
stiffness = {stiffness}
damping = {damping}
control_period = {period}               # [s]
command_limits = {limits}   # forward, sideways [m/s], turning [rad/s]

# Frames in the network's input. frame-major: whole frames, oldest first; term-major: all frames of a term, then the next
# term; add -newest-first to reverse. start: "zeros", or "repeat" for copies of the first frame.
history = {{ length = 1, order = "frame-major", start = "zeros" }}
# Where terms have histories of their own, or the network several inputs:
# layout = [{{ terms = ["command"], length = 1 }}, {{ terms = ["joint_position", "joint_velocity"], length = 5 }}]
# layout = [{{ input = "obs", length = 1 }}, {{ input = "obs_history", length = 5 }}]
# A second network that runs first, and whether its output stands before or behind the rest of the input:
# encoder = {{ file = "adaptation_module.pt", latent = "last" }}
# Joints that the policy does not drive, arms for example: their motors hold them.
# held = [{{ name = "left_elbow_joint", position = 0.0, stiffness = 50.0, damping = 2.0 }}]
# memory = [["h_in", "h_out"]]       # recurrent states of an ONNX file, where their names do not tell

# The observation, term by term: scale times (value - reference), then clipped. Also known:
# {{ name = "base_linear_velocity_b" }}; {{ name = "constant", values = [0.0] }};
# {{ name = "height_scan", reference = 0.5, clip = 1.0, size = [1.6, 1.0], spacing = 0.1, fastest = "x" }};
# {{ name = "gait_phase", period = 0.8, offsets = [0.0, 0.5], waves = ["sin", "cos"], at_rest = "runs" }} (or holds, zeros).
observation = [
{terms}
]
"""


def template(robot: Robot) -> str:
    """Return a commented ``contract.toml`` for a robot, which says what is assumed of a policy without a description."""
    contract = standard_contract(robot)

    def numbers(values: tuple[float, ...]) -> str:
        return json.dumps(values[0] if len(set(values)) == 1 else values)

    terms = ",\n".join(f'  {{ name = "{t.name}", scale = {numbers(t.scale)} }}' for t in contract.observation)
    return _TEMPLATE.format(
        robot=robot.name,
        joints=json.dumps(contract.joint_names),
        pose=json.dumps(contract.default_joint_position),
        scale=numbers(contract.action_scale),
        wheels=f"velocity_joints = {json.dumps(wheels)}"
        if (wheels := contract.velocity_joints)
        else "# velocity_joints = [...]",
        stiffness=numbers(contract.stiffness),
        damping=numbers(contract.damping),
        period=contract.control_period,
        limits=json.dumps(contract.command_limits),
        terms=terms + ",",
    )
