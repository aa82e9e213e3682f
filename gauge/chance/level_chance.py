"""How much of a maximum level is chance: success by level, fitted to the trials of a search, and the search done again.

A search with five seeds a level finds another level with other seeds. How often which one follows from the chance to reach the
target at each level. That chance is fitted to the trials that were played, and the whole search is redone with successes drawn
from the fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

Array = NDArray[np.float64]
Trials = Mapping[int, Mapping[int, bool]]
"""Whether the target was reached, by level and then by seed; levels and seeds that were not played are absent."""

_CENTRE_STEP, _BEYOND = 0.25, 3.0
"""Grid of the levels at which half of the seeds may reach the target, all as likely beforehand; it goes on beyond the first and
the last level, for what is never or always passed."""
_WIDTHS = np.geomspace(0.1, 2.5, 17)
"""Levels within which the odds of a success fall by a factor e: from a bar too high for every seed to waves that get a little worse."""
_USUAL_WIDTH = 0.7
"""Median of the width beforehand [levels]."""
_WIDTH_SPREAD, _TERRAIN_SPREAD = 0.4, 0.4
"""Standard deviations of the logarithm of the width: beforehand of a policy's usual one, and of its terrains' around that."""


def success_curves(searches: Sequence[Trials], terrains: Sequence[str], levels: int) -> Array:
    """Chance to reach the target at every level.

    A logistic curve in the level for each search. Its centre is its own; its width is common to the searches on one terrain, and
    those of a policy's terrains are alike. Centre and width are their means over what the trials leave possible, so that five
    successes in five trials are not taken for certainty, nor none in two for impossibility.

    Returns:
        (searches, levels), falling along each row.
    """
    grid = np.arange(1.0 - _BEYOND, levels + _BEYOND + 1e-9, _CENTRE_STEP)
    chance = _logistic((grid[:, None, None] - np.arange(1, levels + 1)) / _WIDTHS[:, None])
    log_pass, log_fail = np.log(chance), np.log1p(-chance)
    likelihoods = np.zeros((len(searches), len(grid), len(_WIDTHS)))
    for at, trials in enumerate(searches):
        for level, outcomes in trials.items():
            reached = sum(outcomes.values())
            failed = len(outcomes) - reached
            likelihoods[at] += reached * log_pass[:, :, level - 1] + failed * log_fail[:, :, level - 1]
    centres = _shares(likelihoods, axis=1)
    names = list(dict.fromkeys(terrains))
    groups = [np.array([t == name for t in terrains]) for name in names]
    of_width = np.array([np.logaddexp.reduce(likelihoods[mine], axis=1).sum(0) for mine in groups])
    log_widths = np.log(_WIDTHS / _USUAL_WIDTH)
    around = np.log(_shares(-0.5 * ((log_widths - log_widths[:, None]) / _TERRAIN_SPREAD) ** 2, axis=1))
    # (terrains, usual width): by each terrain of the usual one
    told = np.logaddexp.reduce(around + of_width[:, None], axis=2)
    beforehand = -0.5 * (log_widths / _WIDTH_SPREAD) ** 2
    curves = np.zeros((len(searches), levels))
    for terrain, mine in enumerate(groups):
        usual = beforehand + told.sum(0) - told[terrain]
        width = _shares(np.logaddexp.reduce(usual[:, None] + around, axis=0) + of_width[terrain], axis=0)
        centre = np.einsum("ecw,w,c->e", centres[mine], width, grid)
        spread = math.exp(float(width @ np.log(_WIDTHS)))
        curves[mine] = _logistic((centre[:, None] - np.arange(1, levels + 1)) / spread)
    return curves


def _shares(logarithms: Array, axis: int) -> Array:
    """Numbers above zero that add up to one along an axis, from their logarithms up to a constant."""
    values = np.exp(logarithms - logarithms.max(axis, keepdims=True))
    return values / values.sum(axis, keepdims=True)


def bisect(passed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the level that ``plan``'s search finds for each table of outcomes, (…, levels) to (…,); 0 where none is passed."""
    low = np.zeros(passed.shape[:-1], dtype=np.int64)
    high = np.full_like(low, passed.shape[-1])
    while (open_ := low < high).any():
        middle = (low + high + 1) // 2
        outcome = np.take_along_axis(passed, np.maximum(middle - 1, 0)[..., None], axis=-1)[..., 0]
        low = np.where(open_ & outcome, middle, low)
        high = np.where(open_ & ~outcome, middle - 1, high)
    return low


def shared_luck(searches: Sequence[Trials], curves: Array) -> float:
    """Correlation of the luck that a seed has in different environments, 0 to below 1.

    Where the environments of a seed share its random numbers, a seed may be easy or hard everywhere. The estimate compares the
    products of residuals of one seed in two environments with what they would be if its luck were the same (method of moments);
    correlations of outcomes become those of the normal variable behind them. What lies within one standard error of zero is
    taken for zero: many environments of few seeds would turn its noise into a far too wide interval.

    Args:
        curves: their ``success_curves``, (searches, levels).
    """
    sums: dict[int, list[tuple[float, float, float]]] = {}
    for trials, curve in zip(searches, curves, strict=True):
        of_seed: dict[int, list[tuple[float, float]]] = {}
        for level, outcomes in trials.items():
            for seed, reached in outcomes.items():
                chance = curve[level - 1]
                of_seed.setdefault(seed, []).append((reached - chance, chance * (1.0 - chance)))
        for seed, played in of_seed.items():
            residuals, variances = np.array(played).T
            sums.setdefault(seed, []).append((residuals.sum(), np.sqrt(variances).sum(), variances.sum()))
    tables = [np.array(of_environments) for of_environments in sums.values()]
    # over pairs of environments of a seed: products of residuals, of their standard deviations, and of their variances
    seen, most, variance = sum((t.sum(0) ** 2 - (t**2).sum(0) for t in tables), np.zeros(3))
    if most <= 1e-9 or seen <= math.sqrt(2.0 * variance):
        return 0.0
    return min(math.sin(0.5 * math.pi * min(seen / most, 1.0)), 0.95)


def bisected_levels(reached: NDArray[np.bool_], pass_rate: float) -> NDArray[np.int64]:
    """Return the level that a bisection finds, (…,), where ``pass_rate`` of the seeds must have ``reached`` it, (…, levels, seeds)."""
    return bisect(reached.sum(-1) >= math.ceil(pass_rate * reached.shape[-1] - 1e-9))


def redraw_levels(
    curves: Array,
    *,
    seeds: int,
    find: Callable[[NDArray[np.bool_]], NDArray[Any]],
    luck: float,
    resamples: int,
    generator: np.random.Generator,
) -> Array:
    """Maximum levels of searches that are done again with other seeds, (E, B).

    Args:
        curves: chance of success, (E, levels).
        seeds: search seeds a level.
        find: the level for each table of outcomes, (…, levels, seeds) to (…,).
        luck: correlation of a seed's luck between environments, see ``shared_luck``.
        resamples: number of replicates B.
    """
    environments, levels = curves.shape
    common = math.sqrt(luck) * generator.standard_normal((resamples, 1, seeds))
    found = np.zeros((environments, resamples))
    for at, thresholds in enumerate(special.ndtri(curves)):
        own = math.sqrt(1.0 - luck) * generator.standard_normal((resamples, levels, seeds))
        found[at] = find(common + own < thresholds[:, None])
    return found


def _logistic(values: Array) -> Array:
    return np.clip(1.0 / (1.0 + np.exp(-values)), 1e-6, 1.0 - 1e-6)
