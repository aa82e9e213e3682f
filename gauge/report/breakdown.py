"""Quality by direction and by command: pure functions from the rows of a result, for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from types import MappingProxyType

import numpy as np

from ..commands import Phase
from ..goals import SUB_COMMANDS, TARGET, command_name
from ..result import EnvironmentRow, Result
from ..suite import load_suite, suite_names

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


Parts = Mapping[str, Sequence[Phase]]
"""Phases of the sub-commands of a suite's own goals, by name."""


def own_parts(result: Result) -> Parts:
    """Return the sub-commands of the goals of a result's suite; empty where that does not ship or has changed since."""
    suite = load_suite(result.suite.name) if result.suite.name in suite_names() else None
    if suite is None or suite.digest != result.suite.digest:
        return {}
    return {command_name(goal.name, i): part for goal in suite.goals for i, part in enumerate(goal.sub_commands)}


def command_label(name: str, own: Parts = MappingProxyType({})) -> str:
    """Return a sub-command for readers: ``max_velocity +x`` is ``full speed, then stop: forward``.

    One of ``own`` is told by its phases, in shares of the command limits; others go by their names.
    """
    if name in own:
        return f"{name.rpartition(' ')[0]}: {', then '.join(_told(phase) for phase in own[name])}".replace("_", " ")
    known = {
        command_name(goal, part): (goal, part) for goal, parts in SUB_COMMANDS.items() for part in range(len(parts))
    }
    if name not in known:
        return name.replace("_", " ")
    goal, part = known[name]
    towards = [label for label, place in DIRECTIONS.items() if _points(SUB_COMMANDS[goal][part], place)]
    return f"{_GOALS[goal]}: {' and '.join(towards)}" if towards else _GOALS[goal]


def _told(phase: Phase) -> str:
    """Return a phase in words: ``0.5 forward and 0.7 turning left``."""
    towards = [
        label if abs(speed) == 1.0 else f"{abs(speed):g} {label}"
        for label, (axis, sign) in DIRECTIONS.items()
        if (speed := phase.velocity[axis]) * sign > 0.0
    ]
    return " and ".join(towards) or "standing"


def breakdown(rows: Sequence[EnvironmentRow], own: Parts = MappingProxyType({})) -> dict[str, Table]:
    """Return quality (mean@50) as measured, at the levels reached: the mean over a terrain's environments and seeds.

    Args:
        own: sub-commands of the suite's own goals; one goes where its first phase goes.

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
    first = {command_name(goal, i): signs for goal, parts in SUB_COMMANDS.items() for i, signs in enumerate(parts)}
    for name, part in own.items():
        forward, lateral, yaw = np.sign(part[0].velocity)
        first[name] = int(forward), int(lateral), int(yaw)
    for name, signs in first.items():
        for label, place in DIRECTIONS.items():
            if _points(signs, place):
                for terrain, found in values.get(name, {}).items():
                    directions.setdefault(label, {}).setdefault(terrain, []).extend(found)
    named = {command_label(name, own): by_terrain for name, by_terrain in values.items()}
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
