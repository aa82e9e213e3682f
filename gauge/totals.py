"""Compute every figure of a result from the trials and runs in its rows: the second half of folding, which each reading repeats.

Figures have six decimals, as runs have in a file, so that whoever reads a file computes what its maker computed.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .chance.intervals import Chance, Evidence
from .chance.level_curve import bracketing_levels, fitted_curve
from .episodes import QUALITY
from .result import (
    FLAT,
    ChanceRules,
    EnvironmentRow,
    Health,
    Interval,
    MetricScore,
    Run,
    RunHealth,
    Runs,
    Scores,
    Statistics,
    SuiteName,
    TerrainScore,
)
from .scoring import STATISTICS, Array, group_values, level_score, rounded

ONE_SEED = "no interval: one seed"
COUNTS = ("falls", "diverged", "overflowed", "restarted")


def number(value: float | np.floating) -> float:
    """Return a figure as results have it: with six decimals."""
    return float(round(float(value), 6))


def environment_weights(terrains: Sequence[str]) -> Array:
    """Return the weight of each environment in the score, (E,): terrains count the same, and so do the environments of one."""
    counts = Counter(terrains)
    return np.array([1.0 / (len(counts) * counts[t]) for t in terrains])


# ---- one environment --------------------------------------------------------------------------------------------------


def whole_row(row: EnvironmentRow, rules: ChanceRules) -> EnvironmentRow:
    """Return a row with the figures that follow from its level, trials and runs; its own are left aside, its interval stays."""
    curve: dict[int, float] = {}
    if row.search is not None and rules.level != "bisection":
        curve = fitted_curve({level: list(found.values()) for level, found in row.trials.items()})
    at_zero = not row.flat and row.level == 0
    row = replace(row, curve={level: number(share) for level, share in curve.items()}, score=0.0 if at_zero else None)
    if row.runs_by_level:
        row = replace(row, runs=_between_levels(row, rules))
    if not row.runs:
        return replace(
            row, quality=None, metrics={}, falls=None, diverged=None, overflowed=None, restarted=None, self_contact=None
        )
    columns = next(iter(row.runs.values())).columns
    means = {c: Statistics(**named(rounded(np.mean(_values(row, c), axis=0), rules))) for c in columns}
    found = [run.health for run in row.runs.values() if run.health is not None]
    return replace(
        row,
        quality=means.pop(QUALITY),
        metrics=means,
        score=number(weighted(row, QUALITY, rules)[2]),
        self_contact=_mean_contact(found),
        **_sums(found, COUNTS),
    )


def weighted(row: EnvironmentRow, column: str, rules: ChanceRules) -> Array:
    """Return the statistics of a column with the weight of the level, (3,); zeros where nothing was measured."""
    if not row.runs:
        return np.zeros(3)
    values = np.asarray(level_score(_values(row, column), row.reached, rules, flat=row.flat))
    # the reference rounds every run's score before it averages
    return rounded(np.mean(rounded(values, rules), axis=0), rules)


def named(values: Array) -> dict[str, Any]:
    """Return the statistics of a column by name."""
    return {name: number(value) for name, value in zip(STATISTICS, values, strict=True)}


def _values(row: EnvironmentRow, column: str) -> Array:
    """Return the statistics of a column in every run, (S, 3)."""
    return np.array([(run.mean[column], run.mean25[column], run.columns[column]) for run in row.runs.values()])


def _between_levels(row: EnvironmentRow, rules: ChanceRules) -> dict[int, Run]:
    """Return the runs at an expected level, between those at the two levels beside it."""
    shares, runs = bracketing_levels(row.reached), {}
    for seed in next(iter(row.runs_by_level.values())):
        beside = [(share, row.runs_by_level[level][seed]) for level, share in shares.items()]

        def mixed(table: str, beside: Sequence[tuple[float, Run]] = beside) -> dict[str, float]:
            sums: dict[str, float] = {}
            for share, run in beside:
                for name, value in getattr(run, table).items():
                    sums[name] = sums.get(name, 0.0) + share * value
            return {name: number(value) for name, value in sums.items()}

        found = [run.health for _, run in beside if run.health is not None]
        health = RunHealth(self_contact=_mean_contact(found), **_sums(found, ("samples", *COUNTS))) if found else None
        columns, commands, mean, mean25 = (mixed(table) for table in ("columns", "commands", "mean", "mean25"))
        runs[seed] = Run(columns=columns, commands=commands, mean=mean, mean25=mean25, health=health)
    return runs


def _sums(found: Sequence[RunHealth], names: Sequence[str]) -> dict[str, Any]:
    return {name: sum(getattr(one, name) for one in found) for name in names}


def _mean_contact(found: Sequence[RunHealth]) -> float | None:
    """Return the share of samples in which parts touch, None where there are no samples or a run does not say."""
    sampled = [(one.samples, one.self_contact) for one in found if one.samples]
    known = [(samples, share) for samples, share in sampled if share is not None]
    if not known or len(known) < len(sampled):
        return None
    return number(sum(samples * share for samples, share in known) / sum(samples for samples, _ in known))


def runs_at(row: EnvironmentRow) -> Mapping[int, Runs]:
    """Return the runs of an environment by the level at which they were played, 0 on flat ground."""
    return (row.runs_by_level or {math.ceil(row.reached): row.runs}) if row.runs else {}


def health_of(rows: Iterable[EnvironmentRow]) -> Health:
    """Return how many quality episodes there are, fell, diverged or dropped contacts, and how often parts of the robot touched."""
    tables = [table for row in rows for table in (row.runs_by_level.values() if row.runs_by_level else [row.runs])]
    found = [run.health for table in tables for run in table.values() if run.health is not None]
    counts = _sums(found, ("falls", "diverged", "overflowed"))
    return Health(episodes=sum(map(len, tables)), self_contact=_mean_contact(found), **counts)


# ---- all of them ------------------------------------------------------------------------------------------------------


def totals(
    rows: Sequence[EnvironmentRow],
    rules: ChanceRules,
    *,
    suite: SuiteName,
    groups: Mapping[str, Sequence[str]],
    metrics: Sequence[str],
    evaluated: bool,
    intervals: bool = True,
) -> Scores:
    """Return the scores that follow from rows.

    Args:
        rows: of ``whole_row``.
        groups: metrics of each group.
        metrics: all of them, in order.
        evaluated: True where quality was asked for, and not the level alone: where no level is passed anywhere, the score is 0.
        intervals: False leaves them out, and the levels are not searched again.

    Returns:
        Scores that rest on mean@50: an environment's is its quality's (``scoring.level_score``), a terrain's the mean over
        its environments, the benchmark's the mean over terrains. Intervals are those of ``intervals``: what other seeds would
        have changed, the levels included; None where one seed shows no spread.
    """
    evidence = Evidence(rows, rules) if intervals else None
    searched, names = np.array([row.search is not None for row in rows]), [row.terrain for row in rows]

    def ends(value: float, weights: Array, columns: Sequence[str] = (QUALITY,)) -> Interval | None:
        return None if evidence is None else _ends(evidence.chance(weights, columns), value, (0.0, 1.0))

    def level_ends(level: float | None, weights: Array, mine: NDArray[np.bool_]) -> Interval | None:
        if evidence is None or level is None or not (searched & mine).any():
            return None
        return _ends(evidence.level_chance(weights), level, (0.0, float(rules.levels)))

    terrains, scores = {}, []
    for terrain in dict.fromkeys(names):
        mine = np.array([name == terrain for name in names])
        group, weights = [row for row in rows if row.terrain == terrain], mine / mine.sum()
        level = None if terrain == FLAT else float(np.mean([row.reached for row in group]))
        found = TerrainScore(level=level, level_interval=level_ends(level, weights, mine))
        if evaluated:
            statistics = np.mean([weighted(row, QUALITY, rules) for row in group], axis=0)
            scores.append(statistics[2])
            score = number(statistics[2])
            found = replace(found, score=score, interval=ends(score, weights), **named(statistics))
        terrains[terrain] = found
    levelled = np.array([name != FLAT for name in names], dtype=np.float64)
    level = float(np.mean([row.reached for row in rows if not row.flat])) if levelled.any() else None
    whole = Scores(
        suite=suite,
        chance=replace(rules, note=None, lacking=frozenset()),
        score=None,
        group_metrics={group: tuple(of) for group, of in groups.items()},
        level=level,
        level_interval=level_ends(level, levelled / max(levelled.sum(), 1.0), levelled > 0),
        terrains=terrains,
        environments=tuple(rows),
    )
    if not evaluated:
        return whole
    score, weights = number(np.mean(scores)), environment_weights(names)
    even, each = np.full(len(rows), 1.0 / len(rows)), np.eye(len(rows))
    means = {metric: np.mean([weighted(row, metric, rules) for row in rows], axis=0) for metric in metrics}
    of_groups = {g: number(v) for g, v in group_values({m: float(v[2]) for m, v in means.items()}, groups).items()}
    known = evidence is None or evidence.chance(weights).known
    return replace(
        whole,
        chance=replace(whole.chance, note=None if known else ONE_SEED),
        score=score,
        score_interval=ends(score, weights),
        groups=of_groups,
        metrics={m: MetricScore(**named(v), interval=ends(float(v[2]), even, (m,))) for m, v in means.items()},
        environments=tuple(
            replace(row, interval=ends(row.score or 0.0, alone)) for row, alone in zip(rows, each, strict=True)
        ),
        groups_interval={group: ends(of_groups[group], even, tuple(of)) for group, of in groups.items()},
    )


def _ends(chance: Chance, value: float, bounds: tuple[float, float]) -> Interval | None:
    found = chance.interval(value, bounds)
    return None if found is None else (number(found[0]), number(found[1]))
