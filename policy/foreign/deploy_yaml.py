"""Reads a ``deploy.yaml`` as the exporters of unitree_rl_lab, unitree_rl_mjlab and RoboGauge's projects write it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...files.parsing import parse_yaml, read_text
from ...robots.base import Robot
from ..base import PolicyError
from ..contract import History, HistoryOrder, ObservationTerm, Part, PolicyContract, without_wheels
from ..observation_table import HEIGHT_SCAN, WITHOUT_WHEELS
from .bodies import fitting_robot, sdk_joints, wheels_of
from .terms import ISAAC_HEIGHT, checked, clip_before_scaling, listed, own_term, symmetric, usual_scan


def is_deploy(data: Mapping[str, Any]) -> bool:
    """Return whether a table is one."""
    return "joint_ids_map" in data and "actions" in data


def deploy_contract(path: Path, robot: Robot) -> PolicyContract:
    """Read a ``deploy.yaml``, see ``read_deploy``."""
    data = parse_yaml(read_text(path, "deploy file", PolicyError), f"'{path}'", PolicyError)
    if not isinstance(data, Mapping):
        raise PolicyError(f"'{path}' holds no table of settings")
    return read_deploy(data, path, robot)


def read_deploy(data: Mapping[str, Any], path: Path, asked: Robot | None, *, of_mjlab: bool = False) -> PolicyContract:
    """Return the contract that a ``deploy.yaml`` describes.

    In it ``stiffness`` and ``damping`` are in the order of the robot's SDK, everything else is in the policy's; entry i
    of ``joint_ids_map`` is the SDK's number of the policy's joint i. Histories are term-major unless
    ``use_gym_history`` is set, and start with copies of the first observation. Clipping comes before scaling unless
    ``scale_first`` is set; a clip of the action limits the joint target. ``JointVelocityAction`` drives wheels; lists of the
    legs alone are completed with the robot's gains and pose of its wheels. Without ``asked``, the robot is the Go2, or the one
    installed robot that fits.

    Args:
        of_mjlab: the policy's file has mjlab's metadata; unitree_rl_mjlab's gait phase is zero while the command is.

    Raises:
        PolicyError: the file is malformed, or asks for something that a contract cannot express.
    """
    with checked(path, "deploy.yaml"):
        turned = dict(data["actions"]).get(_TURNED) is not None
        joints = len(data["joint_ids_map"])

        def fits(robot: Robot) -> bool:
            return bool(robot.velocity_joints) if turned else robot.num_joints == joints

        feature = "wheels" if turned else f"{joints} joints"
        robot, chosen = (asked, None) if asked else fitting_robot(fits, feature, path)
        data, completed = _with_wheels(data, robot) if turned else (data, None)
        contract = _read(data, path, robot)
    assumed = [contract.provenance.get("assumed"), chosen, completed]
    if of_mjlab and any(term.name == "gait_phase" for term in contract.observation):
        terms = tuple(replace(t, at_rest="zeros") if t.name == "gait_phase" else t for t in contract.observation)
        contract = replace(contract, observation=terms)
        assumed.append("the gait phase is zero at rest, as unitree_rl_mjlab has it")
    told = "; ".join(filter(None, assumed))
    return replace(contract, provenance={**contract.provenance, "assumed": told}) if told else contract


def _with_wheels(data: Mapping[str, Any], robot: Robot) -> tuple[Mapping[str, Any], str | None]:
    """Return the settings with the wheels that an action numbers behind lists of the legs alone, and what was added, in words."""
    legs, numbered = list(data["joint_ids_map"]), robot.sdk_joint_names or ()
    wheels = sorted(listed(data["actions"][_TURNED].get("joint_ids"), -1))
    both = [*range(len(legs)), *wheels]
    if both != list(range(len(numbered))) or {numbered[i] for i in wheels} != set(robot.velocity_joints or ()):
        return data, None
    motors, index = robot.parameters[robot.default_parameters], [robot.joint_names.index(numbered[i]) for i in wheels]
    added = {
        "default_joint_pos": robot.default_joint_position,
        "stiffness": motors.stiffness,
        "damping": motors.damping,
    }
    complete = {**data, "joint_ids_map": [*legs, *wheels]}
    for key, own in added.items():
        if len(data[key]) == len(legs):
            complete[key] = [*data[key], *(own[i] for i in index)]
    return complete, f"gains of the wheels of robot '{robot.name}', because its lists hold {len(legs)} joints"


def _read(data: Mapping[str, Any], path: Path, robot: Robot) -> PolicyContract:
    names = sdk_joints(robot, list(data["joint_ids_map"]), path, "joint_ids_map")
    for key in ("default_joint_pos", "stiffness", "damping"):
        if len(data[key]) != len(names):
            raise PolicyError(
                f"'{path}' has {len(data[key])} values of {key}; {len(names)} are needed, one for each of joint_ids_map"
            )
    sdk = [int(i) for i in data["joint_ids_map"]]
    default = [float(v) for v in data["default_joint_pos"]]
    actions = dict(data["actions"])
    wheels = wheels_of(_wheels(actions, names, robot, path), robot, path)
    action = _joined(actions, default, names, wheels, path)
    offset = [float(v) for v in action["offset"]]
    moved = max((abs(o - d) for o, d in zip(offset, default, strict=True)), default=0.0) > 1e-6
    clip = action["clip"]
    ranges = ((data.get("commands") or {}).get("base_velocity") or {}).get("ranges") or {}
    axes = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    limits = [
        max(abs(float(v)) for v in ranges[axis]) if ranges.get(axis) else robot.command_limits[i]
        for i, axis in enumerate(axes)
    ]
    settings = dict(data["observations"])
    frame_major = bool(settings.pop("use_gym_history", False))
    scale_first = bool(settings.pop("scale_first", False))
    terms, lengths, assumed = [], [], []
    for name, term in settings.items():
        own, scale = own_term(name, path), tuple(float(s) for s in listed(term.get("scale"), 1.0))
        if name == WITHOUT_WHEELS:
            scale = without_wheels(scale, [joint in wheels for joint in names])
        clip_of_term = None
        if (given := term.get("clip")) is not None:
            limit = symmetric(float(given[0]), float(given[1]), name, path)
            clip_of_term = (limit,) if scale_first else clip_before_scaling(limit, scale)
        given = term.get("params") or {}
        period = float(given["period"]) if own == "gait_phase" else None
        height = None
        if own == HEIGHT_SCAN:
            height = float(given.get("offset", ISAAC_HEIGHT))
            assumed.append(usual_scan(height))
        reference = None if height is None else (height,)
        terms.append(ObservationTerm(name=own, scale=scale, clip=clip_of_term, period=period, reference=reference))
        lengths.append(int(term.get("history_length") or 1))
    longest = max(lengths, default=1)
    alike = len(set(lengths)) <= 1
    if frame_major and not alike:
        raise PolicyError(
            f"'{path}' gives its observations histories of different lengths {sorted(set(lengths))} in whole frames; one "
            "length is needed"
        )
    order: HistoryOrder = "frame-major" if frame_major or longest == 1 else "term-major"
    parts = () if alike else tuple(Part(terms=(t.name,), length=n) for t, n in zip(terms, lengths, strict=True))
    provenance = {"adapter": "deploy.yaml", "file": path.name}
    if missing := [axis for axis in axes if not ranges.get(axis)]:
        assumed.append(f"command limits of robot '{robot.name}' ({', '.join(missing)})")
    if assumed:
        provenance["assumed"] = "; ".join(assumed)
    return PolicyContract(
        robot=robot.name,
        joint_names=names,
        default_joint_position=tuple(default),
        action_scale=tuple(float(v) for v in action["scale"]),
        action_offset=tuple(offset) if moved else None,
        target_range=tuple((float(low), float(high)) for low, high in clip) if clip else None,
        stiffness=tuple(float(data["stiffness"][i]) for i in sdk),
        damping=tuple(float(data["damping"][i]) for i in sdk),
        control_period=float(data["step_dt"]),
        observation=tuple(terms),
        history=History(length=longest, order=order, start="repeat"),
        layout=parts,
        command_limits=(limits[0], limits[1], limits[2]),
        velocity_joints=wheels,
        provenance=provenance,
    )


_TURNED = "JointVelocityAction"
_ACTIONS = ("JointPositionAction", _TURNED)


def _wheels(actions: Mapping[str, Any], names: Sequence[str], robot: Robot, path: Path) -> Sequence[object]:
    """Return what a file says of the joints that it drives by velocity: their numbers in the policy's order, else names or patterns."""
    action = actions.get(_TURNED)
    if action is None:
        return []
    numbered = _joints(action, names, path) if robot.velocity_joints else []
    return numbered or listed(action.get("joint_names"), ".*")


def _joints(action: Mapping[str, Any], names: Sequence[str], path: Path) -> list[str]:
    """Return the joints that an action numbers in the policy's order; none where it means all that its kind fits."""
    ids = action.get("joint_ids")
    if not isinstance(ids, list) or None in ids:
        return []
    if not all(0 <= int(i) < len(names) for i in ids):
        raise PolicyError(
            f"'{path}' drives the joints {ids}; its joint_ids_map has {len(names)}, from 0 to {len(names) - 1}; both must agree"
        )
    return [names[int(i)] for i in ids]


def _joined(
    actions: Mapping[str, Any], default: Sequence[float], names: Sequence[str], wheels: Sequence[str], path: Path
) -> dict[str, list[Any]]:
    """Return scale, offset and clip of all joints; actions for legs and for wheels stand in the order in which the network gives them."""
    if not wheels:
        action, joints = actions["JointPositionAction"], len(names)
        offset = default if action.get("offset") is None else listed(action["offset"], 0.0, joints)
        return {"scale": listed(action.get("scale"), 1.0, joints), "offset": list(offset), "clip": action.get("clip")}
    found: dict[str, list[Any]] = {"scale": [], "offset": [], "clip": []}
    order: list[str] = []
    for kind in (kind for kind in actions if kind in _ACTIONS):
        action, turned = actions[kind], kind == _TURNED
        mine = _joints(action, names, path) or [n for n in names if (n in wheels) == turned]
        order += mine
        usual = [0.0 if turned else default[names.index(n)] for n in mine]
        found["scale"] += listed(action.get("scale"), 1.0, len(mine))
        found["offset"] += usual if action.get("offset") is None else listed(action["offset"], 0.0, len(mine))
        found["clip"] += action.get("clip") or [[-1000.0, 1000.0]] * len(mine)
    if order != list(names):
        raise PolicyError(
            f"'{path}' has actions for {', '.join(order)}, in this order; its joint_ids_map has {', '.join(names)}; both must agree"
        )
    limited = any(actions[kind].get("clip") for kind in actions if kind in _ACTIONS)
    return found | {"clip": found["clip"] if limited else []}
