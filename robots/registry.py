"""Find robots: the project's own, plug-ins of the entry-point group ``gaitgauge.robots``, and any ``robot.toml``.

An entry point bears the robot's name and refers to a callable that returns a ``Robot``, or to a path of a ``robot.toml``.
"""

from __future__ import annotations

import os
from pathlib import Path

from ..files.parsing import one_line, shown
from ..files.plugins import guarded, load_plugin, origin, plugins
from .base import Robot
from .checks.checking import check_robot
from .loading import ROBOT_FILE, RobotError, checked_fields, did_you_mean, load_robot_file

GROUP = "gaitgauge.robots"
_OWN_FOLDER = Path(__file__).parent


def robot_names() -> list[str]:
    """Return the names of all installed robots, the project's own first."""
    own = _own()
    return [*own, *sorted(set(plugins(GROUP)) - set(own))]


def load_robot(name_or_path: str | Path, *, check: bool = True) -> Robot:
    """Load a robot.

    Args:
        name_or_path: a name out of ``robot_names()``, the path of a ``robot.toml``, or a folder that holds one. A text
            is a path if it contains a path separator or ends in ``.toml``, else a name.
        check: compare the robot with its MuJoCo model (``check_robot``), which takes MuJoCo. A robot given by a path is
            compiled in a process of its own.

    Raises:
        RobotError: there is no such robot, its description is wrong or does not fit its model, or a plug-in's entry point
            does not give a robot.
    """
    text = os.fspath(name_or_path)
    given = isinstance(name_or_path, Path) or is_path(text)
    robot = load_robot_file(text) if given else _named(text)
    if check:
        check_robot(robot, foreign=given)
    return robot


def is_path(text: str) -> bool:
    """Return whether a text is a robot's path: it contains a path separator or ends in ``.toml``."""
    return "/" in text or os.sep in text or text.endswith(".toml")


def lasting(text: str) -> str:
    """Return a robot's name, or the absolute path of its description, which holds from any folder."""
    return os.path.abspath(os.path.expanduser(text)) if is_path(text) else text


def _named(text: str) -> Robot:
    own = _own()
    if text in own:
        return load_robot_file(own[text])
    plugin = plugins(GROUP).get(text)
    if plugin is None:
        known = robot_names()
        hint = did_you_mean(text, known)
        choice = f"installed: {', '.join(known)}; or give the path of a {ROBOT_FILE}"
        raise RobotError(f"unknown robot '{one_line(text, 80)}'{hint} ({choice})")
    found = load_plugin(plugin, RobotError)
    if callable(found):
        found = guarded(plugin, RobotError, found)
    if isinstance(found, str | Path):
        found = load_robot_file(found)
    source = origin(plugin)
    if not isinstance(found, Robot):
        raise RobotError(f"{source} gave {type(found).__name__}; it must be a path or a callable that returns a Robot")
    if found.name != plugin.name:
        raise RobotError(f"{source} gave a robot named {shown(found.name)}; entry point and robot must share a name")
    return checked_fields(found, source)


def _own() -> dict[str, Path]:
    return {file.parent.name: file for file in sorted(_OWN_FOLDER.glob(f"*/{ROBOT_FILE}"))}
