"""Make the guesses of a robot's description again after an edit: what its owner has changed stays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...files.parsing import one_line, parse_toml, read_text
from ..loading import ROBOT_FILE, RobotError, load_robot_file
from .drafting import Draft, Entry, draft_robot, tag_of
from .surveying import Answers

_TAGGED = re.compile(r"# (.*) \[([0-9a-f]{4})\]$")
_SETS = ("parameters", "variants")
"""Tables of tables."""


def guessed_again(path: Path) -> tuple[str, list[str], Path]:
    """Return a description with its guesses made again, a sentence for each that changed, and the description's file.

    Args:
        path: a ``robot.toml`` that ``robot new`` wrote, or its folder.

    Raises:
        RobotError: the description or its model is wrong.
    """
    file = path / ROBOT_FILE if path.is_dir() else path
    robot, text = load_robot_file(file), read_text(file, "robot file", RobotError)
    data = parse_toml(text, f"robot file '{one_line(file)}'", RobotError)
    notes, remarks = _comments(text)
    if not remarks:
        raise RobotError(
            f"'{one_line(file)}' has no guesses that robot new has marked; write it anew with robot new --force"
        )
    values = dict(_values(data))
    mine = {key for key, value in values.items() if key not in remarks or remarks[key][1] != tag_of(value)}
    pose = "default_joint_position"
    kept = pose in mine or not remarks[pose][0].startswith("guessed")
    answers = Answers(
        feet=robot.foot_geoms,
        pose=dict(zip(robot.joint_names, robot.default_joint_position, strict=True)) if kept else {},
    )
    draft = draft_robot(robot.mjcf, robot.title, answers=answers)
    if draft.model:
        raise RobotError(
            f"'{one_line(robot.mjcf)}' lacks names that the description needs; write both anew with robot new --force"
        )
    entries, changes = [], []
    for entry in draft.entries:
        old = values.pop(entry.key, None)
        if old is None or entry.key in ("name", "title", "mjcf"):
            entries.append(entry if old is None else Entry(entry.key, old))
        elif entry.key in mine or tag_of(old) == tag_of(entry.value):
            entries.append(replace(entry, value=old, remark=_remark(entry.key, mine, remarks)))
        else:
            entries.append(entry)
            changes.append(f"{entry.key}: {_short(old)} becomes {_short(entry.value)} ({entry.remark})")
    entries += [Entry(key, value) for key, value in values.items()]
    made = Draft(name=robot.name, plan=draft.plan, entries=tuple(entries), mends=(), model="")
    return made.text(str(data["mjcf"]), notes=notes), changes, file


def _remark(key: str, mine: set[str], remarks: Mapping[str, tuple[str, str]]) -> str:
    return "" if key in mine or key not in remarks else remarks[key][0]


def _short(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{name} = {_short(each)}" for name, each in value.items()) + " }"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _values(data: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the values of a description by the keys of ``Entry``."""
    for key, value in data.items():
        if key not in _SETS:
            yield key, value
        elif isinstance(value, dict):
            for name, table in value.items():
                for inner, each in table.items():
                    yield f"{key}.{name}.{inner}", each


def _comments(text: str) -> tuple[dict[str, list[str]], dict[str, tuple[str, str]]]:
    """Return the owner's comment lines above each key, and the remark and tag of each guess, by the keys of ``Entry``."""
    notes: dict[str, list[str]] = {}
    remarks: dict[str, tuple[str, str]] = {}
    above: list[str] = []
    table = ""
    lines = text.splitlines()
    for line in lines[next((i for i, each in enumerate(lines) if not each.startswith("#")), 0) :]:
        if line.startswith("#"):
            above.append(line)
            continue
        key = ""
        if found := re.match(r"\[([^\[\]]+)\]", line):
            key = table = found[1].replace('"', "")
        elif found := re.match(r'"?([^\s"=]+)"?\s*=', line):
            key = f"{table}.{found[1]}" if table else found[1]
        if key:
            for comment in above:
                if tagged := _TAGGED.match(comment):
                    remarks[key] = (tagged[1], tagged[2])
                else:
                    notes.setdefault(key, []).append(comment)
        if key or line.strip():
            above = []
    return notes, remarks
