"""Quality by direction and by command: pure functions from the rows of a result, for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean

from ..goals import SUB_COMMANDS, TARGET, command_name
from ..result import EnvironmentRow

DIRECTIONS: Mapping[str, tuple[int, int]] = {
    "forward": (0, 1),
    "backward": (0, -1),
    "left": (1, 1),
    "right": (1, -1),
    "turning left": (2, 1),
    "turning right": (2, -1),
}
"""Axis of the command and sign, by name."""
_GOALS = {"diagonal_velocity": "there and back", "max_velocity": "full speed, then stop", TARGET: "to the target"}

Table = Mapping[str, Mapping[str, float]]
"""Mean of quality by label and terrain; ``mean`` is the first of them."""


def command_label(name: str) -> str:
    """Return a sub-command for readers: ``max_velocity +x`` is ``full speed, then stop: forward``; others go by their names."""
    known = {
        command_name(goal, part): (goal, part) for goal, parts in SUB_COMMANDS.items() for part in range(len(parts))
    }
    if name not in known:
        return name.replace("_", " ")
    goal, part = known[name]
    towards = [label for label, place in DIRECTIONS.items() if _points(SUB_COMMANDS[goal][part], place)]
    return f"{_GOALS[goal]}: {' and '.join(towards)}" if towards else _GOALS[goal]


def breakdown(rows: Sequence[EnvironmentRow]) -> dict[str, Table]:
    """Return quality (mean@50) as measured, at the levels reached: the mean over a terrain's environments and seeds.

    Returns:
        ``direction``: of all sub-commands that go there, ``command``: of each sub-command. Empty where none was recorded.
    """
    values: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        for run in row.runs.values():
            for name, value in run.commands.items():
                values.setdefault(name, {}).setdefault(row.terrain, []).append(value)
    if not values:
        return {}
    directions: dict[str, dict[str, list[float]]] = {}
    for goal, parts in SUB_COMMANDS.items():
        for part, signs in enumerate(parts):
            for label, place in DIRECTIONS.items():
                if _points(signs, place):
                    for terrain, found in values.get(command_name(goal, part), {}).items():
                        directions.setdefault(label, {}).setdefault(terrain, []).extend(found)
    named = {command_label(name): by_terrain for name, by_terrain in values.items()}
    ordered = {label: directions[label] for label in DIRECTIONS if label in directions}
    return {"direction": _means(ordered), "command": _means(named)}


def _points(signs: Sequence[int], place: tuple[int, int]) -> bool:
    axis, sign = place
    return signs[axis] == sign


def _means(values: Mapping[str, Mapping[str, Sequence[float]]]) -> Table:
    """Return means by terrain, and over the terrains, which count the same."""
    found = {}
    for label, by_terrain in values.items():
        terrains = {terrain: fmean(qualities) for terrain, qualities in by_terrain.items()}
        found[label] = {"mean": fmean(terrains.values()), **terrains}
    return found
