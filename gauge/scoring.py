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


def bootstrap_run(record: Record, column: int, resamples: int, *, name: str) -> Array:
    """Bootstrap replicates of an episode's mean@50 of one column: the sub-commands of every goal are drawn with replacement.

    Each resample gives every sub-command a multiplicity; the lowest half of the multiset follows from cumulated counts over the
    samples sorted once. Returns (B, ). The generator is seeded by the episode's name, so results are reproducible.
    """
    replicates = np.zeros((len(record.episode.goals), resamples))
    generator = np.random.default_rng(zlib.crc32(f"{name}/{record.episode.key}".encode()))
    for goal in range(len(record.episode.goals)):
        mine = record.goal_index == goal
        values = record.samples[mine, column].astype(np.float64) if len(record.samples) else np.zeros(0)
        parts = record.part_index[mine]
        defined = ~np.isnan(values)
        values, parts = np.clip(values[defined], 0.0, 1.0), parts[defined]
        if len(values) == 0:
            continue
        labels, codes = np.unique(parts, return_inverse=True)
        order = np.argsort(values, kind="stable")
        draws = generator.multinomial(len(labels), np.full(len(labels), 1.0 / len(labels)), size=resamples)
        count = draws[:, codes[order]].astype(np.float64)
        total = count.sum(1)
        half = np.maximum(1.0, np.floor(0.5 * total))
        used = np.clip(half[:, None] - (np.cumsum(count, axis=1) - count), 0.0, count)
        replicates[goal] = used @ values[order] / half
    return replicates.mean(0)


def bootstrap_environment(runs: Sequence[Array], resamples: int, *, name: str) -> Array:
    """Replicates of an environment's value: seeds drawn with replacement, each with a replicate of its own. (B,)."""
    table = np.stack(runs)
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    seeds = generator.integers(len(table), size=(len(table), resamples))
    return table[seeds, np.arange(resamples)[None, :]].mean(0)


def group_values(weighted: Mapping[str, float], scoring: Scoring) -> dict[str, float]:
    """Mean of the level-weighted mean@50 of each group's metrics (paper, table of baselines)."""
    return {g: float(np.mean([weighted[m] for m in names])) for g, names in scoring.groups.items()}
