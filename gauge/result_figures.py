"""The figures of a ``results.json`` that follow from others in it: whoever edits one has to play the episodes that give it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ..files.parsing import edited, one_line, shown
from .chance.intervals import ChanceRules, Evidence
from .episodes import QUALITY
from .results import environment_weights
from .scoring import STATISTICS, level_score

BY_HAND = "it was changed by hand, so ask its maker for the results.json of the run"
_ROUNDING = 2e-6
"""Of figures that are written with six decimals."""
_INTERVAL_ROUNDING = 1e-4
"""Of an interval, whose replicates another version of NumPy may draw otherwise."""

Row = Mapping[str, Any]
Figure = tuple[str, float | None, float | None]
"""The path of a figure, what is written there, and what it must be."""


def check_figures(data: Mapping[str, Any], rules: ChanceRules, source: str, error: type[Exception]) -> None:
    """Check that seeds, trials, scores, levels, groups, metrics and falls are those of the runs.

    Args:
        data: content of ``results.json``, whose types have been checked.
        rules: what it says about chance.

    Raises:
        error: one sentence with the first figure that is not.
    """
    rows = data["environments"]
    _check_environments(rows, rules, source, error)
    if data["score"] is not None and None in (scores := [row.get("score") for row in rows]):
        raise error(f"{source}: environments[{scores.index(None)}] has no score, but all of them have one; {BY_HAND}")
    rounding = max(_ROUNDING, 1.5 * _last_place(rows))
    with edited(source, error):
        for name, stated, expected in _figures(data, rules) if rows else ():
            allowed = _ROUNDING if name == "score" else rounding
            if (stated is None) != (expected is None) or abs((stated or 0) - (expected or 0)) > allowed:
                given = "nothing" if expected is None else f"{expected:.6f}"
                raise error(
                    f"{source}: {one_line(name)} is {shown(stated)}, but what it is made of gives {given}; {BY_HAND}"
                )


def check_interval(data: Mapping[str, Any], rules: ChanceRules, source: str, error: type[Exception]) -> None:
    """Check that the interval of the score is that of the trials and runs.

    Raises:
        error: it is another, or there should be none.
    """
    rows, score, stated = data["environments"], data["score"], data.get("score_interval")
    if score is None or not rows:
        return
    with edited(source, error):
        chance = Evidence(rows, rules).chance(environment_weights([row["terrain"] for row in rows]))
    found = chance.interval(score)
    if (found is None) != (stated is None) or not np.allclose(
        found or (), stated or (), rtol=0, atol=_INTERVAL_ROUNDING
    ):
        expected = None if found is None else [round(float(end), 6) for end in found]
        raise error(
            f"{source}: score_interval is {shown(stated)}, but that of its trials and runs is {expected}; {BY_HAND}"
        )


def _check_environments(rows: list[Row], rules: ChanceRules, source: str, error: type[Exception]) -> None:
    """Check that each environment is there once, with a run of every seed and the trials of every level that was searched."""
    keys = [(row["terrain"], row["friction"], row["payload"]) for row in rows]
    if twice := next((key for key, count in Counter(keys).items() if count > 1), None):
        terrain, friction, payload = twice
        raise error(
            f"{source}: {one_line(terrain, 80)} at friction {friction:g} and payload {payload:g} kg is there twice; {BY_HAND}"
        )
    seeds = [str(seed) for seed in rules.seeds]
    for at, row in enumerate(rows):
        runs, searched, trials = row.get("runs"), row.get("search"), row.get("trials") or {}
        if runs and {*runs} != {*seeds}:
            raise error(
                f"{source}: environments[{at}].runs has the seeds {shown(', '.join(runs))}, but chance.seeds has "
                f"{shown(', '.join(seeds))}; {BY_HAND}"
            )
        if searched is not None and {*searched} != {level for level, outcomes in trials.items() if outcomes}:
            raise error(
                f"{source}: environments[{at}].trials lacks levels that environments[{at}].search has; {BY_HAND}"
            )


def _figures(data: Mapping[str, Any], rules: ChanceRules) -> Iterator[Figure]:
    rows, evaluated = data["environments"], data["score"] is not None
    terrains = [row["terrain"] for row in rows]
    if evaluated:
        yield "score", data["score"], float(environment_weights(terrains) @ [row["score"] for row in rows])
    for at, row in enumerate(rows):
        runs, quality = list((row.get("runs") or {}).values()), row.get("quality")
        measured = {f"metrics.{name}": (name, found) for name, found in (row.get("metrics") or {}).items()}
        for name, (column, found) in ({"quality": (QUALITY, quality)} | measured).items():
            expected = float(np.mean([run[column] for run in runs])) if runs else None
            yield f"environments[{at}].{name}.mean50", found and found["mean50"], expected
        if evaluated:
            yield f"environments[{at}].score", row["score"], _at_level(quality, "mean50", row, rules)
    if "level" in data:
        yield "level", data["level"], _mean_level(rows)
    for terrain, item in (data.get("terrains") or {}).items():
        mine = [row for row in rows if row["terrain"] == terrain]
        yield f"terrains.{terrain}.level", item.get("level"), _mean_level(mine)
        score = float(np.mean([row["score"] for row in mine])) if evaluated and mine else None
        yield f"terrains.{terrain}.score", item.get("score"), score
        for statistic in STATISTICS if evaluated else ():
            values = [_at_level(row.get("quality"), statistic, row, rules) for row in mine]
            yield f"terrains.{terrain}.{statistic}", item[statistic], float(np.mean(values))
    metrics = data.get("metrics") or {}
    for metric, item in metrics.items():
        for statistic in STATISTICS:
            values = [_at_level((row.get("metrics") or {}).get(metric), statistic, row, rules) for row in rows]
            yield f"metrics.{metric}.{statistic}", item[statistic], float(np.mean(values))
    for group, stated in (data.get("groups") or {}).items():
        names = data["group_metrics"][group]
        yield f"groups.{group}", stated, float(np.mean([metrics[name]["mean50"] for name in names]))
    health = data.get("health") or {}
    for name in ("falls", "diverged", "overflowed"):
        if name in health:
            yield f"health.{name}", health[name], sum(row.get(name, 0) for row in rows)


def _at_level(values: Mapping[str, float] | None, statistic: str, row: Row, rules: ChanceRules) -> float:
    """A quality or metric with the weight of its level; zero where nothing was measured, for no level was passed."""
    if not values:
        return 0.0
    return float(level_score(values[statistic], row["level"] or 0, rules, flat=row["terrain"] == "flat"))


def _mean_level(rows: list[Row]) -> float | None:
    levels = [row["level"] or 0 for row in rows if row["terrain"] != "flat"]
    return float(np.mean(levels)) if levels else None


def _last_place(rows: list[Row]) -> float:
    """Value of the last decimal to which the suite rounds, which results do not state: that of all runs."""
    values = np.array([run.get(QUALITY, 0.0) for row in rows for run in (row.get("runs") or {}).values()])
    return next(10.0**-places for places in range(7) if places == 6 or np.all(np.round(values, places) == values))
