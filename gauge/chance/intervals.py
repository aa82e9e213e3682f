"""Estimate how sure a score is: how far other seeds would have changed it, in the levels found and in the quality measured there.

Terrains, frictions, payloads, goals and their sub-commands are the benchmark and stay. Seeds are a sample, twice over: the search
seeds decide about levels (``level_chance``), the quality seeds about everything that is measured at them. Functions take the rows
of a ``Result``, so that it can be judged long after its episodes are gone.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ..episodes import QUALITY
from ..result import CONFIDENCE, ChanceRules, EnvironmentRow
from .level_area import redraw_areas
from .level_chance import bisected_levels, redraw_levels, shared_luck, success_curves
from .level_curve import expected_levels

Array = NDArray[np.float64]

_QUALITY_STEP = 0.85
"""Share of the quality that is left one level higher: 0.84 on waves and 0.79 on obstacles of ``docs/data/repeated_evaluations.json.gz``."""
_LEVEL_FREEDOM = 8.0
"""Degrees of freedom of the variance of one environment's level, which rests on a dozen trials: so many keep rare false alarms
as rare as they should be (``benchmarks/interval_coverage.py --synthetic``)."""
_UNKNOWN_QUALITY = 0.5
"""Quality at the levels that an environment might have reached, where no quality was measured anywhere."""


@dataclass(frozen=True, kw_only=True)
class Chance:
    """The chance in a weighted sum over environments: independent parts with variances that add up."""

    levels: Array
    """Deviation in each replicate of the level searches, (B,); zeros where levels were given."""
    level_freedom: float = math.inf
    """Degrees of freedom of their variance."""
    seeds: tuple[Array, ...]
    """Tables of deviations of the quality seeds from their mean, (independent streams, S); a stream's seeds are paired."""

    @property
    def known(self) -> bool:
        """True where the spread can be estimated: one seed shows none."""
        return all(table.shape[1] > 1 for table in self.seeds)

    def _parts(self) -> tuple[Array, Array]:
        """Return variances that add up, of levels and of every stream of seeds, and their degrees of freedom."""
        tables = [t for t in self.seeds if t.size]
        variances = [(t**2).sum(1) / (t.shape[1] * (t.shape[1] - 1)) for t in tables]
        freedom = [np.full(len(t), t.shape[1] - 1.0) for t in tables]
        levels = np.array([self.levels.var()])
        return np.concatenate([levels, *variances]), np.concatenate([[self.level_freedom], *freedom])

    @property
    def error(self) -> float:
        """Standard error."""
        return math.sqrt(float(self._parts()[0].sum()))

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the standard error (Welch and Satterthwaite)."""
        return welch(*self._parts())

    def interval(
        self, value: float, bounds: tuple[float, float] | None = (0.0, 1.0), *, together: int = 1
    ) -> tuple[float, float] | None:
        """Return Student's 95 % interval around a value, within the bounds of what it can be; None where one seed shows no spread.

        Args:
            together: number of intervals that shall cover their values all at once with 95 % (Šidák 1967, which holds for
                normal values whatever they have in common).
        """
        if not self.known:
            return None
        reach = float(special.stdtrit(self.freedom, 0.5 + 0.5 * CONFIDENCE ** (1.0 / together))) * self.error
        low, high = bounds or (-math.inf, math.inf)
        return max(value - reach, low), min(value + reach, high)

    def p_value(self, value: float) -> float | None:
        """Return the chance of a value at least so far from zero if nothing but chance acts, two-sided; None where that is not known."""
        if not self.known:
            return None
        if self.error == 0.0:
            return 1.0 if value == 0.0 else 0.0
        return 2.0 * float(special.stdtr(self.freedom, -abs(value) / self.error))

    def minus(self, other: Chance, *, paired: bool) -> Chance:
        """Return the chance in a difference.

        Args:
            other: of the value that is subtracted; its level searches are independent of these.
            paired: both have the same seeds in the same order, whose differences are the sample.
        """
        seeds = (*self.seeds, *other.seeds)
        if paired:
            seeds = tuple(a - b for a, b in zip(self.seeds, other.seeds, strict=True))
        variances = np.array([self.levels.var(), other.levels.var()])
        freedom = welch(variances, np.array([self.level_freedom, other.level_freedom]))
        return Chance(levels=self.levels - other.levels, level_freedom=freedom, seeds=seeds)


def welch(variances: Array, freedoms: Array) -> float:
    """Return the degrees of freedom of a sum of estimated variances (Welch and Satterthwaite); infinite for none."""
    uncertain = float((variances**2 / freedoms).sum())
    return float(variances.sum()) ** 2 / uncertain if uncertain > 0.0 else math.inf


def wilson_interval(share: float, trials: float) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share of successes among so many independent trials (Wilson 1927)."""
    z = float(special.ndtri(0.5 + 0.5 * CONFIDENCE))
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    reach = z / (1 + z**2 / trials) * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return max(centre - reach, 0.0), min(centre + reach, 1.0)


class Evidence:
    """Trials and runs of the environments of one evaluation, as arrays.

    Attributes:
        rows: the environments of the result.
        redrawn: maximum levels of the searches done again, (E, B).
    """

    def __init__(self, rows: Sequence[EnvironmentRow], rules: ChanceRules, *, name: str = "") -> None:
        """Read the rows and redo the searches.

        Args:
            rows: environments, with ``trials`` where their level was searched and ``runs`` where quality was measured.
            name: seeds the generator, so that the same rows have the same intervals; evaluations that are compared have two.
        """
        self.rows, self._rules = list(rows), rules
        self._known: dict[tuple[str, ...], Array] = {}
        self._flat = np.array([r.flat for r in rows], dtype=bool)
        self._reached = np.array([r.reached for r in rows], dtype=np.float64)
        self._searched = np.array([bool(r.trials) for r in rows], dtype=bool)
        self._played = np.array([bool(r.runs) for r in rows], dtype=bool)
        self.redrawn = np.repeat(self._reached[:, None], rules.resamples, axis=1)
        self._redraw(np.random.default_rng(zlib.crc32(f"levels {name}".encode())))

    def _redraw(self, generator: np.random.Generator) -> None:
        searched = np.flatnonzero(self._searched).tolist()
        if not searched:
            return
        searches, rules = [self.rows[at].trials for at in searched], self._rules
        if rules.level == "area":
            noise = generator.standard_normal((len(searched), rules.resamples))
            outcomes = [{level: [*found.values()] for level, found in trials.items() if found} for trials in searches]
            self.redrawn[searched] = redraw_areas(self._reached[searched], outcomes, noise)
            return
        curves = success_curves(searches, [self.rows[at].terrain for at in searched], rules.levels)
        self.redrawn[searched] = redraw_levels(
            curves,
            seeds=len(rules.search_seeds),
            find=partial(expected_levels, bracket=rules.bracket_seeds)
            if rules.level == "curve"
            else partial(bisected_levels, pass_rate=rules.pass_rate),
            luck=shared_luck(searches, curves) if rules.shared_noise else 0.0,
            resamples=rules.resamples,
            generator=generator,
        )

    def of(self, rows: Sequence[EnvironmentRow]) -> Evidence:
        """Return evidence by the same rules from other rows."""
        return Evidence(rows, self._rules)

    def runs(self, columns: Sequence[str]) -> Array:
        """Return the mean of some columns in every run, (E, S); zeros where an environment has none.

        Columns are metrics, ``quality`` or names of sub-commands, whose column is their quality.
        """
        if (known := self._known.get(tuple(columns))) is not None:
            return known
        values = self._known[tuple(columns)] = np.zeros((len(self.rows), len(self._rules.seeds)))
        for at in np.flatnonzero(self._played).tolist():
            for place, seed in enumerate(self._rules.seeds):
                run = self.rows[at].runs[seed]
                found = {**run.columns, **run.commands}
                values[at, place] = sum(found[c] for c in columns) / len(columns)
        return values

    def chance(self, weights: Array, columns: Sequence[str] = (QUALITY,)) -> Chance:
        """Return the chance in a weighted sum over environments of level-weighted values: of the score, with the column ``quality``.

        Args:
            weights: (E,).
            columns: see ``runs``.
        """
        rules, means = self._rules, self._supposed(self.runs(columns).mean(1))[:, None]
        levels, at = np.zeros_like(self.redrawn), np.flatnonzero(~self._flat & (weights != 0.0))
        redrawn, means = self.redrawn[at], means[at]
        if QUALITY in columns:
            away = np.where(self._reached[at] > 0, redrawn.T - self._reached[at], 0).T
            means = np.minimum(means * _QUALITY_STEP**away, 1.0)
        levels[at] = weights[at, None] * self._at_levels(redrawn, means)
        share = rules.quality_weight * np.minimum(self._reached, 1.0)
        at_reached = self.chance_at_levels(weights * np.where(self._flat, 1.0, share), columns)
        return replace(at_reached, **self._of_levels(levels), seeds=(*at_reached.seeds, self._search_seeds(weights)))

    def chance_at_levels(self, weights: Array, columns: Sequence[str]) -> Chance:
        """Return the chance in a weighted sum over environments of values as measured at the levels reached, see ``chance``."""
        values = self.runs(columns)
        deviations = weights[:, None] * (values - values.mean(1, keepdims=True))
        shared = self._rules.shared_noise
        return Chance(
            levels=np.zeros(self._rules.resamples), seeds=(deviations.sum(0, keepdims=True) if shared else deviations,)
        )

    def value(self, weights: Array, columns: Sequence[str] = (QUALITY,)) -> float:
        """Return the weighted sum over environments of level-weighted values, see ``chance``."""
        means = self.runs(columns).mean(1)
        return float(weights @ np.where(self._flat, means, self._at_levels(self._reached, means)))

    def _at_levels(self, levels: Array, means: Array) -> Array:
        """``scoring.level_score`` of levels and values that broadcast."""
        rules = self._rules
        of_quality = rules.quality_weight * np.minimum(levels, 1.0) * means
        return rules.level_weight * np.maximum(levels - 1.0, 0.0) + of_quality

    def level_chance(self, weights: Array) -> Chance:
        """Return the chance in a weighted sum of the environments' levels, ``weights`` (E,). Quality seeds play no part."""
        return Chance(**self._of_levels(weights[:, None] * self.redrawn), seeds=(self._search_seeds(weights),))

    def _of_levels(self, levels: Array) -> dict[str, Any]:
        """Return the part of the levels in ``Chance``, from what each environment adds in each replicate, (E, B)."""
        freedom = welch(levels.var(axis=1), np.full(len(levels), _LEVEL_FREEDOM))
        total = levels.sum(0)
        return {"levels": total - total.mean(), "level_freedom": freedom}

    def _search_seeds(self, weights: Array) -> Array:
        """Return no deviations, of as many seeds as stand behind the levels; two where the levels were given, and are certain."""
        return np.zeros((0, len(self._rules.search_seeds) if (self._searched & (weights != 0.0)).any() else 2))

    def _supposed(self, means: Array) -> Array:
        """Return qualities, (E,), and where none was measured, because no level was passed, the mean of the terrain or of all others."""
        levelled = self._played & ~self._flat
        found = means.copy()
        for at in np.flatnonzero(~self._played & ~self._flat):
            mine = levelled & np.array([r.terrain == self.rows[at].terrain for r in self.rows])
            known = mine if mine.any() else levelled
            found[at] = means[known].mean() if known.any() else _UNKNOWN_QUALITY
        return found
