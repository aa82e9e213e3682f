"""The level as the area under the pass curve, without bias whatever the shape of the curve: one trial at each level, then more near
the place where the outcomes of the *other* levels change.

A design that stops at a level which all seeds pass never sees a failure below it, and takes 0.27 levels too much from a policy that
fails one easy trial in ten. Here every level is played, and the number of trials at a level depends on the first outcomes of all
other levels, never on its own. Given that number, the share of successes at a level has the chance to pass it as its mean, so the
sum of the shares has the area under the pass curve as its mean: for steep curves, lapses at easy levels, bumps and steps alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Outcomes = Sequence[bool | None]
"""Outcome of each search seed at a level, in the order of the seeds; None for those that have not ended."""

_REACH = 5
"""Levels from the crossing at which a single trial is left."""
_SHRUNK = 0.5
"""Share of an environment's variance that is taken from the mean of all environments: six trials alone show it badly."""
_USUAL = 0.1
"""Variance of one environment's level that is supposed beforehand, and counts as much as that of one environment."""

_CAUTION = 1.2
"""Factor on variances: how fast the quality falls with the level is known roughly, and false alarms should stay below 5 %."""


@dataclass(frozen=True, kw_only=True)
class AreaSearch:
    """The trials of an environment that are known to count."""

    seeds: Mapping[int, int]
    """Number of seeds, from the first on, that count at each level."""
    near: tuple[int, int]
    """Lowest and highest level among which the crossing lies as far as is known."""
    level: float | None
    """Area under the pass curve, once all trials that count have ended."""


def follow_area(outcomes: Callable[[int], Outcomes], levels: int, seeds: int) -> AreaSearch:
    """Return the trials that count as far as outcomes are known, and the level once they have ended.

    Args:
        outcomes: gives the outcome of every seed at a level.
        levels: highest level.
        seeds: search seeds of a level.
    """
    every = range(1, levels + 1)
    first = [outcomes(level)[0] for level in every]
    if None in first:
        low = max((level for level in every if first[level - 1]), default=0)
        high = min((level for level in every if first[level - 1] is False), default=levels + 1)
        return AreaSearch(seeds=dict.fromkeys(every, 1), near=(min(low, high), max(low, high)), level=None)
    counts = trial_counts(tuple(map(bool, first)), seeds)
    trials = {level: list(outcomes(level)[: counts[level - 1]]) for level in every}
    nearest = [level for level in every if counts[level - 1] == max(counts)]
    open_ = any(None in found for found in trials.values())
    return AreaSearch(
        seeds=dict(zip(every, counts, strict=True)),
        near=(nearest[0], nearest[-1]),
        level=None if open_ else float(sum(Fraction(found.count(True), len(found)) for found in trials.values())),
    )


@lru_cache(maxsize=4096)
def trial_counts(first: tuple[bool, ...], seeds: int) -> tuple[int, ...]:
    """Return the number of trials at each level: ``seeds`` beside the crossing, a fifth of them less with every level away, one at least.

    The crossing is the split of the other levels into passed ones below and failed ones above that contradicts the fewest of their
    first outcomes; splits that do as well count alike. The own outcome of a level plays no part in its number.
    """
    counts = []
    for at in range(len(first)):
        others = np.delete(np.array(first, dtype=np.int64), at)
        failed_below = np.concatenate(([0], np.cumsum(1 - others)))
        passed_above = np.concatenate((np.cumsum(others[::-1])[::-1], [0]))
        against = failed_below + passed_above
        best = np.flatnonzero(against == against.min())
        away = max(int(best[0]) - at, at - int(best[-1]), 0)
        counts.append(max(seeds * (_REACH - away) // _REACH, 1))
    return tuple(counts)


def area_variances(searches: Sequence[Mapping[int, Sequence[bool]]]) -> Array:
    """Return the variance of the level of each search, (E,) [levels²].

    That of a share p of n ≥ 2 trials is p (1 - p) / (n - 1). Levels with a single trial lie far from the crossing: those below it,
    of all searches, have one common share, and those above have another, which is too much rather than too little where they
    differ. Half of an environment's variance is the mean of all, and all are a little larger than estimated.

    Args:
        searches: outcomes by level.
    """
    own, singles = np.zeros(len(searches)), np.zeros((len(searches), 2))
    passed = np.zeros(2)
    for at, trials in enumerate(searches):
        most = max(len(found) for found in trials.values())
        crossing = min(level for level, found in trials.items() if len(found) == most)
        for level, found in trials.items():
            share, count = sum(found) / len(found), len(found)
            if count > 1:
                own[at] += share * (1.0 - share) / (count - 1)
            else:
                singles[at, int(level > crossing)] += 1
                passed[int(level > crossing)] += share
    total = singles.sum(0)
    share = passed / np.maximum(total, 1.0)
    own += singles @ (share * (1.0 - share) * total / np.maximum(total - 1.0, 1.0))
    mean = (own.sum() + _USUAL) / (len(own) + 1)
    return _CAUTION * ((1.0 - _SHRUNK) * own + _SHRUNK * mean)


def redraw_areas(levels: Array, searches: Sequence[Mapping[int, Sequence[bool]]], noise: Array) -> Array:
    """Return levels as other seeds would have found them, (E, B): as far from those found as ``area_variances`` says.

    Args:
        levels: found, (E,).
        searches: outcomes by level of each.
        noise: standard normal numbers, (E, B).
    """
    return levels[:, None] + np.sqrt(area_variances(searches))[:, None] * noise
