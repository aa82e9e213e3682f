"""Folds the records of a finished plan into ``results.json``: scores, groups, terrains, metrics, environments, with intervals."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .episodes import Record
from .pipelines import Environment
from .scoring import (
    STATISTICS,
    Array,
    Interval,
    bootstrap_environment,
    bootstrap_run,
    group_values,
    level_score,
    rounded,
    run_statistics,
)
from .suite import Suite

SCHEMA = 1


def fold(
    suite: Suite, environments: Sequence[Environment], columns: Sequence[str], *, evaluated: bool | None = None
) -> dict[str, Any]:
    """Everything of ``results.json`` but the policy and the provenance.

    Args:
        suite: the rules.
        environments: all of them with their level, and their quality episodes where these were played.
        columns: the metrics, then ``quality``.
        evaluated: whether quality was asked for, and not the level alone; None: if any environment has quality episodes. Where
            it was and no level is passed anywhere, the score is 0 and not absent.

    Returns:
        Plain data. Scores rest on mean@50: an environment's is its quality's (``scoring.level_score``), a terrain's the mean over
        its environments, the benchmark's the mean over terrains. Every interval is the 95 % bootstrap interval over seeds and
        sub-commands at the levels reached.
    """
    scoring, metrics = suite.scoring, list(columns[:-1])
    rows: list[dict[str, Any]] = []
    values: dict[str, dict[str, Array]] = {}
    draws: dict[str, dict[str, Array]] = {}
    for environment in environments:
        row, statistics, replicates = _environment(suite, environment, list(columns))
        rows.append(row)
        values[environment.key] = statistics
        draws[environment.key] = replicates
    if evaluated is None:
        evaluated = any(e.records for e in environments)
    searched = [e for e in environments if e.terrain != "flat"]
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "suite": {"name": suite.name, "version": suite.version, "title": suite.title},
        "score": None,
        "score_interval": None,
        "groups": {},
        "level": float(np.mean([e.level or 0 for e in searched])) if searched else None,
        "terrains": {},
        "metrics": {},
        "environments": rows,
    }
    per_terrain: dict[str, Array] = {}
    spread: dict[str, Array] = {}
    for terrain in dict.fromkeys(e.terrain for e in environments):
        keys = [e.key for e in environments if e.terrain == terrain]
        levels = [e.level or 0 for e in environments if e.terrain == terrain]
        item: dict[str, Any] = {"level": None if terrain == "flat" else float(np.mean(levels))}
        if evaluated:
            per_terrain[terrain] = np.mean([values[k]["score"] for k in keys], axis=0)
            spread[terrain] = np.mean([draws[k]["score"] for k in keys], axis=0)
            item = {"score": _number(per_terrain[terrain][2]), "interval": _interval(spread[terrain]), **item}
            item |= {s: _number(v) for s, v in zip(STATISTICS, per_terrain[terrain], strict=True)}
        result["terrains"][terrain] = item
    if not evaluated:
        return result
    result["score"] = _number(np.mean([v[2] for v in per_terrain.values()]))
    result["score_interval"] = _interval(np.mean(list(spread.values()), axis=0))
    weighted: dict[str, Array] = {}
    weighted_spread: dict[str, Array] = {}
    for metric in metrics:
        weighted[metric] = np.mean([values[e.key][metric] for e in environments], axis=0)
        weighted_spread[metric] = np.mean([draws[e.key][metric] for e in environments], axis=0)
        result["metrics"][metric] = {s: _number(v) for s, v in zip(STATISTICS, weighted[metric], strict=True)}
        result["metrics"][metric]["interval"] = _interval(weighted_spread[metric])
    result["groups"] = {
        g: _number(v) for g, v in group_values({m: float(v[2]) for m, v in weighted.items()}, scoring).items()
    }
    result["groups_interval"] = {
        g: _interval(np.mean([weighted_spread[m] for m in names], axis=0)) for g, names in scoring.groups.items()
    }
    return result


def _environment(
    suite: Suite, environment: Environment, columns: list[str]
) -> tuple[dict[str, Any], dict[str, Array], dict[str, Array]]:
    """Row of one environment, its level-weighted statistics and their bootstrap replicates by column and ``score``."""
    scoring, flat, level = suite.scoring, environment.terrain == "flat", environment.level or 0
    names = [*columns[:-1], "score"]
    statistics = {n: np.zeros(3) for n in names}
    replicates = {n: np.zeros(scoring.bootstrap) for n in names}
    row: dict[str, Any] = {
        "terrain": environment.terrain,
        "friction": environment.friction,
        "payload": environment.payload,
        "level": None if flat else environment.level,
        "quality": None,
        "score": None,
        "interval": None,
    }
    if environment.searched:
        row["search"] = {
            str(level): bool(test.passed)
            for level, test in sorted(environment.tests.items())
            if test.passed is not None
        }
    if environment.level == 0 and not flat:
        row["score"] = 0.0
    if not environment.records:
        return row, statistics, replicates
    plain: dict[str, Array] = {}
    draws = bootstrap_environment(
        [bootstrap_run(r, range(len(columns)), scoring.bootstrap) for r in environment.records],
        scoring.bootstrap,
        name=environment.key,
    )
    for index, column in enumerate(columns):
        runs = [rounded(run_statistics(r, index), scoring) for r in environment.records]
        mean = rounded(np.mean(runs, axis=0), scoring)
        plain[column] = mean
        name = column if index < len(columns) - 1 else "score"
        # the reference rounds every run's score before it averages
        weighted = [rounded(np.asarray(level_score(v, level, scoring, flat=flat)), scoring) for v in runs]
        statistics[name] = rounded(np.mean(weighted, axis=0), scoring)
        replicates[name] = np.asarray(level_score(draws[index], level, scoring, flat=flat))
    row["quality"] = {s: _number(v) for s, v in zip(STATISTICS, plain[columns[-1]], strict=True)}
    row["score"] = _number(statistics["score"][2])
    row["interval"] = _interval(replicates["score"])
    row["metrics"] = {c: {s: _number(v) for s, v in zip(STATISTICS, plain[c], strict=True)} for c in columns[:-1]}
    for name in ("falls",):
        row[name] = sum(getattr(r, name) for r in environment.records)
    for name in ("diverged", "overflowed", "restarted"):
        row[name] = sum(bool(getattr(r, name)) for r in environment.records)
    return row, statistics, replicates


def _number(value: float | np.floating) -> float:
    return float(round(float(value), 6))


def _interval(replicates: Array) -> list[float]:
    found = Interval.of(replicates)
    return [_number(found.low), _number(found.high)]


def rows_csv(records: Sequence[Record]) -> str:
    """One line per episode, as CSV text."""
    rows = [r.summary() for r in sorted(records, key=lambda r: r.episode.key)]
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def health(environments: Sequence[Environment]) -> Mapping[str, int]:
    """How many quality episodes fell, diverged or overflowed."""
    records = [r for e in environments for r in e.records]
    return {
        "episodes": len(records),
        "falls": sum(r.falls for r in records),
        "diverged": sum(r.diverged for r in records),
        "overflowed": sum(r.overflowed for r in records),
    }
