"""From samples to scores: pure functions (gauge protocol §6.4 and §6.6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .episodes import MOTION, QUALITY, Record

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
    """``tail_means`` of one column averaged over the goals of an episode, (3,). A goal without samples counts zero.

    The quality of a goal counts for the square of the share of the commanded motion that is done, where the suite measures it.
    """
    return goal_statistics(record, column).mean(0)


def goal_statistics(record: Record, column: int) -> Array:
    """Return ``tail_means`` of one column in each goal of an episode, (goals, 3), as ``run_statistics`` averages them."""
    goals = range(len(record.episode.goals))
    if len(record.samples) == 0:
        return np.zeros((len(goals), 3))
    return np.array([_statistics(record, column, record.goal_index == g) for g in goals])


def command_statistics(record: Record, column: int) -> dict[tuple[int, int], Array]:
    """``tail_means`` of one column over the samples of each sub-command that was played, (3,), by goal and sub-command index."""
    parts = np.stack((record.goal_index, record.part_index), axis=1)
    return {
        (goal, part): _statistics(record, column, (parts == (goal, part)).all(1))
        for goal, part in np.unique(parts, axis=0).tolist()
    }


def _statistics(record: Record, column: int, mine: NDArray[np.bool_]) -> Array:
    """Return ``tail_means`` of one column over some samples; those of the quality times the square of the mean of ``MOTION``."""
    samples = record.samples[mine].astype(np.float64)
    found = tail_means(samples[:, column])
    if MOTION not in record.columns or record.columns[column] != QUALITY:
        return found
    done = samples[:, record.columns.index(MOTION)]
    return found if np.isnan(done).all() else found * tail_means(done)[0] ** 2


class LevelWeights(Protocol):
    """What a score is made with: a suite's ``Scoring``, or the ``ChanceRules`` that results state."""

    @property
    def level_weight(self) -> float:
        """Of each level above the first."""

    @property
    def quality_weight(self) -> float:
        """Of the quality."""

    @property
    def decimals(self) -> int | None:
        """Decimals to which runs and means are rounded; None: not at all."""


def level_score(value: Array | float, level: float, scoring: LevelWeights, *, flat: bool) -> Array | float:
    """Score of a quality (or metric) at a level: 0.09 (L - 1) + 0.19 q; the quality itself on flat ground; 0 at level 0.

    Between two levels it lies between their scores, below level 1 between zero and that of level 1.
    """
    if flat:
        return value
    if level == 0:
        return np.zeros_like(value) if isinstance(value, np.ndarray) else 0.0
    return scoring.level_weight * max(level - 1, 0) + scoring.quality_weight * min(level, 1) * value


def rounded(value: Array, scoring: LevelWeights) -> Array:
    """Rounded as the suite says."""
    return value if scoring.decimals is None else np.round(value, scoring.decimals)


def group_values(weighted: Mapping[str, float], groups: Mapping[str, Sequence[str]]) -> dict[str, float]:
    """Mean of the level-weighted mean@50 of each group's metrics (paper, table of baselines)."""
    return {g: float(np.mean([weighted[m] for m in names])) for g, names in groups.items()}
