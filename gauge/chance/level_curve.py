"""The expected level: how many levels a policy passes on average, from trials around the level at which it begins to fail.

The chance to reach the target falls with the level. Added up over all levels, which is the area under that curve, it is the
level that is reached on average, and unlike the highest level that passed a test it moves continuously: one trial more or less
moves it by one part in the number of seeds.

The design looks for the crossing with few seeds by bisection, then plays every seed at the levels around it: downwards to one
at which all reach the target, upwards to one at which none does. Below counts as passed, above as not passed. The area is that
under the isotonic fit, the monotone curve that fits the trials best: making shares monotone keeps their sum where each level has
the same number of trials. It is the Spearman-Kärber estimate, which supposes no shape and uses the trials of a logistic
curve as well as fitting one does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

Outcomes = Sequence[bool | None]
"""Whether each search seed reached the target at a level, in the order of the seeds; None for those that have not ended."""


@dataclass(frozen=True, kw_only=True)
class CurveSearch:
    """How far the trials of an environment are."""

    seeds: Mapping[int, int]
    """Number of seeds, from the first on, that count at each level, in the order in which the levels were asked for."""
    lowest: int
    highest: int
    """Levels that hold the crossing, or a neighbour of it: those in between may count."""
    goes_down: bool
    goes_up: bool
    """True where levels below, or above, may still count."""
    level: float | None
    """The expected level, once all trials that count have ended."""


def follow(outcomes: Callable[[int], Outcomes], levels: int, seeds: int, bracket: int) -> CurveSearch:
    """Follow the design as far as outcomes are known. What counts depends on the outcomes of what counts alone.

    Args:
        outcomes: of every seed at a level.
        bracket: how many of them look for the crossing.
    """
    counts: dict[int, int] = {}
    low, high = 0, levels
    mixed = False
    while low < high and not mixed:
        middle = (low + high + 1) // 2
        counts[middle] = bracket
        found = outcomes(middle)[:bracket]
        if False in found and True in found:
            low = high = middle
            mixed = True
        elif None in found:
            return CurveSearch(seeds=counts, lowest=low, highest=high + 1, goes_down=True, goes_up=True, level=None)
        elif True in found:
            low = middle
        else:
            high = middle - 1
    lowest, highest = (low, low) if mixed else (max(low, 1), min(low + 1, levels))
    while lowest > 1 and False in outcomes(lowest):
        lowest -= 1
    while highest < levels and True in outcomes(highest):
        highest += 1
    counts |= dict.fromkeys(range(lowest, highest + 1), seeds)
    trials = [outcomes(level) for level in range(lowest, highest + 1)]
    known = not any(None in found for found in trials)
    successes = sum(list(found).count(True) for found in trials)
    return CurveSearch(
        seeds=counts,
        lowest=lowest,
        highest=highest,
        goes_down=lowest > 1 and None in trials[0],
        goes_up=highest < levels and None in trials[-1],
        level=((lowest - 1) * seeds + successes) / seeds if known else None,
    )


def nearness(level: int, lowest: int, highest: int) -> float:
    """How probable it is, roughly, that a level counts: halved with each level outside a range."""
    return 0.5 ** max(lowest - level, level - highest, 0)


def bracketing_levels(level: float) -> dict[int, float]:
    """Whole levels at which the quality of an expected level is measured, and their weights, which add up to one.

    Between two levels the quality is interpolated; below level 1 it is that of level 1, below which there is none.
    """
    if level <= 0.0:
        return {}
    low = max(math.floor(level), 1)
    share = max(level - low, 0.0)
    return {low: 1.0 - share, low + 1: share} if share else {low: 1.0}


def fitted_curve(trials: Mapping[int, Collection[bool]]) -> dict[int, float]:
    """The isotonic fit: share of successes at each level that was played, made to fall with the level."""
    levels = sorted(level for level, found in trials.items() if found)
    if not levels:
        return {}
    shares = [float(np.mean(list(trials[level]))) for level in levels]
    fit = isotonic_regression(shares, weights=[len(trials[level]) for level in levels], increasing=False)
    return {level: float(share) for level, share in zip(levels, fit.x, strict=True)}


def expected_levels(reached: NDArray[np.bool_], bracket: int) -> NDArray[np.float64]:
    """The level that ``follow`` finds for each of many tables of outcomes, (…,).

    Args:
        reached: whether each seed reaches the target at each level, (…, levels, seeds).
        bracket: seeds that look for the crossing.
    """
    levels = reached.shape[-2]
    first = reached[..., :bracket].sum(-1)
    low = np.zeros(reached.shape[:-2], dtype=np.int64)
    high = np.full_like(low, levels)
    mixed = np.zeros_like(low, dtype=np.bool_)
    while (open_ := low < high).any():
        middle = (low + high + 1) // 2
        found = np.take_along_axis(first, np.maximum(middle - 1, 0)[..., None], axis=-1)[..., 0]
        here = open_ & (found > 0) & (found < bracket)
        mixed |= here
        low = np.where(here | (open_ & (found == bracket)), middle, low)
        high = np.where(here, middle, np.where(open_ & (found == 0), middle - 1, high))
    lowest, highest = np.maximum(low, 1), np.where(mixed, low, np.minimum(low + 1, levels))
    at = np.arange(1, levels + 1)
    all_pass, none_pass = reached.all(-1), ~reached.any(-1)
    begin = np.where(all_pass & (at <= lowest[..., None]), at, 1).max(-1)
    end = np.where(none_pass & (at >= highest[..., None]), at, levels).min(-1)
    within = (at >= begin[..., None]) & (at <= end[..., None])
    successes = (reached.sum(-1) * within).sum(-1)
    seeds = reached.shape[-1]
    found_levels: NDArray[np.float64] = ((begin - 1) * seeds + successes) / seeds
    return found_levels
