"""Differences between the entries of a sweep that other seeds would confirm: those of training and those of the gauge."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy import special

from ...gauge.chance.intervals import Chance, Evidence, welch
from ...gauge.result import CONFIDENCE, Result
from ...gauge.totals import environment_weights
from ...studies.compare.comparison import format_p, holm


def chance_of_seeds(results: Sequence[Result], *, name: str = "") -> Chance:
    """Return what the gauge's seeds add to the mean score of an entry's runs, which all met the same seeds: the mean of their deviations at
    each quality seed, and the level searches of the first run, since more runs on the same search seeds make the levels no surer. ``name``
    is the entry's.
    """
    order = {row.key: at for at, row in enumerate(results[0].environments)}
    weights = environment_weights([row.terrain for row in results[0].environments])
    found = []
    for result in results:
        rows = [replace(row, trials={}) for row in sorted(result.environments, key=lambda row: order[row.key])]
        found.append(Evidence(rows, result.chance).chance(weights).seeds)
    tables = tuple(np.mean(tables, axis=0) for tables in zip(*found, strict=True))
    return replace(Evidence(results[0].environments, results[0].chance, name=name).chance(weights), seeds=tables)


def across_seeds(
    scores: Mapping[str, Sequence[float]], gauge: Mapping[str, Chance] | None = None
) -> list[dict[str, Any]]:
    """Compare the entries' mean scores over their seeds of training, corrected for many looks by Holm.

    The variance of a difference is the sum of three: the spread of each entry's runs over their number, the spread of the difference over
    the gauge's quality seeds, and the chance in both level searches, with Welch and Satterthwaite's degrees of freedom. All runs met the
    same seeds of the gauge: a seed that is easy for all cancels, and one that is easy for one entry counts. Without the gauge's part a
    difference on shared seeds looks surer than it is.

    Args:
        scores: of each entry's runs. An entry with one run has the pooled spread of the others; one with the same score in all runs says
            nothing of its spread and is left out.
        gauge: ``chance_of_seeds`` of the entries; None counts the seeds of training alone.

    Returns:
        ``first``, ``second``, ``difference`` of the second's mean minus the first's, its standard ``error``, ``p_value`` and ``corrected``
        of each pair.
    """
    spread = {name: statistics.variance(own) for name, own in scores.items() if len(set(own)) > 1}
    if not spread:
        return []
    known = {name: own for name, own in scores.items() if name in spread or len(own) == 1}
    pooled_freedom = sum(len(scores[name]) - 1 for name in spread)
    pooled = sum(variance * (len(scores[name]) - 1) for name, variance in spread.items()) / pooled_freedom
    pairs: list[dict[str, Any]] = []
    for first, second in combinations(known, 2):
        parts = [(spread[n] / len(known[n]), len(known[n]) - 1.0) for n in (first, second) if n in spread]
        if alone := 2 - len(parts):
            parts.append((alone * pooled, float(pooled_freedom)))
        if gauge is not None:
            between = gauge[second].minus(gauge[first], paired=True)
            parts.append((between.error**2, between.freedom))
        variances, freedoms = np.array(parts).T
        difference, error = statistics.fmean(known[second]) - statistics.fmean(known[first]), math.sqrt(variances.sum())
        p_value = 2.0 * float(special.stdtr(welch(variances, freedoms), -abs(difference) / error))
        pair = {"first": first, "second": second, "difference": round(difference, 6), "error": error}
        pairs.append(pair | {"p_value": p_value})
    corrected = holm([pair["p_value"] for pair in pairs])
    return [pair | {"corrected": p} for pair, p in zip(pairs, corrected, strict=True)]


def sentence(pairs: Sequence[Mapping[str, Any]]) -> str:
    """Say what the seeds allow to say about the entries themselves."""
    real = sorted((p for p in pairs if p["corrected"] < 1.0 - CONFIDENCE), key=lambda p: p["corrected"])
    found = f"Over the seeds of training and of the gauge, {len(real)} of {len(pairs)} differences are real (Holm's correction)"
    shown = ", ".join(
        f"'{p['second']}' and '{p['first']}' {p['difference']:+.4f} (p {format_p(p['corrected'])})" for p in real
    )
    return f"{found}: {shown}." if real else f"{found}: with so few runs the methods cannot be told apart."
