"""From samples to scores: pure functions (gauge protocol §6.4 and §6.6), and the bootstrap behind the confidence intervals."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .episodes import Record
from .suite import Scoring

Array = NDArray[np.float64]

STATISTICS = ("mean", "mean25", "mean50")
"""Mean of all samples, of the lowest quarter, of the lowest half."""
_SHARES = (1.0, 0.25, 0.5)


def tail_means(samples: Array) -> Array:
    """Mean of all values, of the lowest 25 % and of the lowest 50 %, after clamping to [0, 1].

    NaN values are left out. The lowest p of N values are max(1, floor(N p)). ``samples`` (N,); returns (3,), zeros if empty.
    """
    values = np.sort(np.clip(samples[~np.isnan(samples)], 0.0, 1.0))
    if len(values) == 0:
        return np.zeros(3)
    return np.array([values[: max(1, int(len(values) * share))].mean() for share in _SHARES])


def run_statistics(record: Record, column: int) -> Array:
    """``tail_means`` of one column averaged over the goals of an episode, (3,). A goal without samples counts zero."""
    goals = range(len(record.episode.goals))
    if len(record.samples) == 0:
        return np.zeros(3)
    values = record.samples[:, column].astype(np.float64)
    return np.mean([tail_means(values[record.goal_index == g]) for g in goals], axis=0)


def level_score(value: Array | float, level: int, scoring: Scoring, *, flat: bool) -> Array | float:
    """Score of a quality (or metric) at a level: 0.09 (L - 1) + 0.19 q; the quality itself on flat ground; 0 at level 0."""
    if flat:
        return value
    if level == 0:
        return np.zeros_like(value) if isinstance(value, np.ndarray) else 0.0
    return scoring.level_weight * (level - 1) + scoring.quality_weight * value


def rounded(value: Array, scoring: Scoring) -> Array:
    """Rounded as the suite says."""
    return value if scoring.decimals is None else np.round(value, scoring.decimals)


@dataclass(frozen=True)
class Interval:
    """A 95 % confidence interval."""

    low: float
    high: float

    @classmethod
    def of(cls, replicates: Array) -> Interval:
        """Percentile interval of bootstrap replicates, (B,)."""
        low, high = np.percentile(replicates, [2.5, 97.5])
        return cls(float(low), float(high))


def bootstrap_run(record: Record, columns: Sequence[int], resamples: int) -> Array:
    """Bootstrap replicates of an episode's mean@50: the sub-commands of every goal are drawn with replacement.

    A resample gives every sub-command a multiplicity, the same for all columns, so that what columns have in common stays in
    their averages. The lowest half of the multiset follows from sums over the sorted samples, one for each sub-command.
    Samples that are not defined are left out; what has none counts zero, as in ``run_statistics``.

    Args:
        record: the episode; its name seeds the generator, so that results are reproducible.
        columns: columns of the sample table.
        resamples: number of replicates B.

    Returns:
        (columns, B).
    """
    goals = range(len(record.episode.goals))
    replicates = np.zeros((len(columns), len(goals), resamples))
    generator = np.random.default_rng(zlib.crc32(record.episode.key.encode()))
    for goal in goals:
        mine = record.goal_index == goal
        labels, codes = np.unique(record.part_index[mine], return_inverse=True)
        if len(labels) == 0:
            continue
        draws = generator.multinomial(len(labels), np.full(len(labels), 1.0 / len(labels)), size=resamples)
        for at, column in enumerate(columns):
            values = record.samples[mine, column].astype(np.float64)
            defined = ~np.isnan(values)
            replicates[at, goal] = _lower_halves(np.clip(values[defined], 0.0, 1.0), codes[defined], draws)
    return replicates.mean(1)


def _lower_halves(values: Array, codes: NDArray[np.intp], draws: NDArray[np.int64]) -> Array:
    """Mean of the lowest half of multisets in which value i occurs ``draws[:, codes[i]]`` times; 0 for an empty one.

    ``values`` and ``codes`` (N,), ``draws`` (B, labels); returns (B,).
    """
    order = np.argsort(values, kind="stable")
    values, codes = values[order], codes[order]
    times = draws.astype(np.float64)
    one_hot = codes[:, None] == np.arange(draws.shape[1])
    start = np.zeros((1, draws.shape[1]))
    counts = np.concatenate((start, np.cumsum(one_hot, axis=0)))
    sums = np.concatenate((start, np.cumsum(one_hot * values[:, None], axis=0)))
    total = draws @ counts[-1]
    half = np.maximum(1.0, np.floor(0.5 * total))
    # smallest number of sorted values whose copies make up the half, by bisection for all resamples at once
    low, high = np.ones(len(draws), dtype=np.int64), np.full(len(draws), len(values), dtype=np.int64)
    while (low < high).any():
        middle = (low + high) // 2
        enough = _row_products(times, counts[middle]) >= half
        low, high = np.where(enough, low, middle + 1), np.where(enough, middle, high)
    last = high - 1
    before = _row_products(times, counts[last])
    lower = (times * sums[last]).sum(1) + (half - before) * (values[last] if len(values) else 0.0)
    return np.where(total > 0, lower / half, 0.0)


def _row_products(first: Array, second: Array) -> Array:
    """Inner products of the rows of two tables of whole numbers, (B, L) both: exact in whatever order they are summed."""
    return np.einsum("bl,bl->b", first, second)


def bootstrap_environment(runs: Sequence[Array], resamples: int, *, name: str) -> Array:
    """Replicates of an environment's values: seeds drawn with replacement, each with a replicate of its own.

    ``runs`` holds one array (columns, B) for each seed; the same seeds are drawn for all columns. Returns (columns, B).
    """
    table = np.stack(runs)
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    seeds = generator.integers(len(table), size=(len(table), resamples))
    drawn: Array = table[seeds, :, np.arange(resamples)[None, :]].mean(0).T
    return drawn


def group_values(weighted: Mapping[str, float], scoring: Scoring) -> dict[str, float]:
    """Mean of the level-weighted mean@50 of each group's metrics (paper, table of baselines)."""
    return {g: float(np.mean([weighted[m] for m in names])) for g, names in scoring.groups.items()}
