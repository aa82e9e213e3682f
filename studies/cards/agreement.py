"""Compare every figure of a card with a replay that came out otherwise, as it does on another kind of processor.

Card and replay are two draws of the same episodes, so a figure of both may differ by √2 times what one may be off. How far that is
follows from the replay's runs and trials: what a card says of its own spread does not count.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy import special

from ...gauge.chance.intervals import Array, Evidence, welch
from ...gauge.result import ChanceRules, EnvironmentRow, Run
from ...gauge.totals import COUNTS, runs_at

_FALSE_ALARM = 0.01
"""Chance that an honest card has a figure that is off, over all figures (Bonferroni)."""
_LEAST_SPREAD = 0.02
"""Standard deviation of a run's figure that is supposed at least: a single fall shows in a run what others never have."""

_LEAST_LEVEL = 1.0 / math.sqrt(12.0)
"""Standard error of a level that bisection finds, at least: that of rounding. All seeds at the last level leave 0.07 by the fit."""

Rows = Sequence[tuple[EnvironmentRow, EnvironmentRow]]
"""Pairs of environments: of the card and of the replay."""
Quantity = tuple[str, float, float, float]
"""Name, card's value less the replay's, standard error of that, degrees of freedom."""


def figures_that_are_off(pairs: Rows, rules: ChanceRules, *, flattering: bool = False) -> list[str]:
    """Return the names of the figures of a card that differ from the replay's by more than chance explains.

    Args:
        pairs: environments that were played again.
        rules: the replay's.
        flattering: True looks only at figures that are better on the card, as with other seeds.
    """
    found = [quantity for scope, chosen in _scopes(pairs) for quantity in _quantities(scope, chosen, rules)]
    level = 0.5 * _FALSE_ALARM / max(len(found), 1)
    off = []
    for name, difference, error, freedom in found:
        worse_is_more = name.partition(" ")[0] in (*COUNTS, "self_contact")
        if flattering and (difference > 0) == worse_is_more:
            continue
        if abs(difference) > -float(special.stdtrit(freedom, level)) * error:
            off.append(name)
    return off


def _scopes(pairs: Rows) -> Iterator[tuple[str, Rows]]:
    """Yield all environments, and those of each terrain."""
    yield "", pairs
    terrains = list(dict.fromkeys(old.terrain for old, _ in pairs))
    for terrain in terrains if len(terrains) > 1 else ():
        yield f" on {terrain}", [pair for pair in pairs if pair[0].terrain == terrain]


def _quantities(scope: str, pairs: Rows, rules: ChanceRules) -> Iterator[Quantity]:
    levelled = [pair for pair in pairs if pair[1].search is not None]
    if levelled:
        weights = np.full(len(levelled), 1.0 / len(levelled))
        chance = Evidence([new for _, new in levelled], rules).level_chance(weights)
        difference = float(np.mean([old.reached - new.reached for old, new in levelled]))
        least = _LEAST_LEVEL / math.sqrt(len(levelled)) if rules.level == "bisection" else 0.0
        yield f"level{scope}", difference, math.sqrt(2.0) * max(chance.error, least), chance.freedom
    tables = [tables for pair in pairs if (tables := _at_one_level(*pair))]
    if not tables:
        return
    for name, values in _runs(tables).items():
        old, new = values
        count = name.partition(".")[0] in COUNTS
        spread = new.var(1, ddof=1) if new.shape[1] > 1 else np.zeros(len(new))
        # a count that the replay never has may be one of the card: its variance is at least its mean, as Poisson's
        least = (old.mean() + new.mean() + 1.0 / new.size) / 2.0 if count else _LEAST_SPREAD**2
        variances = 2.0 * np.maximum(spread, least) / (new.shape[1] * len(new) ** 2)
        freedom = welch(variances, np.full(len(new), max(new.shape[1] - 1.0, 1.0)))
        yield f"{name}{scope}", float((old - new).mean()), math.sqrt(float(variances.sum())), freedom


def _at_one_level(old: EnvironmentRow, new: EnvironmentRow) -> tuple[list[Run], list[Run]] | None:
    """Return the runs of card and replay at the lowest level at which both were measured; None where there is none."""
    tables = runs_at(old), runs_at(new)
    common = sorted(tables[0].keys() & tables[1].keys())
    if not common:
        return None
    one, other = ([*table[common[0]].values()] for table in tables)
    return (one, other) if len(one) == len(other) else None


def _runs(tables: Sequence[tuple[list[Run], list[Run]]]) -> dict[str, tuple[Array, Array]]:
    """Return every quantity of the runs of card and replay, (E, S) each, by name; those alone that all of them have."""
    flat = [[[_flat(run) for run in runs] for runs in pair] for pair in tables]
    names = set.intersection(*({*run} for pair in flat for runs in pair for run in runs))
    return {
        name: tuple(np.array([[run[name] for run in pair[at]] for pair in flat]) for at in (0, 1))  # type: ignore[misc]
        for name in sorted(names)
    }


def _flat(run: Run) -> dict[str, float]:
    """Return the figures of a run by name."""
    found = {f"{column}.mean50": value for column, value in run.columns.items()} | dict(run.commands)
    if run.health is not None:
        found |= {f"{column}.mean": value for column, value in run.mean.items()}
        found |= {f"{column}.mean25": value for column, value in run.mean25.items()}
        found |= {name: float(getattr(run.health, name)) for name in COUNTS}
        found |= {} if run.health.self_contact is None else {"self_contact": run.health.self_contact}
    return found
