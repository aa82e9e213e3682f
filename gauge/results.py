"""Fold the records of a finished plan into scores: of groups, terrains, metrics and environments, with intervals."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from .chance.intervals import Evidence
from .chance.level_curve import bracketing_levels, fitted_curve
from .episodes import QUALITY, Record
from .goals import command_name, count_sub_commands
from .plan import EnvironmentResult
from .result import (
    FLAT,
    ChanceRules,
    EnvironmentRow,
    Health,
    Interval,
    MetricScore,
    Run,
    RunHealth,
    Scores,
    Statistics,
    SuiteName,
    TerrainScore,
)
from .scoring import STATISTICS, Array, command_statistics, group_values, level_score, rounded, run_statistics
from .suite import Suite

ONE_SEED = "no interval: one seed"


def chance_rules(suite: Suite, seeds: Sequence[int]) -> ChanceRules:
    """Return the rules of a suite that decide about chance, with the quality seeds that were played."""
    scoring = suite.scoring
    return ChanceRules(
        level_weight=scoring.level_weight,
        quality_weight=scoring.quality_weight,
        pass_rate=scoring.pass_rate,
        levels=scoring.levels,
        seeds=tuple(seeds),
        search_seeds=suite.matrix.search_seeds,
        shared_noise=suite.noise.stream == "reference",
        resamples=scoring.bootstrap,
        level=scoring.level,
        bracket_seeds=scoring.bracket_seeds,
        decimals=scoring.decimals,
    )


def fold(
    suite: Suite, environments: Sequence[EnvironmentResult], columns: Sequence[str], *, evaluated: bool | None = None
) -> Scores:
    """Return the scores of an evaluation.

    Args:
        environments: all of them with their level, and their quality episodes where these were played.
        columns: the metrics, then ``quality``.
        evaluated: True where quality was asked for, and not the level alone; None: if any environment has quality episodes. Where
            it was and no level is passed anywhere, the score is 0 and not absent.

    Returns:
        Scores that rest on mean@50: an environment's is its quality's (``scoring.level_score``), a terrain's the mean over
        its environments, the benchmark's the mean over terrains. Intervals are those of ``intervals``: what other seeds would
        have changed, the levels included; None where one seed shows no spread.
    """
    scoring, levels = suite.scoring, (0.0, float(suite.scoring.levels))
    folded = [_environment(suite, environment, list(columns)) for environment in environments]
    rows, values = tuple(row for row, _ in folded), [statistics for _, statistics in folded]
    if evaluated is None:
        evaluated = any(e.records for e in environments)
    played = next((dict.fromkeys(r.episode.seed for r in e.records) for e in environments if e.records), None)
    rules = chance_rules(suite, suite.matrix.seeds if played is None else list(played))
    evidence = Evidence(rows, rules)

    def level_interval(level: float | None, weights: Array) -> Interval | None:
        return None if level is None else _interval(evidence.level_chance(weights).interval(level, levels))

    def interval(value: float, weights: Array, columns: Sequence[str] = (QUALITY,)) -> Interval | None:
        return _interval(evidence.chance(weights, columns).interval(value))

    terrains, scores = {}, []
    for terrain in dict.fromkeys(e.terrain for e in environments):
        group = [e for e in environments if e.terrain == terrain]
        mine = np.array([e.terrain == terrain for e in environments])
        weights, level = mine / len(group), None if terrain == FLAT else _mean_level(group)
        between = level_interval(level, weights) if any(e.searched for e in group) else None
        found = TerrainScore(level=level, level_interval=between)
        if evaluated:
            statistics = np.mean([v["score"] for v, own in zip(values, mine, strict=True) if own], axis=0)
            scores.append(statistics[2])
            score = _number(statistics[2])
            found = replace(found, score=score, interval=interval(score, weights), **_named(statistics))
        terrains[terrain] = found
    levelled = np.array([e.terrain != FLAT for e in environments], dtype=np.float64)
    level = _mean_level(environments) if levelled.any() else None
    searched = any(e.searched for e in environments)
    whole = Scores(
        suite=SuiteName(name=suite.name, version=suite.version, title=suite.title, digest=suite.digest),
        chance=rules,
        score=None,
        group_metrics={g: tuple(names) for g, names in scoring.groups.items()},
        level=level,
        level_interval=level_interval(level, levelled / levelled.sum()) if searched else None,
        terrains=terrains,
        environments=rows,
    )
    if not evaluated:
        return whole
    score, weights = _number(np.mean(scores)), environment_weights([e.terrain for e in environments])
    even, each = np.full(len(rows), 1.0 / len(rows)), np.eye(len(rows))
    weighted = {m: np.mean([v[m] for v in values], axis=0) for m in columns[:-1]}
    groups = group_values({m: float(v[2]) for m, v in weighted.items()}, scoring)
    return replace(
        whole,
        chance=replace(rules, note=None if evidence.chance(weights).known else ONE_SEED),
        score=score,
        score_interval=interval(score, weights),
        groups={g: _number(v) for g, v in groups.items()},
        metrics={m: MetricScore(**_named(v), interval=interval(float(v[2]), even, (m,))) for m, v in weighted.items()},
        environments=tuple(replace(r, interval=interval(r.score or 0.0, e)) for r, e in zip(rows, each, strict=True)),
        groups_interval={g: interval(groups[g], even, names) for g, names in scoring.groups.items()},
    )


def environment_weights(terrains: Sequence[str]) -> Array:
    """Return the weight of each environment in the score, (E,): terrains count the same, and so do the environments of one."""
    counts = Counter(terrains)
    return np.array([1.0 / (len(counts) * counts[t]) for t in terrains])


def _level(found: float | None) -> float | None:
    """Return a level as results have it: a whole number as such."""
    return None if found is None else int(found) if found == int(found) else _number(found)


def _mean_level(environments: Sequence[EnvironmentResult]) -> float:
    return float(np.mean([e.level or 0 for e in environments if e.terrain != FLAT]))


def _environment(
    suite: Suite, environment: EnvironmentResult, columns: list[str]
) -> tuple[EnvironmentRow, dict[str, Array]]:
    """Return the row of one environment, and its level-weighted statistics by column and ``score``."""
    scoring, flat, level = suite.scoring, environment.terrain == FLAT, environment.level or 0
    statistics = {n: np.zeros(3) for n in [*columns[:-1], "score"]}
    row = EnvironmentRow(
        terrain=environment.terrain,
        friction=environment.friction,
        payload=environment.payload,
        level=None if flat else _level(environment.level),
        score=0.0 if environment.level == 0 and not flat else None,
    )
    if environment.search is not None:
        trials: dict[int, dict[int, bool]] = {at: {} for at in sorted({t.episode.level for t in environment.trials})}
        for trial in sorted(environment.trials, key=lambda t: t.episode):
            trials[trial.episode.level][trial.episode.seed] = bool(trial.success)
        row = replace(row, search=dict(sorted(environment.search.items())), trials=trials)
        if scoring.level != "bisection":
            fit = fitted_curve({at: list(found.values()) for at, found in trials.items()})
            row = replace(row, curve={at: _number(share) for at, share in fit.items()})
    if not environment.records:
        return row, statistics
    weights = {0: 1.0} if flat else bracketing_levels(level)
    of_seed: dict[int, list[tuple[float, Record]]] = {}
    for record in environment.records:
        of_seed.setdefault(record.episode.seed, []).append((weights[record.episode.level], record))
    plain: dict[str, Array] = {}
    measured: dict[int, dict[str, Array]] = {seed: {} for seed in of_seed}
    for index, column in enumerate(columns):
        runs = [
            rounded(np.sum([weight * run_statistics(r, index) for weight, r in found], axis=0), scoring)
            for found in of_seed.values()
        ]
        plain[column] = rounded(np.mean(runs, axis=0), scoring)
        name = column if index < len(columns) - 1 else "score"
        # the reference rounds every run's score before it averages
        weighted = [rounded(np.asarray(level_score(v, level, scoring, flat=flat)), scoring) for v in runs]
        statistics[name] = rounded(np.mean(weighted, axis=0), scoring)
        for run, values in zip(measured.values(), runs, strict=True):
            run[column] = values
    return replace(
        row,
        quality=Statistics(**_named(plain[columns[-1]])),
        score=_number(statistics["score"][2]),
        runs={seed: _run(suite, found, measured[seed]) for seed, found in of_seed.items()},
        runs_by_level={at: _runs_at(suite, environment, at, columns) for at in weights} if len(weights) > 1 else {},
        metrics={c: Statistics(**_named(plain[c])) for c in columns[:-1]},
        self_contact=self_contact(environment.records),
        **_counts(environment.records),
    ), statistics


def _named(values: Array) -> dict[str, Any]:
    """Return the statistics of a column by name."""
    return {name: _number(value) for name, value in zip(STATISTICS, values, strict=True)}


def _runs_at(suite: Suite, environment: EnvironmentResult, level: int, columns: Sequence[str]) -> dict[int, Run]:
    """Return the runs at one of the two levels beside an expected one, as ``runs`` has them in between."""
    return {
        record.episode.seed: _run(
            suite, [(1.0, record)], {column: run_statistics(record, index) for index, column in enumerate(columns)}
        )
        for record in environment.records
        if record.episode.level == level
    }


def _run(suite: Suite, found: Sequence[tuple[float, Record]], statistics: Mapping[str, Array]) -> Run:
    """Return a run from its records, at one or two levels with their weights, and from the statistics of its columns."""
    mean, mean25, mean50 = ({c: _number(v[at]) for c, v in statistics.items()} for at in range(3))
    records = [record for _, record in found]
    return Run(
        columns=mean50,
        commands=_commands(suite, found, len(statistics) - 1),
        mean=mean,
        mean25=mean25,
        health=RunHealth(
            samples=sum(len(r.samples) for r in records), self_contact=self_contact(records), **_counts(records)
        ),
    )


def _counts(records: Collection[Record]) -> dict[str, Any]:
    """Return how often robots fell, and how many episodes diverged, overflowed and were restarted."""
    flags = {name: sum(bool(getattr(r, name)) for r in records) for name in ("diverged", "overflowed", "restarted")}
    return {"falls": sum(r.falls for r in records), **flags}


def _commands(suite: Suite, found: Sequence[tuple[float, Record]], column: int) -> dict[str, float]:
    """Return mean@50 of a column in each sub-command of a run, from its records at one or two levels and their weights."""
    values: dict[str, float] = {}
    for weight, record in found:
        played = command_statistics(record, column)
        for goal, name in enumerate(record.episode.goals):
            for part in range(count_sub_commands(suite, name)):
                command = command_name(name, part)
                value = float(played[goal, part][2]) if (goal, part) in played else 0.0
                values[command] = values.get(command, 0.0) + weight * value
    return {command: _number(value) for command, value in values.items()}


def _number(value: float | np.floating) -> float:
    return float(round(float(value), 6))


def _interval(found: tuple[float, float] | None) -> Interval | None:
    return None if found is None else (_number(found[0]), _number(found[1]))


ALL = "all"
"""Value of the column ``command`` in the row of a whole episode."""


def rows_csv(records: Sequence[Record]) -> str:
    """Return episodes as CSV text: a row for each (``command`` is ``all``), then one for each of its sub-commands that was played.

    Every metric and the quality have three columns, ``_mean``, ``_mean25`` and ``_mean50``, as measured and without the weight of
    the level: of the whole episode as its score takes them, averaged over goals; of a sub-command over its samples. They are empty
    in the rows of level tests, which take no samples. Falls of a sub-command and self-contact are empty where a record does not say.
    """
    text = io.StringIO()
    columns = next((r.columns for r in records if r.columns), ())
    names = [f"{c}_{s}" for c in columns for s in STATISTICS]
    rows: list[dict[str, Any]] = []
    for record in sorted(records, key=lambda r: r.episode.key):
        sampled = range(len(columns)) if len(record.samples) else ()
        whole = [run_statistics(record, column) for column in sampled]
        head = {"command": ALL, "samples": len(record.samples), "self_contact": self_contact([record])}
        rows.append({**record.summary(), **head, **_numbers(names, whole)})
        of_columns = [command_statistics(record, column) for column in sampled]
        for goal, part in of_columns[0] if of_columns else ():
            name = record.episode.goals[goal]
            mine = (record.goal_index == goal) & (record.part_index == part)
            row = {**asdict(record.episode), "goals": name, "command": command_name(name, part)}
            row["samples"] = int(mine.sum())
            row["self_contact"] = None if record.touching is None else _number(record.touching[mine].mean())
            if record.fallen is not None:
                row["falls"] = record.fallen.count((goal, part))
            rows.append(row | _numbers(names, [values[goal, part] for values in of_columns]))
    if rows:
        fields = list(dict.fromkeys(key for key in rows[0] if key not in names))
        writer = csv.DictWriter(text, [*fields, *names])
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def _numbers(names: Sequence[str], values: Sequence[Array]) -> dict[str, float]:
    """Return the statistics of all columns under their names; nothing where there are no values."""
    return dict(zip(names, (_number(v) for v in np.ravel(np.asarray(values))), strict=bool(values)))


def self_contact(records: Collection[Record]) -> float | None:
    """Return the share of the samples in which parts of the robot touch each other; None where there are none, or a record does not say."""
    touching = [r.touching for r in records if len(r.samples)]
    known = [t for t in touching if t is not None]
    return _number(np.concatenate(known).mean()) if known and len(known) == len(touching) else None


def health(records: Collection[Record]) -> Health:
    """Return how many quality episodes there are, fell, diverged or dropped contacts, and how often parts of the robot touched."""
    counts = {name: count for name, count in _counts(records).items() if name != "restarted"}
    return Health(episodes=len(records), self_contact=self_contact(records), **counts)
