"""Fold the records of a finished plan into scores: records become rows with trials and runs, rows become figures (``totals``)."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from .chance.level_curve import bracketing_levels
from .episodes import Record
from .goals import command_name, count_sub_commands
from .plan import EnvironmentResult
from .result import FLAT, ChanceRules, EnvironmentRow, Health, Run, RunHealth, Scores, SuiteName
from .scoring import STATISTICS, Array, command_statistics, rounded, run_statistics
from .suite import Suite
from .totals import number, totals, whole_row


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
    """Return the scores of an evaluation: records become rows with runs and trials, and all else follows from these (``totals``).

    Args:
        environments: all of them with their level, and their quality episodes where these were played.
        columns: the metrics, then ``quality``.
        evaluated: True where quality was asked for, and not the level alone; None: if any environment has quality episodes.
    """
    if evaluated is None:
        evaluated = any(e.records for e in environments)
    played = next((dict.fromkeys(r.episode.seed for r in e.records) for e in environments if e.records), None)
    rules = chance_rules(suite, suite.matrix.seeds if played is None else list(played))
    return totals(
        [whole_row(_row(suite, environment, columns), rules) for environment in environments],
        rules,
        suite=SuiteName(name=suite.name, version=suite.version, title=suite.title, digest=suite.digest),
        groups=suite.scoring.groups,
        metrics=columns[:-1],
        evaluated=evaluated,
    )


def _row(suite: Suite, environment: EnvironmentResult, columns: Sequence[str]) -> EnvironmentRow:
    """Return one environment with its level, trials and runs."""
    flat, level = environment.terrain == FLAT, environment.level or 0
    row = EnvironmentRow(
        terrain=environment.terrain,
        friction=environment.friction,
        payload=environment.payload,
        level=None if flat else _level(level),
    )
    if environment.search is not None:
        trials: dict[int, dict[int, bool]] = {at: {} for at in sorted({t.episode.level for t in environment.trials})}
        for trial in sorted(environment.trials, key=lambda t: t.episode):
            trials[trial.episode.level][trial.episode.seed] = bool(trial.success)
        row = replace(row, search=dict(sorted(environment.search.items())), trials=trials)
    played = [0] if flat else list(bracketing_levels(level))
    tables = {at: _runs(suite, environment, at, columns) for at in played if environment.records}
    if len(tables) > 1:
        return replace(row, runs_by_level=tables)
    return replace(row, runs=next(iter(tables.values()), {}))


def _level(found: float) -> float:
    """Return a level as results have it: a whole number as such."""
    return int(found) if found == int(found) else number(found)


def _runs(suite: Suite, environment: EnvironmentResult, level: int, columns: Sequence[str]) -> dict[int, Run]:
    """Return the runs at a level, by seed, from their records."""
    runs = {}
    for record in environment.records:
        if record.episode.level != level:
            continue
        values = [rounded(run_statistics(record, index), suite.scoring) for index in range(len(columns))]
        mean, mean25, mean50 = (
            {c: number(v[at]) for c, v in zip(columns, values, strict=True)} for at in range(len(STATISTICS))
        )
        runs[record.episode.seed] = Run(
            columns=mean50,
            commands=_commands(suite, record, len(columns) - 1),
            mean=mean,
            mean25=mean25,
            health=RunHealth(samples=len(record.samples), self_contact=self_contact([record]), **_counts([record])),
        )
    return runs


def _counts(records: Collection[Record]) -> dict[str, Any]:
    """Return how often robots fell, and how many episodes diverged, overflowed and were restarted."""
    flags = {name: sum(bool(getattr(r, name)) for r in records) for name in ("diverged", "overflowed", "restarted")}
    return {"falls": sum(r.falls for r in records), **flags}


def _commands(suite: Suite, record: Record, column: int) -> dict[str, float]:
    """Return mean@50 of a column in each sub-command of a record; 0 in those that were not played."""
    values, played = {}, command_statistics(record, column)
    for goal, name in enumerate(record.episode.goals):
        for part in range(count_sub_commands(suite, name)):
            values[command_name(name, part)] = number(played[goal, part][2]) if (goal, part) in played else 0.0
    return values


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
            row["self_contact"] = None if record.touching is None else number(record.touching[mine].mean())
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
    return dict(zip(names, (number(v) for v in np.ravel(np.asarray(values))), strict=bool(values)))


def self_contact(records: Collection[Record]) -> float | None:
    """Return the share of the samples in which parts of the robot touch each other; None where there are none, or a record does not say."""
    touching = [r.touching for r in records if len(r.samples)]
    known = [t for t in touching if t is not None]
    return number(np.concatenate(known).mean()) if known and len(known) == len(touching) else None


def health(records: Collection[Record]) -> Health:
    """Return how many quality episodes there are, fell, diverged or dropped contacts, and how often parts of the robot touched."""
    counts = {name: count for name, count in _counts(records).items() if name != "restarted"}
    return Health(episodes=len(records), self_contact=self_contact(records), **counts)
