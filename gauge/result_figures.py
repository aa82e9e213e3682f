"""The figures of a ``results.json`` that follow from others in it: whoever edits one has to play the episodes that give it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from ..files.parsing import edited, one_line, shown
from .chance.intervals import Evidence
from .episodes import QUALITY
from .result import BY_HAND, ChanceRules, EnvironmentRow, Result, Statistics
from .results import environment_weights
from .scoring import STATISTICS, level_score

_ROUNDING = 2e-6
"""Of figures that are written with six decimals."""
_INTERVAL_ROUNDING = 1e-4
"""Of an interval, whose replicates another version of NumPy may draw otherwise."""

Figure = tuple[str, float | None, float | None]
"""The path of a figure, the number that is written there, and the number that it must be."""


def check_figures(result: Result, source: str, error: type[Exception]) -> None:
    """Check that seeds, trials, scores, levels, groups, metrics and falls are the runs'; raise ``error`` on the first that is not."""
    rows = result.environments
    _check_environments(rows, result.chance, source, error)
    if result.score is not None and None in (scores := [row.score for row in rows]):
        raise error(f"{source}: environments[{scores.index(None)}] has no score, but all of them have one; {BY_HAND}")
    rounding = max(_ROUNDING, 1.5 * _last_place(rows))
    with edited(source, error):
        for name, stated, expected in _figures(result) if rows else ():
            allowed = _ROUNDING if name == "score" else rounding
            if (stated is None) != (expected is None) or abs((stated or 0) - (expected or 0)) > allowed:
                given = "nothing" if expected is None else f"{expected:.6f}"
                raise error(
                    f"{source}: {one_line(name)} is {shown(stated)}, but what it is made of gives {given}; {BY_HAND}"
                )


def check_interval(result: Result, source: str, error: type[Exception]) -> None:
    """Check that the interval of the score is that of the trials and runs; raise ``error`` where it is not."""
    rows, stated = result.environments, result.score_interval
    if result.score is None or not rows:
        return
    with edited(source, error):
        chance = Evidence(rows, result.chance).chance(environment_weights([row.terrain for row in rows]))
    found = chance.interval(result.score)
    if (found is None) != (stated is None) or not np.allclose(
        found or (), stated or (), rtol=0, atol=_INTERVAL_ROUNDING
    ):
        said, expected = (ends and [round(float(end), 6) for end in ends] for ends in (stated, found))
        raise error(
            f"{source}: score_interval is {shown(said)}, but that of its trials and runs is {expected}; {BY_HAND}"
        )


def _check_environments(
    rows: Sequence[EnvironmentRow], rules: ChanceRules, source: str, error: type[Exception]
) -> None:
    """Check that each environment is there once, with a run of every seed and the trials of every level that was searched."""
    if twice := next((key for key, count in Counter(row.key for row in rows).items() if count > 1), None):
        terrain, friction, payload = twice
        raise error(
            f"{source}: {one_line(terrain, 80)} at friction {friction:g} and payload {payload:g} kg is there twice; {BY_HAND}"
        )
    for at, row in enumerate(rows):
        if row.runs and {*row.runs} != {*rules.seeds}:
            found, expected = (shown(", ".join(map(str, seeds))) for seeds in (row.runs, rules.seeds))
            raise error(
                f"{source}: environments[{at}].runs has the seeds {found}, but chance.seeds has {expected}; {BY_HAND}"
            )
        if row.search is not None and {*row.search} != {level for level, outcomes in row.trials.items() if outcomes}:
            raise error(
                f"{source}: environments[{at}].trials lacks levels that environments[{at}].search has; {BY_HAND}"
            )


def _figures(result: Result) -> Iterator[Figure]:
    rows, rules, evaluated = result.environments, result.chance, result.score is not None
    scores = np.array([row.score or 0.0 for row in rows])
    if evaluated:
        yield "score", result.score, float(environment_weights([row.terrain for row in rows]) @ scores)
    for at, row in enumerate(rows):
        measured = {"quality": (QUALITY, row.quality)}
        measured |= {f"metrics.{name}": (name, found) for name, found in row.metrics.items()}
        for name, (column, found) in measured.items():
            expected = float(np.mean([run.columns[column] for run in row.runs.values()])) if row.runs else None
            yield f"environments[{at}].{name}.mean50", None if found is None else found.mean50, expected
        if evaluated:
            yield f"environments[{at}].score", row.score, _at_level(row.quality, "mean50", row, rules)
    if "level" not in result.lacking:
        yield "level", result.level, _mean_level(rows)
    for terrain, item in result.terrains.items():
        mine = [row for row in rows if row.terrain == terrain]
        yield f"terrains.{terrain}.level", item.level, _mean_level(mine)
        score = float(np.mean([row.score or 0.0 for row in mine])) if evaluated and mine else None
        yield f"terrains.{terrain}.score", item.score, score
        for statistic in STATISTICS if evaluated else ():
            values = [_at_level(row.quality, statistic, row, rules) for row in mine]
            yield f"terrains.{terrain}.{statistic}", getattr(item, statistic), float(np.mean(values))
    for metric, total in result.metrics.items():
        for statistic in STATISTICS:
            values = [_at_level(row.metrics.get(metric), statistic, row, rules) for row in rows]
            yield f"metrics.{metric}.{statistic}", getattr(total, statistic), float(np.mean(values))
    for group, stated in result.groups.items():
        names = result.group_metrics[group]
        yield f"groups.{group}", stated, float(np.mean([result.metrics[name].mean50 for name in names]))
    for name in ("falls", "diverged", "overflowed"):
        if name not in result.health.lacking:
            yield f"health.{name}", getattr(result.health, name), sum(getattr(row, name) or 0 for row in rows)


def _at_level(values: Statistics | None, statistic: str, row: EnvironmentRow, rules: ChanceRules) -> float:
    """Return a quality or metric with the weight of its level; zero where nothing was measured, for no level was passed."""
    if values is None:
        return 0.0
    return float(level_score(getattr(values, statistic), row.reached, rules, flat=row.flat))


def _mean_level(rows: Sequence[EnvironmentRow]) -> float | None:
    levels = [row.reached for row in rows if not row.flat]
    return float(np.mean(levels)) if levels else None


def _last_place(rows: Sequence[EnvironmentRow]) -> float:
    """Return the value of the last decimal to which the suite rounds, which results do not state: that of all runs."""
    values = np.array([run.columns.get(QUALITY, 0.0) for row in rows for run in row.runs.values()])
    return next(10.0**-places for places in range(7) if places == 6 or np.all(np.round(values, places) == values))
