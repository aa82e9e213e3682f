"""Search by quality and diversity: an archive with one cell for each set of factors (MAP-Elites, Mouret and Clune 2015).

A cell keeps the case that comes closest to a fall, and of those that fall with several seeds the mildest: the search looks for
failures that need few factors and little of each, and not for luck. Everything here is a pure function of a generator of random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from .ranges import FACTORS, PARAMETERS, Case, Range, Ranges, make_case

MOST_FACTORS = 3
"""Of a case that the search makes up; more are in the random sample."""
CAUSE_APART, VALUES_APART = 0.5, 0.15
"""Least distances of two failures that differ, see ``apart``."""
CONFIDENCE = 0.95
_NEW, _ADD, _DROP = 0.3, 0.15, 0.15
"""Chances that a case is new, and that one that is changed gains or loses a factor."""
_ENDS = 0.5
"""Chance that a new case has all sizes at the ends of their ranges: hard cases first, which then become milder."""
_REACH = 0.15
"""Standard deviation of a change, share of the range."""
_PULL = 0.4
"""Largest share of the way that sizes are moved: to the nominal values in a case that falls, else to the ends of the ranges."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a case."""

    fell: bool
    diverged: bool
    """The physics became invalid; counts as a fall."""
    seconds: float
    """Until the fall, or the end [s]."""
    lean: float
    """Largest tilt, share of the tilt that is a fall, 0 to 1."""


@dataclass(frozen=True)
class Elite:
    """A case with its outcome."""

    case: Case
    outcome: Outcome
    sure: bool = False
    """It fell with every seed of the search, not with the first alone."""


@dataclass
class Archive:
    """The best case of each set of factors."""

    ranges: Ranges
    cells: dict[frozenset[str], Elite] = field(default_factory=dict)

    def add(self, elites: Sequence[Elite]) -> None:
        """Keep those that are better than what their cells hold."""
        for elite in elites:
            held = self.cells.get(elite.case.factors)
            if held is None or self.quality(elite) > self.quality(held):
                self.cells[elite.case.factors] = elite

    def quality(self, elite: Elite) -> float:
        """Return 1 to 2 for a sure fall, more for a milder case; else how far the robot leaned, 0 to 1."""
        return 2.0 - hardness(elite.case, self.ranges) if elite.sure else elite.outcome.lean

    def wants(self, elite: Elite) -> bool:
        """Return whether a case that fell would be the best of its cell if it fell with every seed."""
        held = self.cells.get(elite.case.factors)
        return held is None or self.quality(replace(elite, sure=True)) > self.quality(held)

    @property
    def failures(self) -> list[Elite]:
        """Return the cases that surely fall, those of the fewest factors first, then the mildest."""
        fallen = [elite for elite in self.cells.values() if elite.sure]
        return sorted(fallen, key=lambda e: (len(e.case.factors), hardness(e.case, self.ranges), e.case.name))

    def propose(self, random: np.random.Generator, names: Sequence[str]) -> list[Case]:
        """Return new cases, one for each name: some at random, the others changed from what the cells hold."""
        held = sorted(self.cells.values(), key=lambda elite: elite.case.words)
        weights = np.array([self.quality(elite) + 0.1 for elite in held])
        return [self._propose(random, held, weights, name) for name in names]

    def _propose(
        self, random: np.random.Generator, held: Sequence[Elite], weights: NDArray[np.float64], name: str
    ) -> Case:
        if not held or random.random() < _NEW:
            count = int(random.integers(1, MOST_FACTORS + 1))
            case = random_case(random, self.ranges, name, random.choice(FACTORS, count, replace=False))
            share = 1.0 if random.random() < _ENDS else random.uniform(0.0, 1.0)
            return self._moved(random, name, case.named, case.factors, outwards=True, share=share, reach=0.0)
        elite = held[int(random.choice(len(held), p=weights / weights.sum()))]
        return self._change(random, elite, name)

    def _change(self, random: np.random.Generator, elite: Elite, name: str) -> Case:
        values, factors = elite.case.named, set(elite.case.factors)
        chance = random.random()
        if chance < _ADD and len(factors) < MOST_FACTORS:
            new = str(random.choice([f for f in FACTORS if f not in factors]))
            values |= {k: v for k, v in drawn(random, self.ranges).items() if _FACTOR[k] == new}
            factors.add(new)
        elif chance > 1.0 - _DROP and len(factors) > 1:
            factors.remove(str(random.choice(sorted(factors))))
        share = random.uniform(0.0, _PULL)
        return self._moved(random, name, values, factors, outwards=not elite.sure, share=share, reach=_REACH)

    def _moved(
        self,
        random: np.random.Generator,
        name: str,
        values: dict[str, float],
        factors: Iterable[str],
        *,
        outwards: bool,
        share: float,
        reach: float,
    ) -> Case:
        """Return a case with sizes moved to the ends of the ranges, or to the nominal values, and everything scattered."""
        has = frozenset(factors)
        for parameter in PARAMETERS:
            if parameter.factor in has:
                low, high = bounds(self.ranges, parameter.range)
                value = values[parameter.name] + random.normal(0.0, reach) * (high - low)
                if parameter.sized:
                    end = high if value > parameter.nominal else low
                    value += share * ((end if outwards else parameter.nominal) - value)
                values[parameter.name] = min(max(value, low), high)
        return make_case(name, values, has)


_FACTOR = {p.name: p.factor for p in PARAMETERS}


def bounds(ranges: Ranges, name: str) -> Range:
    """Return a range by its name."""
    low, high = getattr(ranges, name)
    return float(low), float(high)


def drawn(random: np.random.Generator, ranges: Ranges) -> dict[str, float]:
    """Draw every value uniformly; of a count, every number is as likely."""
    found = {}
    for parameter in PARAMETERS:
        low, high = bounds(ranges, parameter.range)
        number = random.random()
        found[parameter.name] = (
            math.floor(low + number * (high - low + 1.0)) if parameter.whole else low + number * (high - low)
        )
    return found


def random_case(
    random: np.random.Generator, ranges: Ranges, name: str, factors: Sequence[str] | np.ndarray = FACTORS
) -> Case:
    """Return a case with all of some factors, drawn uniformly."""
    return make_case(name, drawn(random, ranges), map(str, factors))


def hardness(case: Case, ranges: Ranges) -> float:
    """Return how far a case is from nominal, 0 to 1: the mean over its factors of the root mean square over their sizes."""
    found = []
    for factor in case.words:
        shares = []
        for parameter, value in zip(PARAMETERS, case.values, strict=True):
            if parameter.factor == factor and parameter.sized:
                low, high = bounds(ranges, parameter.range)
                furthest = max(high - parameter.nominal, parameter.nominal - low)
                shares.append((value - parameter.nominal) / furthest)
        found.append(math.sqrt(sum(s * s for s in shares) / len(shares)))
    return sum(found) / len(found) if found else 0.0


def apart(a: Case, b: Case, ranges: Ranges) -> tuple[float, float]:
    """Return two distances of two cases, 0 to 1.

    Returns:
        Of their causes: the share of their factors that only one of them has (Jaccard). Of their values: the root mean square
        over the parameters of all these factors, each as a share of its range.
    """
    both, either = a.factors & b.factors, a.factors | b.factors
    shares = []
    for parameter, x, y in zip(PARAMETERS, a.values, b.values, strict=True):
        if parameter.factor in either:
            low, high = bounds(ranges, parameter.range)
            shares.append((x - y) / (high - low))
    cause = 1.0 - len(both) / len(either) if either else 0.0
    return cause, math.sqrt(sum(s * s for s in shares) / len(shares)) if shares else 0.0


def differ(a: Case, b: Case, ranges: Ranges) -> bool:
    """Return whether two failures differ in their cause: both distances reach their least."""
    cause, values = apart(a, b, ranges)
    return cause >= CAUSE_APART and values >= VALUES_APART


def choose_different(cases: Sequence[Case], ranges: Ranges, most: int) -> list[int]:
    """Return indices of cases that differ from each other, first come first served."""
    chosen: list[int] = []
    for at, case in enumerate(cases):
        if len(chosen) < most and all(differ(case, cases[other], ranges) for other in chosen):
            chosen.append(at)
    return chosen


@dataclass
class Reduction:
    """Take factors away from a case that falls as long as it surely falls without them."""

    elite: Elite
    random: np.random.Generator
    queue: list[str] = field(init=False)
    _changed: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        self._refill()

    def _refill(self) -> None:
        order = list(self.elite.case.words)
        self.random.shuffle(order)
        self.queue, self._changed = order, False

    @property
    def next(self) -> Case | None:
        """Return the case to play next; None where each factor is needed."""
        return self.elite.case.without(self.queue[0]) if self.queue else None

    def tell(self, tried: Elite) -> None:
        """Take in what came of it."""
        self.queue.pop(0)
        if tried.sure:
            self.elite, self._changed = tried, True
        if not self.queue and self._changed:
            self._refill()


def waiting(reductions: Sequence[Reduction]) -> Iterator[tuple[Reduction, Case]]:
    """Yield the reductions that are not at their end, with the case that each plays next."""
    for reduction in reductions:
        if (case := reduction.next) is not None:
            yield reduction, case


def upper_bound(falls: int, cases: int, confidence: float = CONFIDENCE) -> float:
    """Return the upper confidence bound on a probability, one-sided (Clopper and Pearson 1934)."""
    return 1.0 if falls >= cases else float(special.betaincinv(falls + 1, cases - falls, confidence))
