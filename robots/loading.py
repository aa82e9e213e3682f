"""Reads a robot from a ``robot.toml``.

The file's keys are the fields of ``Robot`` and, in ``[parameters.NAME]`` tables, those of ``JointParameters``; all must
be there but those that have a default. ``mjcf`` is relative to the file. A value per joint is one number for all joints,
a list in the order of ``joint_names``, or a table whose keys are joint names or their endings (``calf`` fits ``FL_calf``
and ``FL_calf_joint``); the longest fitting key wins.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import MISSING, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from .base import JointParameters, Robot

ROBOT_FILE = "robot.toml"
_JOINT_ENDING = "_joint"


class RobotError(ValueError):
    """A robot cannot be found, or its description is wrong; the message says what, where and what to change."""


def did_you_mean(word: str, known: Collection[str]) -> str:
    """``; did you mean 'a' or 'b'?`` for words of ``known`` close to ``word``, else an empty string."""
    close = get_close_matches(word, list(known), n=3)
    return "; did you mean " + " or ".join(f"'{c}'" for c in close) + "?" if close else ""


def load_robot_file(path: str | Path) -> Robot:
    """Read a robot from its description file.

    Only the file itself is checked; ``check_robot`` compares it with the MuJoCo model.

    Args:
        path: a ``robot.toml`` (any file name), or a folder that holds one.

    Raises:
        RobotError: file or MuJoCo model missing, no valid TOML, a key missing, unknown or of the wrong type or size.
    """
    file = Path(path).expanduser()
    if file.is_dir():
        file = file / ROBOT_FILE
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RobotError(
            f"robot file '{file}' does not exist; give the path of a {ROBOT_FILE} or a robot's name"
        ) from None
    except OSError as error:
        raise RobotError(f"robot file '{file}' cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RobotError(f"robot file '{file}' is not a UTF-8 text file; give the path of a {ROBOT_FILE}") from error
    except tomllib.TOMLDecodeError as error:
        raise RobotError(f"robot file '{file}' is not valid TOML: {error}") from error
    return _Reader(file).robot(data)


class _Reader:
    """Turns parsed TOML into a ``Robot``; every error begins with the file and the key."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def error(self, key: str, problem: str) -> RobotError:
        return RobotError(f"{self.file}: {key} {problem}")

    def robot(self, data: Mapping[str, Any]) -> Robot:
        self.check_keys(data, [f.name for f in fields(Robot)], "")
        joint_names = self.names(data, "joint_names")
        mjcf = (self.file.parent / self.text(data, "mjcf")).resolve()
        if not mjcf.is_file():
            raise self.error("mjcf", f"names '{mjcf}', which does not exist; the path is relative to the robot file")
        stand_height = self.number(data["stand_height"], "stand_height")
        if stand_height <= 0:
            raise self.error("stand_height", f"is {stand_height:g} but must be above 0 m")
        parameters = self.parameters(data["parameters"], joint_names)
        default_parameters = self.text(data, "default_parameters")
        if default_parameters not in parameters:
            known = ", ".join(parameters)
            raise self.error("default_parameters", f"is '{default_parameters}' but the parameter sets are: {known}")
        return Robot(
            name=self.text(data, "name"),
            title=self.text(data, "title"),
            mjcf=mjcf,
            joint_names=joint_names,
            default_joint_position=self.per_joint(
                data["default_joint_position"], "default_joint_position", joint_names
            ),
            base_body=self.text(data, "base_body"),
            foot_names=self.names(data, "foot_names"),
            collision_bodies=self.names(data, "collision_bodies"),
            trunk_shapes=self.names(data, "trunk_shapes"),
            imu_site=self.text(data, "imu_site"),
            stand_height=stand_height,
            default_parameters=default_parameters,
            parameters=parameters,
            command_limits=self.command_limits(data["command_limits"]),
        )

    def parameters(self, value: object, joint_names: tuple[str, ...]) -> dict[str, JointParameters]:
        if not isinstance(value, dict) or not value:
            raise self.error("parameters", "must be one or more tables, such as [parameters.gauge]")
        sets = {}
        for set_name, table in value.items():
            prefix = f"parameters.{set_name}."
            if not isinstance(table, dict):
                raise self.error(prefix[:-1], f"is {table!r} but must be a table: [parameters.{set_name}]")
            keys = [f.name for f in fields(JointParameters)]
            optional = [f.name for f in fields(JointParameters) if f.default is not MISSING]
            self.check_keys(table, keys, prefix, optional)
            constants = {key: self.per_joint(table[key], prefix + key, joint_names) for key in keys if key in table}
            for key, values in constants.items():
                for joint, number in zip(joint_names, values, strict=True):
                    if number < 0:
                        raise self.error(prefix + key, f"is {number:g} for {joint} but must not be negative")
            self.check_motors(constants, prefix, joint_names)
            sets[set_name] = JointParameters(**constants)
        return sets

    def check_motors(
        self, constants: Mapping[str, tuple[float, ...]], prefix: str, joint_names: tuple[str, ...]
    ) -> None:
        """Refuse a curve of torque over speed that is half given or rises."""
        if ("full_torque_speed" in constants) != ("no_load_speed" in constants):
            raise self.error(prefix + "full_torque_speed", "and no_load_speed belong together; give both or neither")
        for i, joint in enumerate(joint_names):
            if "no_load_speed" in constants:
                full, none = constants["full_torque_speed"][i], constants["no_load_speed"][i]
                if full >= none:
                    problem = f"is {full:g} rad/s for {joint} but must be below no_load_speed, {none:g}"
                    raise self.error(prefix + "full_torque_speed", problem)
            if "driving_torque_limit" in constants:
                driving, limit = constants["driving_torque_limit"][i], constants["torque_limit"][i]
                if driving > limit:
                    problem = f"is {driving:g} N·m for {joint} but must not be above torque_limit, {limit:g}"
                    raise self.error(prefix + "driving_torque_limit", problem)

    def per_joint(self, value: object, key: str, joint_names: tuple[str, ...]) -> tuple[float, ...]:
        if isinstance(value, list):
            if len(value) != len(joint_names):
                raise self.error(key, f"has {len(value)} values but there are {len(joint_names)} joints")
            return tuple(self.number(v, key) for v in value)
        if isinstance(value, dict):
            return self.per_joint_table(value, key, joint_names)
        return (self.number(value, key),) * len(joint_names)

    def per_joint_table(self, table: Mapping[str, Any], key: str, joint_names: tuple[str, ...]) -> tuple[float, ...]:
        for ending in table:
            if not any(_fits(ending, joint) for joint in joint_names):
                plain = [j.removesuffix(_JOINT_ENDING) for j in joint_names]
                hint = did_you_mean(ending, plain)
                raise self.error(key, f"has the key '{ending}', which is neither a joint nor the ending of one{hint}")
        values = []
        for joint in joint_names:
            fitting = [ending for ending in table if _fits(ending, joint)]
            if not fitting:
                raise self.error(key, f"has no value for the joint '{joint}'; add its name or an ending of it")
            values.append(self.number(table[max(fitting, key=len)], key))
        return tuple(values)

    def command_limits(self, value: object) -> tuple[float, float, float]:
        if not isinstance(value, list) or len(value) != 3:
            raise self.error("command_limits", "must be three numbers: forward and lateral [m/s] and yaw speed [rad/s]")
        forward, lateral, yaw = (self.number(v, "command_limits") for v in value)
        if min(forward, lateral, yaw) < 0:
            raise self.error("command_limits", f"is {value} but its entries must not be negative")
        return forward, lateral, yaw

    def check_keys(
        self, data: Mapping[str, Any], allowed: list[str], prefix: str, optional: Collection[str] = ()
    ) -> None:
        for key in data:
            if key not in allowed:
                hint = did_you_mean(key, allowed) or f"; allowed are: {', '.join(allowed)}"
                raise self.error(prefix + key, f"is an unknown key{hint}")
        missing = [prefix + key for key in allowed if key not in data and key not in optional]
        if missing:
            raise RobotError(f"{self.file}: missing {'keys' if len(missing) > 1 else 'key'} {', '.join(missing)}")

    def text(self, data: Mapping[str, Any], key: str) -> str:
        value = data[key]
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, f"is {value!r} but must be a text")
        return value

    def names(self, data: Mapping[str, Any], key: str) -> tuple[str, ...]:
        value = data[key]
        if not isinstance(value, list) or not value or not all(isinstance(v, str) and v for v in value):
            raise self.error(key, "must be a list of one or more names")
        twice = sorted({v for v in value if value.count(v) > 1})
        if twice:
            raise self.error(key, f"names '{twice[0]}' twice")
        return tuple(value)

    def number(self, value: object, key: str) -> float:
        # bool is an int to Python; `stiffness = true` is a mistake all the same.
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.error(key, f"holds {value!r} but must hold finite numbers")
        return float(value)


def _fits(ending: str, joint: str) -> bool:
    """Whether a table key stands for the joint: its name or whole words at its end, with or without ``_joint``."""
    return any(name == ending or name.endswith("_" + ending) for name in (joint, joint.removesuffix(_JOINT_ENDING)))
