"""Reads the ``params/env.yaml`` that Isaac Lab leaves in a run, with the ``agent.yaml`` beside it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...files.parsing import parse_yaml, read_text, shown
from ...robots.base import Robot
from ..base import PolicyError
from ..contract import History, ObservationTerm, Part, PolicyContract, without_wheels
from ..observation_table import HEIGHT_SCAN, WITHOUT_WHEELS
from .bodies import breadth_first, by_pattern, choose_robot, wheels_of
from .terms import checked, clip_before_scaling, listed, symmetric

_FUNCTIONS = {
    "base_lin_vel": "base_linear_velocity_b",
    "base_ang_vel": "base_angular_velocity_b",
    "projected_gravity": "projected_gravity_b",
    "generated_commands": "command",
    "joint_pos_rel": "joint_position",
    "joint_pos": "joint_position",
    WITHOUT_WHEELS: "joint_position",
    "joint_vel_rel": "joint_velocity",
    "joint_vel": "joint_velocity",
    "last_action": "last_action",
    "height_scan": HEIGHT_SCAN,
    "gait_phase": "gait_phase",
    "phase": "gait_phase",
}
"""Isaac Lab's functions of observations, and the project's terms."""


def is_env(data: Mapping[str, Any]) -> bool:
    """Return whether a table is one."""
    return {"scene", "observations", "actions", "decimation"} <= data.keys()


def read_env(data: Mapping[str, Any], path: Path, asked: Robot | None) -> PolicyContract:
    """Return the contract that an ``env.yaml`` describes.

    Joints are in Isaac Lab's order, those nearest to the base first. Histories are term-major and start with copies of the first
    observation; clipping comes before scaling; a clip of the action limits the joint target. ``clip_actions`` of the
    ``agent.yaml`` limits the network's output. Joints stand in the actions' own order where these preserve it; a
    JointVelocityAction drives wheels.

    Raises:
        PolicyError: the file is malformed, is for another robot, or asks for something that a contract cannot express.
    """
    with checked(path, "Isaac Lab's env.yaml"):
        body = data["scene"]["robot"]
        asset = str((body.get("spawn") or {}).get("usd_path") or (body.get("spawn") or {}).get("asset_path") or "")
        named = re.search(r"([A-Za-z0-9_-]+)\.(usda?|urdf|xml)$", asset)
        return _read(data, path, choose_robot(asked, None if named is None else _short(named[1]), path))


def _short(name: str) -> str:
    """Return a robot's name without its maker's and without what follows it."""
    return re.sub(r"^(unitree|anymal)_(?=\w)", lambda m: "" if m[1] == "unitree" else m[0], name.lower()).split(
        "_minimal"
    )[0]


def _read(data: Mapping[str, Any], path: Path, robot: Robot) -> PolicyContract:
    names = breadth_first(robot)
    body = data["scene"]["robot"]
    gains: dict[str, list[Any]] = {"stiffness": [None] * len(names), "damping": [None] * len(names)}
    for group in body["actuators"].values():
        mine = [n for n in names if any(re.fullmatch(p, n) for p in listed(group["joint_names_expr"], ".*"))]
        for entry, values in gains.items():
            given = group[entry]
            table = given if isinstance(given, Mapping) else dict.fromkeys(map(re.escape, mine), given)
            for name, value in zip(mine, by_pattern(table, mine, None, path, entry), strict=True):
                values[names.index(name)] = value
    if None in gains["stiffness"]:
        raise PolicyError(
            f"'{path}' has no actuator for joint '{names[gains['stiffness'].index(None)]}' of robot '{robot.name}'"
        )
    default = by_pattern(body["init_state"]["joint_pos"], names, 0.0, path, "init_state.joint_pos")
    position = [a for a in data["actions"].values() if "JointPositionAction" in str(a.get("class_type"))]
    turning = [a for a in data["actions"].values() if "JointVelocityAction" in str(a.get("class_type"))]
    wheels = wheels_of([n for a in turning for n in listed(a.get("joint_names"), ".*")], robot, path)
    actions = [*position, *turning]
    if len(position) != 1 or len(turning) > 1 or len(data["actions"]) > len(actions):
        kinds = ", ".join(str(a.get("class_type")).rpartition(":")[2] for a in data["actions"].values())
        raise PolicyError(
            f"'{path}' has the actions {kinds}; one JointPositionAction, and a JointVelocityAction of wheels, are supported"
        )
    ordered: list[str] = []
    scale, offset, ranges = (list[Any]() for _ in range(3))
    for action in (a for a in data["actions"].values() if a in actions):
        asked = listed(action.get("joint_names"), ".*")
        mine = [n for n in names if any(re.fullmatch(p, n) for p in asked)]
        if action.get("preserve_order"):
            mine = [n for p in asked for n in names if re.fullmatch(p, n)]

        def spread(value: Any, entry: str, missing: Any = 0.0, mine: Sequence[str] = mine) -> list[Any]:
            return by_pattern(value if isinstance(value, Mapping) else {".*": value}, mine, missing, path, entry)

        ordered += mine
        scale += spread(action.get("scale", 1.0), "scale")
        by_default = action.get("use_default_offset", True) and action in position
        usual = [default[names.index(n)] for n in mine]
        offset += usual if by_default else spread(action.get("offset") or 0.0, "offset")
        free = (-1000.0, 1000.0)
        ranges += spread(action["clip"], "clip", free) if action.get("clip") else [free] * len(mine)
    if sorted(ordered) != sorted(names):
        raise PolicyError(f"'{path}' moves some joints of robot '{robot.name}' alone; all of them are needed")
    in_order = ordered == list(names)
    if not in_order and not all(a.get("preserve_order") for a in actions):
        raise PolicyError(
            f"'{path}' moves joints in the order {', '.join(ordered)}; preserve_order must be true for this"
        )
    index = [names.index(n) for n in ordered]
    default, names = [default[i] for i in index], tuple(ordered)
    gains = {entry: [values[i] for i in index] for entry, values in gains.items()}
    moved = None if list(map(float, offset)) == list(map(float, default)) else tuple(float(v) for v in offset)
    terms, parts, longest = _observation(data, path, names, wheels, in_order=in_order)
    limits, missing = _limits(data, robot)
    assumed = ["joints nearest to the base first, as Isaac Lab lists them"] if in_order else []
    if missing:
        assumed.append(f"command limits of robot '{robot.name}'")
    return PolicyContract(
        robot=robot.name,
        joint_names=names,
        default_joint_position=tuple(float(v) for v in default),
        action_scale=tuple(float(v) for v in scale),
        action_offset=moved,
        action_clip=_action_clip(path),
        target_range=tuple((float(a), float(b)) for a, b in ranges) if any(a.get("clip") for a in actions) else None,
        stiffness=tuple(float(v) for v in gains["stiffness"]),
        damping=tuple(float(v) for v in gains["damping"]),
        control_period=round(float(data["sim"]["dt"]) * int(data["decimation"]), 9),
        observation=terms,
        history=History(length=longest, order="frame-major" if longest == 1 else "term-major", start="repeat"),
        layout=parts,
        command_limits=limits,
        velocity_joints=wheels,
        provenance={"adapter": "Isaac Lab env.yaml", "file": path.name, "assumed": ", ".join(assumed)},
    )


def _observation(
    data: Mapping[str, Any], path: Path, names: Sequence[str], wheels: Sequence[str], *, in_order: bool
) -> tuple[tuple[ObservationTerm, ...], tuple[Part, ...], int]:
    """Return the terms, the parts where histories differ, and the longest history.

    Args:
        names, wheels: the policy's joints in its order, and those of them that are wheels.
        in_order: the order is Isaac Lab's own; else terms by joint must say the same one.
    """
    terms, lengths, group = [], [], data["observations"]["policy"]
    for name, term in group.items():
        if not isinstance(term, Mapping) or "func" not in term:
            continue  # settings of the whole group, and terms that were switched off
        function = str(term["func"]).rpartition(":")[2]
        if function not in _FUNCTIONS:
            raise PolicyError(
                f"'{path}' asks for the observation {shown(name)} ({function}); supported are: {', '.join(_FUNCTIONS)}"
            )
        scale = tuple(float(v) for v in listed(term.get("scale"), 1.0))
        config = (term.get("params") or {}).get("asset_cfg") or {}
        same = config.get("preserve_order") and config.get("joint_names") == list(names)
        if function.startswith("joint_") and not in_order and not same:
            raise PolicyError(
                f"'{path}' moves joints in an order of its own, and the observation {shown(name)} does not have it; give both "
                "the same joint_names with preserve_order"
            )
        if function == WITHOUT_WHEELS:
            scale = without_wheels(scale, [joint in wheels for joint in names])
        scan = _scan(term, data["scene"], path) if function == HEIGHT_SCAN else {}
        limit = (
            None if term.get("clip") is None else symmetric(float(term["clip"][0]), float(term["clip"][1]), name, path)
        )
        terms.append(
            ObservationTerm(
                name=_FUNCTIONS[function],
                scale=scale,
                clip=None if limit is None else clip_before_scaling(limit, scale),
                reference=scan.pop("reference", (0.0,) if function == "joint_pos" else None),
                period=float(term["params"]["period"]) if _FUNCTIONS[function] == "gait_phase" else None,
                **scan,
            )
        )
        lengths.append(max(int(group.get("history_length") or term.get("history_length") or 0), 1))
    alike = len(set(lengths)) <= 1
    parts = () if alike else tuple(Part(terms=(t.name,), length=n) for t, n in zip(terms, lengths, strict=True))
    return tuple(terms), parts, max(lengths, default=1)


def _scan(term: Mapping[str, Any], scene: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the grid of a height scan, and the height of the base that it calls zero; ``PolicyError``: it is no grid below the base."""
    given = term.get("params") or {}
    sensor = scene[(given.get("sensor_cfg") or {}).get("name") or "height_scanner"]
    pattern, place = sensor["pattern_cfg"], ((sensor.get("offset") or {}).get("pos") or (0.0, 0.0, 0.0))
    turned = sensor.get("ray_alignment", "yaw" if sensor.get("attach_yaw_only", True) else "base")
    if "grid_pattern" not in str(pattern.get("func", "grid_pattern")) or any(place[:2]) or turned != "yaw":
        raise PolicyError(
            f"'{path}' has a height scan that is no grid about the base which turns with the heading; only such a grid is supported"
        )
    size = (float(pattern["size"][0]), float(pattern["size"][1]))
    fastest = "x" if pattern.get("ordering", "xy") == "xy" else "y"
    offset = float(given.get("offset", 0.5))
    return {"size": size, "spacing": float(pattern["resolution"]), "fastest": fastest, "reference": (offset,)}


def _limits(data: Mapping[str, Any], robot: Robot) -> tuple[tuple[float, float, float], bool]:
    """Return the largest commands, and whether the file does not say them all."""
    commands = data.get("commands") or {}
    velocity = next(
        (c for c in commands.values() if isinstance(c, Mapping) and "lin_vel_x" in (c.get("ranges") or {})), {}
    )
    ranges = velocity.get("limit_ranges") or velocity.get("ranges") or {}
    axes = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    found = [
        max(abs(float(v)) for v in ranges[a]) if ranges.get(a) else robot.command_limits[i] for i, a in enumerate(axes)
    ]
    return (found[0], found[1], found[2]), any(not ranges.get(a) for a in axes)


def _action_clip(path: Path) -> float | None:
    """Return the ``clip_actions`` of the ``agent.yaml`` beside an ``env.yaml``."""
    agent = path.with_name("agent.yaml")
    if not agent.is_file():
        return None
    data = parse_yaml(read_text(agent, "training configuration", PolicyError), f"'{agent}'", PolicyError)
    found = data.get("clip_actions") if isinstance(data, Mapping) else None
    return float(found) if found else None
