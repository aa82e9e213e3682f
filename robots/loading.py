"""Read a robot from a ``robot.toml``.

The file's keys are the fields of ``Robot`` and, in ``[parameters.NAME]`` tables, of ``JointParameters``; keys with a default may
be absent. ``mjcf`` is relative to the file. A value per joint is one number for all joints, a list in the order of
``joint_names``, or a table by joint names or whole words of them (``calf`` fits ``FL_calf_joint``, ``hip`` fits
``left_hip_roll_joint``); the longest fitting key wins. A parameter set may begin with another one: ``like = "gauge"``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any
from xml.parsers import expat

from ..files.parsing import build, did_you_mean, one_line, parse_toml, read_text, shown
from ..files.provenance import digest
from ..files.writing import json_text
from .base import JointParameters, Robot

ROBOT_FILE = "robot.toml"
LARGEST_XML = 4_000_000
"""Largest size of one file of a model [bytes]."""
LARGEST_MODEL, MOST_FILES = 512 * 2**20, 2_000
"""Largest size of a model with its meshes and textures [bytes], and largest number of its files."""
MOST_PARTS = 2_000
"""Most parts of each kind; robots have some hundred."""
_PARTS = {"body": "bodies", "geom": "geoms", "site": "sites", "joint": "joints"}
_MOST_ELEMENTS, _MOST_CELLS = 10_000, 4_000_000
"""Most elements of all files, and most points of a height field, a texture or a mesh that MuJoCo makes itself."""
_CELLS = {"hfield": ("nrow", "ncol"), "texture": ("width", "height"), "mesh": ("params",)}
_JOINT_ENDING = "_joint"
PER_JOINT = tuple(f.name for f in fields(JointParameters) if f.name not in ("delay", "motor", "network", "measured"))
"""Fields of a parameter set with a value for each joint."""
_MEASURED = ("stiffness_factor", "damping_factor", "target_offset", "delay", "network", "measured")
_ASIDE = ("mjcf", "most_sag")
"""Fields that do not count for a robot's digest."""
_ADDED_LATER = ("foot_shapes", "action_scale", "imu_site", "driven_joints", "variants", "velocity_joints")
"""Fields that count for a robot's digest only where set, so that digests of older descriptions stay."""


class RobotError(ValueError):
    """A robot that cannot be found or has a wrong description; the message says what is wrong, where, and what to change."""


def load_robot_file(path: str | Path) -> Robot:
    """Read a robot from its description file and check that; ``check_robot`` compares it with the MuJoCo model.

    Args:
        path: a ``robot.toml`` (any file name), or a folder that holds one.

    Raises:
        RobotError: file or MuJoCo model missing, no valid TOML, a key missing, unknown, of the wrong type or out of range.
    """
    file = Path(path)
    try:
        file = file.expanduser()
        file = file / ROBOT_FILE if file.is_dir() else file
    except (OSError, RuntimeError) as error:
        raise RobotError(f"robot file '{one_line(file)}' cannot be read: {one_line(error)}") from error
    source = f"robot file '{one_line(file)}'"
    data = parse_toml(read_text(file, "robot file", RobotError), source, RobotError)
    names = data.get("joint_names")
    if isinstance(names, list) and all(isinstance(n, str) for n in names) and len(set(names)) == len(names):
        _spread(data, ("default_joint_position", "action_scale"), names, source)
        sets: Any = data.get("parameters")
        for name, table in sets.items() if isinstance(sets, dict) else ():
            if isinstance(table, dict):
                _begin_like(table, sets, f"{source}: parameters.{name}")
                _place_network(table, file.parent)
                _spread(table, PER_JOINT, names, f"{source}: parameters.{name}")
        _read_variants(data, names, source)
    elif isinstance(names, list):
        raise RobotError(f"{source}: joint_names must hold names, each once")
    if isinstance(data.get("mjcf"), str):
        data["mjcf"] = str(file.parent.resolve() / data["mjcf"])
    robot = build(Robot, data, source, RobotError)
    _check(robot, source)
    return robot


def _read_variants(data: dict[str, Any], joints: list[str], source: str) -> None:
    """Expand words of joint names in ``driven_joints``, and the pose of each variant, which begins with the robot's own."""
    pose, variants = data.get("default_joint_position"), data.get("variants")
    named = {f"variants.{name}": table for name, table in variants.items()} if isinstance(variants, dict) else {}
    for where, table in {"": data, **named}.items():
        if not isinstance(table, dict):
            continue
        place = f"{source}: {where}{'.' if where else ''}"
        if isinstance(driven := table.get("driven_joints"), list):
            for word in driven:
                if not any(isinstance(word, str) and fits(word, joint) for joint in joints):
                    raise RobotError(f"{place}driven_joints has {shown(word)}, neither a joint nor words of its name")
            table["driven_joints"] = [joint for joint in joints if any(fits(word, joint) for word in driven)]
        if where and isinstance(held := table.get("default_joint_position"), dict) and isinstance(pose, list):
            own = dict(zip(joints, pose, strict=False))
            table["default_joint_position"] = _by_key(held, joints, f"{place}default_joint_position", own)


def _begin_like(table: dict[str, Any], sets: dict[str, Any], where: str) -> None:
    """Fill a parameter set up with the values of the set that its ``like`` names, which stands before it in the file."""
    if (like := table.pop("like", None)) is None:
        return
    earlier = list(sets)[: next(i for i, other in enumerate(sets.values()) if other is table)]
    if like not in earlier:
        choice = f"choose from {', '.join(earlier)}" if earlier else "no set stands before it"
        raise RobotError(f"{where}.like is {shown(like)}, which is no parameter set before it; {choice}")
    for key, value in sets[like].items():
        table.setdefault(key, value)


def _place_network(table: dict[str, Any], folder: Path) -> None:
    """Let a relative path of a network lead from the folder of its description."""
    if isinstance(table.get("network"), str):
        table["network"] = str(folder.resolve() / table["network"])


def parameter_set(robot: Robot, table: Any, source: str, *, folder: Path) -> JointParameters:
    """Return a ``[parameters.NAME]`` table of a file in ``folder`` as a parameter set of the robot; ``RobotError``: it is wrong."""
    if not isinstance(table, dict):
        raise RobotError(f"{source} is {shown(table)}; it must be a table")
    table = dict(table)
    _place_network(table, folder)
    _spread(table, PER_JOINT, list(robot.joint_names), source)
    found = build(JointParameters, table, source, RobotError)
    for key in PER_JOINT:
        if (value := getattr(found, key)) is not None and len(value) != robot.num_joints:
            raise RobotError(f"{source}: {key} has {len(value)} values but there are {robot.num_joints} joints")
    _check_motors(found, robot.joint_names, f"{source}: ")
    return found


def checked_fields(robot: Robot, source: str) -> Robot:
    """Check the fields of a robot that Python code made; raise ``RobotError`` for a wrong type or a value out of range."""
    robot = build(Robot, asdict(robot) | {"mjcf": str(robot.mjcf)}, source, RobotError)
    _check(robot, source)
    return robot


def robot_digest(robot: Robot) -> str:
    """Return the SHA-256, hexadecimal, over the description, the MuJoCo model and all files that the model includes.

    Parameter sets that were measured do not count: they say how one machine moves, and results that use one record it.

    Raises:
        RobotError: a file cannot be read.
    """
    description = {k: v for k, v in asdict(robot).items() if k not in _ASIDE and not (v is None and k in _ADDED_LATER)}
    description["parameters"] = {
        name: {k: v for k, v in table.items() if k != "motor" and not (v is None and k in _MEASURED)}
        for name, table in description["parameters"].items()
        if table["measured"] is None
    }
    try:
        return digest(model_files(robot.mjcf), json_text(description))
    except OSError as error:
        raise RobotError(f"'{one_line(error.filename)}' cannot be read: {error.strerror}") from error


def model_files(mjcf: Path, *, within: Path | None = None) -> list[Path]:
    """Return a MuJoCo model's file and the files that it names: included models, meshes, textures, height fields, skins.

    A name that leads nowhere is left out; MuJoCo refuses such a model.

    Args:
        within: folder in which all must lie, links followed; None for anywhere.

    Raises:
        RobotError: a file cannot be read, is a pipe or a device, lies elsewhere, is not XML or defines entities; or the files,
            or the parts that they stand for, are too many or too large.
    """
    try:
        return _model_files(mjcf, within)
    except OSError as error:
        raise RobotError(f"'{one_line(error.filename)}' cannot be read: {error.strerror}") from error


def _model_files(mjcf: Path, within: Path | None) -> list[Path]:
    described = {mjcf: 1.0}  # the XML files, and the number of copies that MuJoCo makes of their elements
    found, size = {mjcf: None}, 0
    parts: dict[str, float] = {}
    pending = [mjcf]
    while pending:
        file = pending.pop(0)
        if within is not None and not file.resolve().is_relative_to(within):
            raise RobotError(f"the model names the file '{one_line(file)}', which is none of its own")
        if not os.path.isfile(file) and os.path.exists(file):  # MuJoCo would wait for a pipe, or read it without end
            raise RobotError(f"'{one_line(file)}' is not a regular file")
        size += file.stat().st_size
        if size > LARGEST_MODEL or len(found) > MOST_FILES:
            most = f"{LARGEST_MODEL // 2**20} MiB or {MOST_FILES:,} files, the most that is read of a robot"
            raise RobotError(f"'{one_line(mjcf)}' and the files that it names are over {most}")
        if file not in described and file.suffix.lower() not in (".xml", ".mjcf", ".urdf"):
            continue
        elements = _elements(file, described.get(file, 1.0))
        _count(elements, parts, file)
        folders = [mjcf.parent, file.parent]
        folders += [
            mjcf.parent / value
            for tag, attributes, _ in elements
            if tag == "compiler"
            for key, value in attributes.items()
            if key in ("meshdir", "texturedir", "assetdir")
        ]
        for tag, attributes, copies in elements:
            names = [value for key, value in attributes.items() if key.startswith("file")]
            for path in (folder / name for name in names for folder in folders):
                if path not in found and os.path.exists(path) and not os.path.isdir(path):
                    found[path] = None
                    pending.append(path)
                    if tag in ("include", "model"):  # MuJoCo reads these as XML, whatever their ending
                        described[path] = copies
    return list(found)


_Element = tuple[str, dict[str, str], float]
"""Tag, attributes, and number of copies that MuJoCo makes."""


def _count(elements: list[_Element], parts: dict[str, float], file: Path) -> None:
    """Add the elements' copies to ``parts``; raise ``RobotError`` for too many, since a line of XML can stand for a million."""
    for tag, attributes, copies in elements:
        if tag == "size":
            copies = _product(attributes.get("nkey", ""))
        cells = _product(" ".join(attributes.get(key, "") for key in _CELLS.get(tag, ())))
        if not cells <= _MOST_CELLS:
            points = f"{_told(cells)} points; at most {_MOST_CELLS:,} are made"
            raise RobotError(f"a <{tag}> of '{one_line(file)}' has {points}")
        for kind, most in ((_PARTS.get(tag), MOST_PARTS), ("elements", _MOST_ELEMENTS)):
            if kind is None:
                continue
            parts[kind] = parts.get(kind, 0.0) + copies
            if not parts[kind] <= most:
                made = f"{_told(parts[kind])} {kind} or more"
                raise RobotError(f"'{one_line(file)}' has {made}; at most {most:,} are simulated of a robot")


def _told(count: float) -> str:
    return f"{count:,.0f}" if count < 1e12 else f"{count:.0e}"


def _product(text: str) -> float:
    """Return the product of the numbers in a text, each at least 1; other words are left to MuJoCo."""
    found = 1.0
    for word in text.split():
        with suppress(ValueError):
            found *= max(abs(float(word)), 1.0)
    return found


def _elements(file: Path, copies: float) -> list[_Element]:
    """Return the elements of an XML file in order, the file itself counting ``copies`` times."""
    with file.open("rb") as opened:
        data = opened.read(LARGEST_XML + 1)
    if len(data) > LARGEST_XML:
        raise RobotError(f"'{one_line(file)}' is larger than {LARGEST_XML // 10**6} MB, the most read of a model")
    found: list[_Element] = []
    around = [copies]

    def begin(tag: str, attributes: dict[str, str]) -> None:
        own = attributes.get("count", "") if tag in ("replicate", "composite", "flexcomp") else ""
        made = around[-1] * _product(own)
        found.append((tag, attributes, around[-1]) if tag == "replicate" or not own else ("body", attributes, made))
        around.append(made)

    def entity(*_: object) -> None:  # a few lines of entities can stand for gigabytes
        raise RobotError(f"'{one_line(file)}' defines XML entities, which no robot needs; take them out")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, lambda tag: around.pop()
    parser.EntityDeclHandler = entity
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"'{one_line(file)}' is not XML: {one_line(error)}") from error
    return found


def _spread(table: dict[str, Any], keys: Any, joints: list[str], where: str) -> None:
    """Expand single values, and tables by the words of joint names, to one value per joint."""
    for key in keys:
        value = table.get(key)
        if isinstance(value, dict):
            table[key] = _by_key(value, joints, f"{where}.{key}" if "parameters" in where else f"{where}: {key}")
        elif value is not None and not isinstance(value, list):
            table[key] = [value] * len(joints)


def _by_key(
    table: Mapping[str, Any], joints: list[str], where: str, otherwise: Mapping[str, Any] | None = None
) -> list[Any]:
    """Return the value of each joint in a table by words of names; a joint without one gets the value ``otherwise``."""
    for key in table:
        if not any(fits(key, joint) for joint in joints):
            hint = did_you_mean(key, [j.removesuffix(_JOINT_ENDING) for j in joints])
            unknown = f"the key {shown(key)}, which is neither a joint nor words of its name{hint}"
            raise RobotError(f"{where} has {unknown}")
    values = []
    for joint in joints:
        fitting = [key for key in table if fits(key, joint)]
        if not fitting and otherwise is not None:
            values.append(otherwise[joint])
            continue
        if not fitting:
            raise RobotError(f"{where} has no value for the joint {shown(joint)}; add its name or words of it")
        values.append(table[max(fitting, key=len)])
    return values


def fits(key: str, joint: str) -> bool:
    """Return whether a key stands for the joint: the name, or whole words of it."""
    return f"_{key}_" in f"_{joint}_"


def _check(robot: Robot, source: str) -> None:
    """Refuse fields that contradict each other."""
    if not os.path.isfile(robot.mjcf):  # False for an impossible name, too
        lost = f"mjcf names '{one_line(robot.mjcf)}', which does not exist"
        raise RobotError(f"{source}: {lost}; the path is relative to the robot file")
    lists = ("joint_names", "foot_names", "collision_bodies", "trunk_shapes", "foot_shapes")
    for key in (*lists, "driven_joints", "velocity_joints"):
        names = robot.foot_geoms if key == "foot_shapes" else getattr(robot, key) or ()
        twice = [n for n in names if names.count(n) > 1]
        if twice:
            raise RobotError(f"{source}: {key} names {shown(twice[0])} twice")
    if robot.foot_shapes and len(robot.foot_shapes) != len(robot.foot_names):
        counts = f"foot_shapes has {len(robot.foot_shapes)} entries but foot_names has {len(robot.foot_names)}"
        raise RobotError(f"{source}: {counts}; give one name, or one list of names, for each foot")
    if strange := [n for n in robot.velocity_joints or () if n not in robot.joint_names]:
        raise RobotError(f"{source}: velocity_joints names {shown(strange[0])}, which is none of joint_names")
    per_joint: dict[str, tuple[float, ...]] = {"default_joint_position": robot.default_joint_position}
    if robot.action_scale is not None:
        per_joint["action_scale"] = robot.action_scale
    for name, each in (robot.variants or {}).items():
        if each.default_joint_position is not None:
            per_joint[f"variants.{name}.default_joint_position"] = each.default_joint_position
    for name, constants in robot.parameters.items():
        per_joint |= {f"parameters.{name}.{k}": v for k in PER_JOINT if (v := getattr(constants, k)) is not None}
    for key, values in per_joint.items():
        if len(values) != robot.num_joints:
            raise RobotError(f"{source}: {key} has {len(values)} values but there are {robot.num_joints} joints")
    for name, driven, angle in zip(
        robot.joint_names, robot.driven_by_velocity, robot.default_joint_position, strict=True
    ):
        if driven and angle:
            raise RobotError(
                f"{source}: default_joint_position of {shown(name)} is {angle:g}; of velocity_joints it is 0"
            )
    for name, constants in robot.parameters.items():
        _check_motors(constants, robot.joint_names, f"{source}: parameters.{name}.")
    if robot.sdk_joint_names and sorted(robot.sdk_joint_names) != sorted(robot.joint_names):
        odd = next((n for n in robot.sdk_joint_names if n not in robot.joint_names), None)
        problem = f"names {shown(odd)}, which is none of joint_names" if odd else "does not name each joint once"
        raise RobotError(f"{source}: sdk_joint_names {problem}; give every joint once, in the SDK's order of motors")
    sets = {f"variants.{name}.driven_joints": each.driven_joints for name, each in (robot.variants or {}).items()}
    for key, names in {"driven_joints": robot.driven_joints or (), **sets}.items():
        for name in names:
            if name not in robot.joint_names:
                raise RobotError(f"{source}: {key} names {shown(name)}, which is none of joint_names")
    if robot.default_parameters not in robot.parameters:
        known = ", ".join(robot.parameters)
        raise RobotError(f"{source}: default_parameters is {shown(robot.default_parameters)}; choose from: {known}")


def _check_motors(constants: JointParameters, joints: tuple[str, ...], where: str) -> None:
    """Refuse an incomplete or rising curve of torque over speed."""
    if (constants.motor == "network") != (constants.network is not None):
        raise RobotError(f'{where}motor = "network" and network, its file, belong together; give both or neither')
    if constants.motor != "law" and constants.measured is None:
        raise RobotError(f"{where}motor is {shown(constants.motor)} without measured; say where the motors come from")
    full, none, driving = constants.full_torque_speed, constants.no_load_speed, constants.driving_torque_limit
    if (full is None) != (none is None):
        raise RobotError(f"{where}full_torque_speed and no_load_speed belong together; give both or neither")
    for i, joint in enumerate(joints):
        if full and none and full[i] >= none[i]:
            problem = f"is {full[i]:g} rad/s for {joint} but must be below no_load_speed, {none[i]:g}"
            raise RobotError(f"{where}full_torque_speed {problem}")
        if driving and driving[i] > constants.torque_limit[i]:
            most = f"must not be above torque_limit, {constants.torque_limit[i]:g}"
            raise RobotError(f"{where}driving_torque_limit is {driving[i]:g} N·m for {joint} but {most}")
