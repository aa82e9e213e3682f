"""Read logs: the project's own ``.npz`` and CSV, the CSV files of the published C++ controller and of rl_sar, and MCAP.

Joints and signs are mapped by name. A file without names needs a map (``LogMap``), a small TOML file. Torques that a logger
computed with the motor law (``tau`` of the C++ controller, ``tau_cal`` of rl_sar) are never read as measurements.
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ...files.parsing import Text, did_you_mean, one_line, read_text, read_toml, shown
from ...robots import Robot, load_robot, robot_names
from .log import HELD, Log, LogError, make_log

LARGEST_LOG = 500_000_000
"""Largest size of a log, unpacked [bytes]."""
FIELDS = {
    "target": ("target", "des_dof_pos", "q_des", "joint_pos_target"),
    "position": ("position", "dof_pos", "q", "joint_pos"),
    "velocity": ("velocity", "dof_vel", "dq", "joint_vel"),
    "torque": ("torque", "tau_est"),
    "stiffness": ("stiffness", "kp"),
    "damping": ("damping", "kd"),
}
"""Names of a joint's columns in files, the project's own first."""
_JOINT = "_joint"
_SERIES = ("target", "position", "velocity", "torque")
_BASE = {"quaternion": "wxyz", "angular_velocity": "xyz"}

_Gain = Annotated[float, Field(ge=0.0, le=10_000.0)]
_Sign = Annotated[int, Field(ge=-1, le=1)]


@dataclass(frozen=True, kw_only=True)
class LogMap:
    """Settings that a file does not hold. Joint names may lack the ending ``_joint``."""

    robot: Text | None = None
    """Robot's name or ``robot.toml``."""
    joints: tuple[Text, ...] | None = None
    """Joints in the order of the columns of positions, velocities and torques."""
    target_joints: tuple[Text, ...] | None = None
    """Joints in the order of the columns of targets; None for ``joints``."""
    signs: Mapping[Text, _Sign] = field(default_factory=dict)
    """−1 for each joint that turns the other way in the file."""
    stiffness: _Gain | tuple[_Gain, ...] | None = None
    """kp sent to the motors [N·m/rad], one or in the order of ``joints``."""
    damping: _Gain | tuple[_Gain, ...] | None = None
    """kd sent to the motors [N·m·s/rad]."""
    held: Literal["hung", "standing", "walking"] | None = None
    """How the robot was held."""
    period: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    """Time between rows of a file without times [s]."""
    topics: Mapping[Text, Text] = field(default_factory=dict)
    """MCAP: for each of ``target``, ``position``, ``velocity``, ``torque``, ``quaternion`` and ``angular_velocity`` the topic
    and the field, ``/lowstate:motor_state.q``."""

    def __post_init__(self) -> None:
        if (zero := next((joint for joint, sign in self.signs.items() if sign == 0), None)) is not None:
            raise ValueError(f"signs.{zero} is 0; it must be 1 or -1")


def read_map(path: Path) -> LogMap:
    """Read a map; raise ``LogError`` where it is missing or wrong."""
    return read_toml(path, LogMap, "map", LogError, source=f"map '{one_line(path)}'")


def read_log(path: Path, *, robot: str | None = None, mapping: LogMap | None = None, held: str | None = None) -> Log:
    """Read, check and clean a log.

    Args:
        path: ``.npz``, ``.csv`` or ``.mcap``.
        robot: name or description file; None for the one that the log or the map names, or that has these joints.
        mapping: what the file does not say; it goes before the file.
        held: one of ``HELD``, before map and file.

    Raises:
        LogError: the file is missing, damaged, incomplete, of another robot, or in other units.
        RobotError: no such robot.
    """
    source = f"log '{one_line(path)}'"
    mapping = mapping or LogMap()
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise LogError(f"{source} ends in '{one_line(path.suffix)}'; logs end in {', '.join(_READERS)}")
    if not path.is_file():
        raise LogError(f"{source} {'is not a file' if path.exists() else 'does not exist'}")
    if path.stat().st_size > LARGEST_LOG:
        raise LogError(f"{source} is larger than {LARGEST_LOG / 1e6:g} MB; cut it")
    try:
        raw = reader(path, mapping, source)
    except OSError as problem:
        raise LogError(f"{source} cannot be read: {problem.strerror}") from problem
    machine = _robot(robot or mapping.robot or raw.robot, raw.joints, source)
    columns = dict(raw.columns)
    order = _order(raw.joints, machine, source)
    target_order = _order(raw.target_joints, machine, source)
    signs = np.ones(machine.num_joints)
    for joint, sign in mapping.signs.items():
        signs[_index(joint, machine.joint_names, f"{source}: signs")] = sign
    for key in ("stiffness", "damping"):
        columns[key] = _gains(key, columns.get(key), getattr(mapping, key), order, source)
    for key in _SERIES:
        if (value := columns.get(key)) is not None:
            columns[key] = value[:, target_order if key == "target" else order] * signs
    columns["held"] = held or mapping.held or raw.held
    if columns["held"] not in (None, *HELD):
        raise LogError(f"{source}: held is {shown(columns['held'])}; it must be {', '.join(HELD)}")
    return make_log(path.name, machine, columns, notes=raw.notes)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Raw:
    """A file's content before joints are sorted."""

    columns: Mapping[str, Any]
    joints: tuple[str, ...]
    target_joints: tuple[str, ...]
    robot: str | None = None
    held: str | None = None
    notes: tuple[str, ...] = ()


# ---- joints ------------------------------------------------------------------------------------------------------------


def _short(joint: str) -> str:
    return joint.removesuffix(_JOINT)


def _index(joint: str, names: Sequence[str], where: str) -> int:
    short = [_short(name) for name in names]
    if _short(joint) not in short:
        raise LogError(
            f"{where} names the joint {shown(joint)}{did_you_mean(_short(joint), short)}, which the robot lacks"
        )
    return short.index(_short(joint))


def _robot(asked: str | None, joints: Sequence[str], source: str) -> Robot:
    """Return the robot that was asked for, else the installed one with these joints."""
    if asked is not None:
        return load_robot(asked)
    wanted = {_short(joint) for joint in joints}
    fitting = [n for n in robot_names() if {_short(j) for j in load_robot(n, check=False).joint_names} == wanted]
    if not fitting:
        few = ", ".join(list(joints)[:3])
        raise LogError(f"{source} has the joints {few} …, which no installed robot has; name the robot with --robot")
    if len(fitting) > 1:
        raise LogError(
            f"{source} does not say which robot it is of, and {' and '.join(fitting)} have these joints; use --robot"
        )
    return load_robot(fitting[0])


def _order(joints: Sequence[str], robot: Robot, source: str) -> NDArray[np.int64]:
    """Return the file's column of each joint of the robot."""
    if len(joints) != robot.num_joints or {_short(j) for j in joints} != {_short(j) for j in robot.joint_names}:
        odd = sorted({_short(j) for j in joints} ^ {_short(j) for j in robot.joint_names})
        differ = (
            f"{', '.join(odd[:4])} differ" if odd else f"it has {len(joints)} columns of joints for {robot.num_joints}"
        )
        raise LogError(f"{source} is not of robot '{robot.name}': {differ}; choose the robot with --robot")
    return np.array([_index(joint, joints, source) for joint in robot.joint_names])


def _gains(key: str, own: Any, mapped: Any, order: NDArray[np.int64], source: str) -> NDArray[np.float64]:
    value = own if mapped is None else mapped
    if value is None:
        raise LogError(f"{source} does not say with which {key} the motors ran; give it in a map (--map, {key} = …)")
    gains = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if gains.ndim > 1:
        if (gains != gains[:1]).any():
            raise LogError(
                f"{source}: {key} changes during the log; cut it where the gains are constant (--from, --to)"
            )
        gains = gains[0]
    if len(gains) not in (1, len(order)):
        raise LogError(f"{source}: {key} has {len(gains)} values for {len(order)} joints")
    return np.full(len(order), gains[0]) if len(gains) == 1 else gains[order]


# ---- formats -----------------------------------------------------------------------------------------------------------


def _read_npz(path: Path, mapping: LogMap, source: str) -> _Raw:
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST_LOG:
                raise LogError(f"{source} is larger than {LARGEST_LOG / 1e6:g} MB; cut it")
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in file.files}
    except (ValueError, zipfile.BadZipFile, EOFError, KeyError) as problem:
        raise (
            problem if isinstance(problem, LogError) else LogError(f"{source} is no .npz file: {one_line(problem)}")
        ) from problem
    names = mapping.joints or (tuple(map(str, data["joint_names"].ravel())) if "joint_names" in data else None)
    if names is None:
        raise LogError(f"{source} lacks joint_names; add them, or give joints in a map (--map)")
    columns: dict[str, Any] = {}
    for key, known in FIELDS.items():
        found = next((data[name] for name in known if name in data), None)
        if found is not None:
            columns[key] = _numbers(found, key, source)
    for key in ("time", *_BASE):
        if key in data:
            columns[key] = _numbers(data[key], key, source)
    _check_shapes(columns, len(names), source)
    robot, held = (str(data[key].item()) if key in data and data[key].size == 1 else None for key in ("robot", "held"))
    return _Raw(columns=columns, joints=names, target_joints=mapping.target_joints or names, robot=robot, held=held)


def _numbers(value: Any, key: str, source: str) -> NDArray[np.float64]:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as problem:
        raise LogError(f"{source}: {key} holds {shown(value)}; it must hold numbers") from problem


def _check_shapes(columns: Mapping[str, Any], joints: int, source: str) -> None:
    for key in ("time", "target", "position"):
        if key not in columns:
            raise LogError(f"{source} lacks {key}; it has {', '.join(columns) or 'nothing that is known'}")
    rows = len(np.atleast_1d(columns["time"]))
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_SERIES, (rows, joints)) | {"time": (rows,)}
    shapes |= {key: (rows, len(axes)) for key, axes in _BASE.items()}
    for key, value in columns.items():
        if key in shapes and value.shape != shapes[key]:
            raise LogError(f"{source}: {key} has the shape {value.shape}; it must be {shapes[key]}")


def _read_csv(path: Path, mapping: LogMap, source: str) -> _Raw:
    """Read one of the three kinds of CSV; the header tells which."""
    text = read_text(path, "log", LogError, largest=LARGEST_LOG)
    rows = list(csv.reader(io.StringIO(text)))
    if not rows:
        raise LogError(f"{source} is empty; a log begins with the names of its columns")
    header = [name.strip() for name in rows[0]]
    body = [row for row in rows[1:] if any(row)]
    table = {name: i for i, name in enumerate(header) if name}

    def numbers(names: Sequence[str]) -> NDArray[np.float64]:
        places = [table[name] for name in names]
        return np.array([[_number(row[i]) if i < len(row) else np.nan for i in places] for row in body]).reshape(
            -1, len(places)
        )

    for kind in (_cpp_controller, _rl_sar, _own_csv):
        if (raw := kind(table, numbers, mapping, source)) is not None:
            break
    else:
        known = "time, target_JOINT, position_JOINT; time, q_des_0, q_0; joint_pos_0, joint_pos_target_0"
        raise LogError(f"{source} has the columns {shown(', '.join(header))}; known are {known} …")
    held = raw.held
    if "held" in table and body:
        held = body[0][table["held"]].strip() or held
    return _Raw(**{**vars(raw), "held": held})


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


_Numbers = Callable[[Sequence[str]], NDArray[np.float64]]


def _own_csv(table: Mapping[str, int], numbers: _Numbers, mapping: LogMap, source: str) -> _Raw | None:
    joints = tuple(name.removeprefix("position_") for name in table if name.startswith("position_"))
    if "time" not in table or not joints:
        return None
    columns: dict[str, Any] = {"time": numbers(["time"])[:, 0]}
    for key in FIELDS:
        names = [f"{key}_{joint}" for joint in joints]
        lacking = [name for name in names if name not in table]
        if not lacking:
            columns[key] = numbers(names)
        elif len(lacking) < len(names) or key == "target":
            raise LogError(f"{source} lacks the column {shown(lacking[0])}")
    for key, axes in _BASE.items():
        if all(f"{key}_{axis}" in table for axis in axes):
            columns[key] = numbers([f"{key}_{axis}" for axis in axes])
    return _Raw(columns=columns, joints=joints, target_joints=joints)


def _cpp_controller(table: Mapping[str, int], numbers: _Numbers, mapping: LogMap, source: str) -> _Raw | None:
    """Read the published C++ controller's file: targets in the policy's order, the rest in the motors' order of the SDK."""
    count = _counted("q_", table)
    if "time" not in table or "q_des_0" not in table or not count:
        return None
    columns: dict[str, Any] = {"time": numbers(["time"])[:, 0]}
    for key, prefix in (("target", "q_des_"), ("position", "q_"), ("velocity", "dq_")):
        if f"{prefix}{count - 1}" in table:
            columns[key] = numbers([f"{prefix}{i}" for i in range(count)])
    if all(f"ang_vel_{i}" in table for i in range(3)):
        columns["angular_velocity"] = numbers([f"ang_vel_{i}" for i in range(3)])
    if all(f"imu_rpy_{i}" in table for i in range(3)):
        columns["quaternion"] = _quaternion(numbers([f"imu_rpy_{i}" for i in range(3)]))
    joints, targets = _mapped_joints(mapping, count, source, "q_0 …")
    notes = ("its 'tau' is the motor law's and was not read as a measurement",) if "tau_0" in table else ()
    return _Raw(columns=columns, joints=joints, target_joints=targets, notes=notes)


def _rl_sar(table: Mapping[str, int], numbers: _Numbers, mapping: LogMap, source: str) -> _Raw | None:
    """Read rl_sar's file, which has neither times nor names."""
    count = _counted("joint_pos_", table)
    if "joint_pos_target_0" not in table or not count:
        return None
    columns: dict[str, Any] = {}
    for key, prefix in (("target", "joint_pos_target_"), ("position", "joint_pos_"), ("velocity", "joint_vel_")):
        columns[key] = numbers([f"{prefix}{i}" for i in range(count)])
    if mapping.period is None:
        raise LogError(f"{source} has no times; give the time between its rows in a map (--map, period = 0.02)")
    columns["time"] = np.arange(len(columns["position"])) * mapping.period
    joints, targets = _mapped_joints(mapping, count, source, "joint_pos_0 …")
    notes = ("its 'tau_cal' and 'tau_est' were not read as measurements: they are the motor law's or unchecked",)
    return _Raw(columns=columns, joints=joints, target_joints=targets, notes=notes)


def _counted(prefix: str, table: Mapping[str, int]) -> int:
    count = 0
    while f"{prefix}{count}" in table:
        count += 1
    return count


def _mapped_joints(mapping: LogMap, count: int, source: str, columns: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if mapping.joints is None:
        raise LogError(
            f"{source} numbers its columns {columns} without names; give joints in their order in a map (--map)"
        )
    targets = mapping.target_joints or mapping.joints
    for key, names in (("joints", mapping.joints), ("target_joints", targets)):
        if len(names) != count:
            raise LogError(f"{source} has columns of {count} joints, but {key} of the map names {len(names)}")
    return mapping.joints, targets


def _quaternion(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions wxyz of roll, pitch and yaw [rad], (T, 3)."""
    from scipy.spatial.transform import Rotation

    found: NDArray[np.float64] = Rotation.from_euler("xyz", angles).as_quat(scalar_first=True)
    return found


# ---- MCAP --------------------------------------------------------------------------------------------------------------


def _read_mcap(path: Path, mapping: LogMap, source: str) -> _Raw:
    """Read an MCAP file: JSON or ROS 2 messages."""
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError as problem:
        raise LogError(f"{source} takes the library mcap; install it with: pip install 'gaitgauge[mcap]'") from problem
    if mapping.joints is None or not {"target", "position"} <= set(mapping.topics):
        raise LogError(f"{source} takes a map with joints, topics.target and topics.position (--map)")
    if unknown := set(mapping.topics) - {*_SERIES, *_BASE}:
        raise LogError(f"{source}: topics.{min(unknown)} is unknown; choose from {', '.join((*_SERIES, *_BASE))}")
    places = {key: (text.partition(":")[0], text.partition(":")[2]) for key, text in mapping.topics.items()}
    series: dict[str, tuple[list[float], list[list[float]]]] = {key: ([], []) for key in places}
    seen: set[str] = set()
    with path.open("rb") as file:
        try:
            for schema, channel, message in make_reader(file).iter_messages():
                seen.add(channel.topic)
                wanted = [key for key, (topic, _) in places.items() if topic == channel.topic]
                if not wanted:
                    continue
                content = _decoded(schema, channel, message.data, source)
                for key in wanted:
                    series[key][0].append(message.log_time * 1e-9)
                    series[key][1].append(_dig(content, places[key][1], f"{source}: topics.{key}"))
        except McapError as problem:
            raise LogError(f"{source} is no MCAP file or is damaged: {one_line(problem)}") from problem
    for key, (times, _) in series.items():
        if not times:
            topics = ", ".join(sorted(seen)[:8]) or "none"
            raise LogError(f"{source} has no message on the topic '{places[key][0]}' (topics.{key}); it has {topics}")
    columns: dict[str, Any] = {"time": np.array(series["position"][0])}
    for key, (times, values) in series.items():
        if len({len(v) for v in values}) != 1:
            raise LogError(f"{source}: topics.{key} holds lists of different lengths")
        # the newest message at the time of each position: what the program knew then
        newest = np.searchsorted(times, columns["time"], side="right") - 1
        columns[key] = np.array(values)[np.clip(newest, 0, None)]
    _check_shapes(columns, len(mapping.joints), source)
    return _Raw(columns=columns, joints=mapping.joints, target_joints=mapping.target_joints or mapping.joints)


def _decoded(schema: Any, channel: Any, data: bytes, source: str) -> Any:
    if channel.message_encoding == "json":
        try:
            return json.loads(data)
        except ValueError as problem:
            raise LogError(
                f"{source}: a message on '{channel.topic}' is not valid JSON: {one_line(problem)}"
            ) from problem
    if channel.message_encoding == "cdr":
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ImportError as problem:
            lacking = "its messages are ROS 2's; install their reader with: pip install 'gaitgauge[mcap]'"
            raise LogError(f"{source}: {lacking}") from problem
        decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
        if decode is not None:
            return decode(data)
    raise LogError(
        f"{source}: messages on '{channel.topic}' are encoded as '{channel.message_encoding}'; json and cdr are read"
    )


def _dig(content: Any, path: str, where: str) -> list[float]:
    """Return the list at a dotted path; a step into a list of records collects that field of each of them."""
    for step in path.split("."):
        try:
            if isinstance(content, list | tuple):
                content = [entry[step] if isinstance(entry, Mapping) else getattr(entry, step) for entry in content]
            else:
                content = content[step] if isinstance(content, Mapping) else getattr(content, step)
        except (KeyError, AttributeError) as problem:
            raise LogError(f"{where}: messages have no field '{step}' of '{path}'") from problem
    try:
        return [float(value) for value in content]
    except (TypeError, ValueError) as problem:
        raise LogError(f"{where}: '{path}' is {shown(content)}; it must be a list of numbers") from problem


_READERS: dict[str, Callable[[Path, LogMap, str], _Raw]] = {".npz": _read_npz, ".csv": _read_csv, ".mcap": _read_mcap}
