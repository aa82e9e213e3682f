"""Paired comparisons of two engines, or two settings of one: means with intervals, effect sizes, agreement of outcomes.

Pure functions of arrays; formulas and assumptions are in ``docs/guides/consistency.md``.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ...gauge.chance.intervals import welch, wilson_interval
from ...gauge.result import CONFIDENCE
from ...gauge.totals import environment_weights

Array = NDArray[np.float64]

EQUIVALENT, DIFFERENT, UNDECIDED = "equivalent", "different", "undecided"
_MOST_SEEDS = 1000
_TINY = 1e-12
"""Spread below which differences count as all the same."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A mean with its 95 % interval."""

    value: float
    low: float
    high: float
    error: float = 0.0
    """Standard error of the mean."""
    freedom: float = math.inf
    """Degrees of freedom of the error."""
    seeds: int = 0
    """Number of seeds that it is made of."""

    def deciding_seeds(self, margin: float) -> int | None:
        """Return how many seeds would make a verdict of the same difference and scatter; None beyond ``_MOST_SEEDS``."""
        aim = max(abs(self.value), margin - abs(self.value))
        for seeds in range(max(self.seeds, 2), _MOST_SEEDS + 1):
            freedom = self.freedom * (seeds - 1) / max(self.seeds - 1, 1)
            if stats.t.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * self.error * math.sqrt(self.seeds / seeds) < aim:
                return seeds
        return None

    def verdict(self, margin: float) -> str:
        """What the interval allows to say: ``equivalent`` where all of it lies within the margin, ``different`` where it leaves
        zero out, else ``undecided``: chance could hide a difference that matters.
        """
        if -margin < self.low and self.high < margin:
            return EQUIVALENT
        return UNDECIDED if self.low <= 0.0 <= self.high else DIFFERENT

    def plain(self) -> dict[str, float | list[float]]:
        """As plain data."""
        return {"value": self.value, "interval": [self.low, self.high]}


def spread_of_mean(values: Array, weights: Array, *, shared: bool) -> tuple[float, float]:
    """Standard error of the weighted mean, and its degrees of freedom.

    Args:
        values: (E, S).
        weights: (E,).
        shared: whether the environments share the seeds' draws. Then the weighted sums of the seeds are the sample, with
            S - 1 degrees of freedom; else every environment is one, and Welch and Satterthwaite say how many they amount to.
    """
    seeds = values.shape[1]
    if shared:
        return float((weights @ values).std(ddof=1) / math.sqrt(seeds)), float(seeds - 1)
    parts = weights**2 * values.var(axis=1, ddof=1) / seeds
    return math.sqrt(float(parts.sum())), welch(parts, np.full(len(parts), seeds - 1.0))


def tail_probability(seeds: int, freedom: float) -> float:
    """Probability left out on either side of a bootstrap distribution so that its quantiles bound a 95 % interval.

    A bootstrap of n units is too narrow by sqrt((n - 1) / n) and knows nothing of Student's t. Reading it at
    Φ(-sqrt(n / (n - 1)) t) instead of 2.5 % makes up for both (Hesterberg 2015, "What teachers should know about the
    bootstrap": the expanded percentile interval).

    Args:
        seeds: number of seeds n, at least 2.
        freedom: degrees of freedom of t.
    """
    quantile = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, freedom)
    return float(stats.norm.cdf(-math.sqrt(seeds / (seeds - 1)) * quantile))


def replicates(values: Array, weights: Array, *, shared: bool, resamples: int, name: str) -> Array:
    """Bootstrap replicates of the weighted mean over environments of the mean over seeds, (B,).

    The unit that is drawn with replacement is the seed, with all that an episode holds: its goals and sub-commands stay
    together. Values are paired already (each is the difference, or its magnitude, between two engines in one episode).

    Args:
        values: one number for each environment and seed, (E, S).
        weights: of the environments, adding up to one, (E,).
        shared: draw the same seeds for all environments (their episodes share random numbers), or anew for each.
        name: seeds the generator, so that the same question has the same answer.
    """
    environments, seeds = values.shape
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    if shared:
        per_seed = weights @ values
        return per_seed[generator.integers(seeds, size=(resamples, seeds))].mean(1)
    total = np.zeros(resamples)
    for environment in range(environments):
        drawn = generator.integers(seeds, size=(resamples, seeds))
        total += weights[environment] * values[environment][drawn].mean(1)
    return total


def by_goal(values: Array, terrains: Sequence[str], *, shared: bool) -> tuple[Array, Array]:
    """Return paired values of the goals of episodes as independent rows, (R, S), and their weights, (R,).

    Each goal of an episode has noise of its own, so that its scatter over the seeds says something more of the mean's. Where
    episodes of a seed share their random numbers, a row is one goal over all environments, else a goal of an environment.

    Args:
        values: (E, S, G).
    """
    weights, goals = environment_weights(terrains), values.shape[2]
    if shared:
        return np.einsum("e,esg->gs", weights, values), np.full(goals, 1.0 / goals)
    return values.transpose(0, 2, 1).reshape(-1, values.shape[1]), np.repeat(weights / goals, goals)


def paired_mean(
    values: Array,
    terrains: Sequence[str],
    *,
    shared: bool,
    resamples: int,
    name: str,
    magnitude: bool = False,
    weights: Array | None = None,
) -> Estimate:
    """Mean of paired values over terrains, their environments and the seeds, with its 95 % interval.

    The interval is the expanded percentile interval of the bootstrap, widened to Student's where that is wider: resamples of a
    handful of seeds never leave the range of what was seen.

    Args:
        values: (E, S).
        terrains: terrain of each environment.
        shared, resamples, name: see ``replicates``.
        magnitude: the values are magnitudes, so that the interval ends at zero.
        weights: of the rows, (E,), in place of the terrains'.

    Raises:
        ValueError: fewer than two seeds, from which no spread can be seen.
    """
    if values.shape[1] < 2:
        raise ValueError(f"an interval needs at least 2 seeds, not {values.shape[1]}")
    weights = environment_weights(terrains) if weights is None else weights
    mean = float(weights @ values.mean(1))
    error, freedom = spread_of_mean(values, weights, shared=shared)
    draws = replicates(values, weights, shared=shared, resamples=resamples, name=name)
    tail = tail_probability(values.shape[1], freedom)
    low, high = (float(q) for q in np.quantile(draws, [tail, 1.0 - tail]))
    reach = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, freedom)) * error
    low, high = min(low, mean - reach), max(high, mean + reach)
    seeds, low = values.shape[1], max(low, 0.0) if magnitude else low
    return Estimate(value=mean, low=low, high=high, error=error, freedom=freedom, seeds=seeds)


def effect_size(differences: Array) -> float | None:
    """Cohen's d of paired differences: their mean over their standard deviation (N - 1), all episodes weighing the same.

    Returns:
        0 where all differences vanish; None where they are all the same and not zero, so that d has no bound, or where
        there are fewer than two.
    """
    flat = np.asarray(differences, dtype=np.float64).ravel()
    if len(flat) < 2:
        return None
    spread = float(flat.std(ddof=1))
    if spread < _TINY:
        return 0.0 if abs(float(flat.mean())) < _TINY else None
    return float(flat.mean()) / spread


def outcome_agreement(
    reference: Sequence[bool], compared: Sequence[bool], seeds: Sequence[int], *, shared: bool
) -> dict[str, Any] | None:
    """How often a yes-or-no outcome was the same in both engines, over paired episodes; None where there are none.

    Episodes that share a seed's random numbers are no independent witnesses. The interval is Wilson's for as many episodes as
    they amount to (Korn and Graubard 1998, "Confidence intervals for proportions with small expected number of positive counts
    estimated from survey data"). The test turns the engines of whole seeds round in all ways; with a seed for each episode
    that is McNemar's exact test.

    Args:
        reference, compared: outcomes in both engines, (N,).
        shared: whether episodes of one seed share its random numbers.

    Returns:
        Counts of ``episodes`` and of each outcome, the share with the ``same`` and its 95 % ``interval``, and ``p_value``: how
        likely so lopsided a count of disagreements is if either engine may be the one.
    """
    first, second = np.asarray(reference, dtype=bool), np.asarray(compared, dtype=bool)
    if len(first) == 0:
        return None
    _, cluster = np.unique(seeds if shared else np.arange(len(first)), return_inverse=True)
    lone = np.bincount(cluster, weights=second.astype(float) - first)
    same = first == second
    return {
        "episodes": len(first),
        "same": int(same.sum()) / len(first),
        "interval": list(_share_interval(same.astype(float), cluster)),
        "both": int((first & second).sum()),
        "only_reference": int((first & ~second).sum()),
        "only_compared": int((~first & second).sum()),
        "neither": int((~first & ~second).sum()),
        "p_value": sign_flip(lone.astype(np.int64)),
    }


def _share_interval(same: Array, cluster: NDArray[np.intp]) -> tuple[float, float]:
    """95 % interval of a share from clusters of observations."""
    count, clusters, share = len(same), int(cluster.max()) + 1, float(same.mean())
    effective = float(count)
    if clusters < count:
        if clusters < 2:
            return 0.0, 1.0
        independent = share * (1.0 - share) / count
        seen = clusters / (clusters - 1) * float((np.bincount(cluster, weights=same - share) ** 2).sum()) / count**2
        student = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, [count - 1, clusters - 1])
        effective /= max(seen / independent if independent > 0.0 else 1.0, 1.0) * (student[1] / student[0]) ** 2
    return wilson_interval(share, effective)


def sign_flip(differences: NDArray[np.int64]) -> float:
    """Share of all ways to turn signs of whole numbers, (N,), round in which the sum is at least as far from zero, exactly."""
    sizes = np.abs(differences[differences != 0])
    ways = np.ones(1)
    for size in sizes.tolist():
        halves = np.zeros(len(ways) + 2 * size)
        halves[: len(ways)] += 0.5 * ways
        halves[2 * size :] += 0.5 * ways
        ways = halves
    sums = np.arange(len(ways)) - int(sizes.sum())
    return float(min(ways[np.abs(sums) >= abs(int(differences.sum()))].sum(), 1.0))
