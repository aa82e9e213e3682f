"""Chooses the robot that a description is about, and puts its joints in order."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from ...files.parsing import did_you_mean, shown
from ...robots import Robot, load_robot, robot_names
from ...robots.anatomy.body_plan import robot_model
from ..base import PolicyError

DEFAULT_ROBOT = "go2"
"""Robot of a policy that names none."""


def choose_robot(asked: Robot | None, named: str | None, source: object) -> Robot:
    """Return the robot of a description: the one that is asked for, else the installed one that it names, else the Go2.

    Raises:
        PolicyError: it names another robot than the one that is asked for, or one that is not installed.
    """
    if named is None:
        return asked or load_robot(DEFAULT_ROBOT)
    if asked is not None:
        if not _same(named, asked.name):
            raise PolicyError(
                f"'{source}' describes a policy for robot {shown(named)}, not for '{asked.name}'; give that robot's robot.toml "
                "with --robot"
            )
        return asked
    known = next((name for name in robot_names() if _bare(name) == _bare(named)), None)
    if known is None:
        raise PolicyError(
            f"'{source}' describes a policy for robot {shown(named)}, which is not installed (there are {', '.join(robot_names())})"
            f"{did_you_mean(named, robot_names()) or ';'} "
            "give its robot.toml with --robot ('gaitgauge robot new MODEL.xml' writes one)"
        )
    return load_robot(known)


def fitting_robot(fits: Callable[[Robot], bool], feature: str, source: object) -> tuple[Robot, str | None]:
    """Return the robot of a description that names none: the Go2, or where that does not fit, the one installed robot that does.

    The second value says what that assumes, in words, with ``feature``: what the description tells of its robot.
    """
    usual = choose_robot(None, None, source)
    if fits(usual):
        return usual, None
    fitting = [robot for robot in map(load_robot, robot_names()) if fits(robot)]
    return (
        (usual, None) if len(fitting) != 1 else (fitting[0], f"robot '{fitting[0].name}', the only one with {feature}")
    )


def _same(named: str, name: str) -> bool:
    """Return whether a robot's name is the one that a description uses, with an addition of its owner's or without."""
    return _bare(named) == _bare(name) or re.match(rf"{re.escape(named.lower())}[_.-]", name.lower()) is not None


def _bare(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def matching_joint(name: str, robot: Robot) -> str:
    """Return the robot's joint of this name, with or without the ending ``_joint``; the name itself if the robot has none."""
    bare = name.removesuffix("_joint")
    return next((j for j in robot.joint_names if j.removesuffix("_joint") == bare), name)


def sdk_joints(robot: Robot, order: Sequence[Any], source: object, entry: str) -> tuple[str, ...]:
    """Return joint names by their numbers in the maker's SDK.

    Raises:
        PolicyError: the robot's description does not say the SDK's order, or the numbers are not those of its joints.
    """
    numbered = robot.sdk_joint_names
    if numbered is None:
        raise PolicyError(
            f"'{source}' numbers joints as the maker's SDK does, which the description of robot '{robot.name}' does not say; "
            "add sdk_joint_names to its robot.toml"
        )
    if sorted(order) != list(range(len(numbered))):
        others = [name for name in robot_names() if load_robot(name).num_joints == len(order) != len(numbered)]
        raise PolicyError(
            f"'{source}' has {entry} {shown(list(order))}; every number from 0 to {len(numbered) - 1} is needed once for robot "
            f"'{robot.name}'; "
            + (f"'{others[0]}' has {len(order)} joints: " if others else "")
            + "--robot chooses another"
        )
    return tuple(numbered[int(i)] for i in order)


def breadth_first(robot: Robot) -> tuple[str, ...]:
    """Return the robot's joints as Isaac Lab lists them: those nearest to the base first, in the order of the model."""
    model = robot_model(robot)

    def depth(name: str) -> int:
        body, count = int(model.jnt_bodyid[model.joint(name).id]), 0
        while body > 0:
            body, count = int(model.body_parentid[body]), count + 1
        return count

    in_model = sorted(robot.joint_names, key=lambda name: int(model.joint(name).id))
    return tuple(sorted(in_model, key=depth))


def by_pattern(table: Mapping[str, Any], joints: Sequence[str], missing: Any, source: object, entry: str) -> list[Any]:
    """Return a value for each joint from a table of regular expressions; ``missing`` for joints that none matches.

    Raises:
        PolicyError: an expression is malformed or matches no joint.
    """
    found = dict.fromkeys(joints, missing)
    for pattern, value in table.items():
        if len(pattern) > 200:
            raise PolicyError(f"'{source}' has a pattern of {len(pattern)} characters in {entry}")
        try:
            matched = [joint for joint in joints if re.fullmatch(pattern, joint)]
        except re.error as error:
            raise PolicyError(f"'{source}' has the malformed pattern {shown(pattern)} in {entry}: {error}") from error
        if not matched:
            raise PolicyError(
                f"'{source}' has the pattern {shown(pattern)} in {entry}, which no joint has: {', '.join(joints)}"
            )
        found.update(dict.fromkeys(matched, value))
    return list(found.values())


def wheels_of(named: Sequence[object], robot: Robot, source: object) -> tuple[str, ...]:
    """Return the joints, names or patterns, that a description drives by velocity; ``PolicyError`` unless these are the robot's wheels."""
    own = robot.velocity_joints or ()
    if named and (not own or {joint for each in named for joint in joints_named(str(each), robot)} != set(own)):
        theirs = f"takes such targets for {', '.join(own)}" if own else "takes targets of angle alone"
        raise PolicyError(
            f"'{source}' drives joints by velocity ({', '.join(map(str, named))}), as wheels are, and robot '{robot.name}' {theirs}; "
            "choose another with --robot (velocity_joints in its robot.toml names its wheels)"
        )
    return own if named else ()


def joints_named(text: str, robot: Robot) -> list[str]:
    """Return the robot's joints of a name, or those that a pattern fits."""
    if (named := matching_joint(text, robot)) in robot.joint_names:
        return [named]
    with suppress(re.error):
        return [joint for joint in robot.joint_names if len(text) <= 200 and re.fullmatch(text, joint)]
    return []
