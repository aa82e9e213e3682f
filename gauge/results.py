"""Folds the records of a finished plan into ``results.json``: scores, groups, terrains, metrics, environments, with intervals."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from .chance.intervals import CONFIDENCE, ChanceRules, Evidence
from .chance.level_curve import bracketing_levels, fitted_curve
from .episodes import Record
from .goals import command_name, count_sub_commands
from .plan import EnvironmentResult
from .scoring import STATISTICS, Array, command_statistics, group_values, level_score, rounded, run_statistics
from .suite import Suite

SCHEMA = 2
ONE_SEED = "no interval: one seed"


def chance_rules(suite: Suite, seeds: Sequence[int]) -> ChanceRules:
    """What a suite says about chance, with the quality seeds that were played."""
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
    )


def fold(
    suite: Suite, environments: Sequence[EnvironmentResult], columns: Sequence[str], *, evaluated: bool | None = None
) -> dict[str, Any]:
    """Everything of ``results.json`` but the policy and the provenance.

    Args:
        environments: all of them with their level, and their quality episodes where these were played.
        columns: the metrics, then ``quality``.
        evaluated: whether quality was asked for, and not the level alone; None: if any environment has quality episodes. Where
            it was and no level is passed anywhere, the score is 0 and not absent.

    Returns:
        Plain data. Scores rest on mean@50: an environment's is its quality's (``scoring.level_score``), a terrain's the mean over
        its environments, the benchmark's the mean over terrains. Intervals are those of ``intervals``: what other seeds would
        have changed, the levels included; null where one seed shows no spread.
    """
    scoring, metrics = suite.scoring, list(columns[:-1])
    rows: list[dict[str, Any]] = []
    values: dict[str, dict[str, Array]] = {}
    for environment in environments:
        row, statistics = _environment(suite, environment, list(columns))
        rows.append(row)
        values[environment.key] = statistics
    if evaluated is None:
        evaluated = any(e.records for e in environments)
    played = next((dict.fromkeys(r.episode.seed for r in e.records) for e in environments if e.records), None)
    seeds = list(suite.matrix.seeds if played is None else played)
    rules = chance_rules(suite, seeds)
    evidence = Evidence(rows, rules)
    weights = environment_weights([e.terrain for e in environments])
    levelled = np.array([e.terrain != "flat" for e in environments], dtype=np.float64)
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "suite": {"name": suite.name, "version": suite.version, "title": suite.title, "digest": suite.digest},
        "chance": {"confidence": CONFIDENCE, **asdict(rules), "note": None},
        "score": None,
        "score_interval": None,
        "groups": {},
        "group_metrics": {g: list(names) for g, names in scoring.groups.items()},
        "level": _mean_level(environments) if levelled.any() else None,
        "level_interval": None,
        "terrains": {},
        "metrics": {},
        "environments": rows,
    }
    if any(e.searched for e in environments):
        chance = evidence.level_chance(levelled / levelled.sum())
        result["level_interval"] = _interval(chance.interval(result["level"], (0.0, scoring.levels)))
    per_terrain: dict[str, Array] = {}
    for terrain in dict.fromkeys(e.terrain for e in environments):
        group = [e for e in environments if e.terrain == terrain]
        mine = np.array([e.terrain == terrain for e in environments]) / len(group)
        item: dict[str, Any] = {"level": None, "level_interval": None}
        if terrain != "flat":
            item["level"] = _mean_level(group)
        if any(e.searched for e in group):
            chance = evidence.level_chance(mine)
            item["level_interval"] = _interval(chance.interval(item["level"], (0.0, scoring.levels)))
        if evaluated:
            per_terrain[terrain] = np.mean([values[e.key]["score"] for e in group], axis=0)
            score = _number(per_terrain[terrain][2])
            item = {"score": score, "interval": _interval(evidence.chance(mine).interval(score)), **item}
            item |= {s: _number(v) for s, v in zip(STATISTICS, per_terrain[terrain], strict=True)}
        result["terrains"][terrain] = item
    if not evaluated:
        return result
    for at, row in enumerate(rows):
        alone = np.eye(len(rows))[at]
        row["interval"] = _interval(evidence.chance(alone).interval(row["score"]))
    result["score"] = _number(np.mean([v[2] for v in per_terrain.values()]))
    overall = evidence.chance(weights)
    result["score_interval"] = _interval(overall.interval(result["score"]))
    result["chance"]["note"] = None if overall.known else ONE_SEED
    weighted: dict[str, Array] = {}
    even = np.full(len(rows), 1.0 / len(rows))
    for metric in metrics:
        weighted[metric] = np.mean([values[e.key][metric] for e in environments], axis=0)
        chance = evidence.chance(even, (metric,))
        result["metrics"][metric] = {s: _number(v) for s, v in zip(STATISTICS, weighted[metric], strict=True)}
        result["metrics"][metric]["interval"] = _interval(chance.interval(float(weighted[metric][2])))
    groups = group_values({m: float(v[2]) for m, v in weighted.items()}, scoring)
    result["groups"] = {g: _number(v) for g, v in groups.items()}
    result["groups_interval"] = {
        g: _interval(evidence.chance(even, names).interval(groups[g])) for g, names in scoring.groups.items()
    }
    return result


def environment_weights(terrains: Sequence[str]) -> Array:
    """Weight of each environment in the benchmark's score: terrains count the same, and so do the environments of one, (E,)."""
    counts = Counter(terrains)
    return np.array([1.0 / (len(counts) * counts[t]) for t in terrains])


def _level(found: float | None) -> float | None:
    """A level as results have it: a whole number as such."""
    return None if found is None else int(found) if found == int(found) else _number(found)


def _mean_level(environments: Sequence[EnvironmentResult]) -> float:
    return float(np.mean([e.level or 0 for e in environments if e.terrain != "flat"]))


def _environment(
    suite: Suite, environment: EnvironmentResult, columns: list[str]
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Row of one environment, and its level-weighted statistics by column and ``score``."""
    scoring, flat, level = suite.scoring, environment.terrain == "flat", environment.level or 0
    statistics = {n: np.zeros(3) for n in [*columns[:-1], "score"]}
    row: dict[str, Any] = {
        "terrain": environment.terrain,
        "friction": environment.friction,
        "payload": environment.payload,
        "level": None if flat else _level(environment.level),
        "quality": None,
        "score": None,
        "interval": None,
    }
    if environment.search is not None:
        row["search"] = {str(level): passed for level, passed in sorted(environment.search.items())}
        row["trials"] = {str(level): {} for level in sorted({t.episode.level for t in environment.trials})}
        for trial in sorted(environment.trials, key=lambda t: t.episode):
            row["trials"][str(trial.episode.level)][str(trial.episode.seed)] = bool(trial.success)
        if scoring.level == "curve":
            fit = fitted_curve({int(at): list(found.values()) for at, found in row["trials"].items()})
            row["curve"] = {str(at): _number(share) for at, share in fit.items()}
    if environment.level == 0 and not flat:
        row["score"] = 0.0
    if not environment.records:
        return row, statistics
    weights = {0: 1.0} if flat else bracketing_levels(level)
    of_seed: dict[int, list[tuple[float, Record]]] = {}
    for record in environment.records:
        of_seed.setdefault(record.episode.seed, []).append((weights[record.episode.level], record))
    plain: dict[str, Array] = {}
    row["runs"] = {str(seed): {} for seed in of_seed}
    for index, column in enumerate(columns):
        runs = [
            rounded(np.sum([weight * run_statistics(r, index) for weight, r in found], axis=0), scoring)
            for found in of_seed.values()
        ]
        mean = rounded(np.mean(runs, axis=0), scoring)
        plain[column] = mean
        name = column if index < len(columns) - 1 else "score"
        # the reference rounds every run's score before it averages
        weighted = [rounded(np.asarray(level_score(v, level, scoring, flat=flat)), scoring) for v in runs]
        statistics[name] = rounded(np.mean(weighted, axis=0), scoring)
        for run, values in zip(row["runs"].values(), runs, strict=True):
            run[column] = _number(values[2])
    for seed, found in of_seed.items():
        row["runs"][str(seed)]["commands"] = _commands(suite, found, len(columns) - 1)
    if len(weights) > 1:
        row["runs_by_level"] = {str(at): _runs_at(suite, environment, at, columns) for at in weights}
    row["quality"] = {s: _number(v) for s, v in zip(STATISTICS, plain[columns[-1]], strict=True)}
    row["score"] = _number(statistics["score"][2])
    row["metrics"] = {c: {s: _number(v) for s, v in zip(STATISTICS, plain[c], strict=True)} for c in columns[:-1]}
    row["falls"] = sum(r.falls for r in environment.records)
    for name in ("diverged", "overflowed", "restarted"):
        row[name] = sum(bool(getattr(r, name)) for r in environment.records)
    row["self_contact"] = self_contact(environment.records)
    return row, statistics


def _runs_at(suite: Suite, environment: EnvironmentResult, level: int, columns: Sequence[str]) -> dict[str, Any]:
    """The runs at one of the two levels beside an expected one, as ``runs`` has them in between."""
    runs: dict[str, Any] = {}
    for record in environment.records:
        if record.episode.level == level:
            run = {column: _number(run_statistics(record, index)[2]) for index, column in enumerate(columns)}
            runs[str(record.episode.seed)] = run | {"commands": _commands(suite, [(1.0, record)], len(columns) - 1)}
    return runs


def _commands(suite: Suite, found: Sequence[tuple[float, Record]], column: int) -> dict[str, float]:
    """Mean@50 of a column in each sub-command of a run, from its records at one or two levels and their weights."""
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


def _interval(found: tuple[float, float] | None) -> list[float] | None:
    return None if found is None else [_number(found[0]), _number(found[1])]


ALL = "all"
"""Value of the column ``command`` in the row of a whole episode."""


def rows_csv(records: Sequence[Record]) -> str:
    """Episodes as CSV text: a row for each (``command`` is ``all``), then one for each of its sub-commands that was played.

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
            row = asdict(record.episode) | {
                "goals": name,
                "command": command_name(name, part),
                "samples": int(mine.sum()),
            }
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
    """The statistics of all columns under their names; nothing where there are no values."""
    return dict(zip(names, (_number(v) for v in np.ravel(np.asarray(values))), strict=bool(values)))


def self_contact(records: Collection[Record]) -> float | None:
    """Share of the samples in which parts of the robot touch each other; None where there are none, or a record does not say."""
    touching = [r.touching for r in records if len(r.samples)]
    known = [t for t in touching if t is not None]
    return _number(np.concatenate(known).mean()) if known and len(known) == len(touching) else None


def health(records: Collection[Record]) -> dict[str, float | None]:
    """How many episodes there are, how many of them fell, diverged or dropped contacts, and how often parts of the robot touched."""
    return {
        "episodes": len(records),
        "falls": sum(r.falls for r in records),
        "diverged": sum(r.diverged for r in records),
        "overflowed": sum(r.overflowed for r in records),
        "self_contact": self_contact(records),
    }
