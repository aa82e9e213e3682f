"""Check the figures of a ``results.json``: all of them are computed again from its trials and runs, as ``evaluate`` computed them.

Whoever edits one has to play the episodes that give it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..files.parsing import edited, one_line, shown
from ..policy.contract import EXTEROCEPTIVE_TERMS, PRIVILEGED_TERMS
from .episodes import QUALITY, Record
from .pipelines import PIPELINES, Environment
from .plan import PlanRules, episode_of, plan
from .result import BY_HAND, CONFIDENCE, ChanceRules, EnvironmentRow, Result, Run, RunHealth, Statistics, Table
from .suite import Suite, load_suite
from .totals import COUNTS, health_of, totals, whole_row

_ROUNDING = 2e-6
"""Of figures that are written with six decimals."""
_INTERVAL_ROUNDING = 1e-4
"""Of an interval, whose replicates another version of NumPy may draw otherwise."""
_INTERVAL = "interval"
"""Word in the names of intervals."""
_TABLES = ("terrains", "metrics", "groups", "groups_interval", "health")
_UNKNOWN = {"environments": {"self_contact", "runs", "runs_by_level", "curve"}, "health": {"episodes", "self_contact"}}
"""Figures of tables of schema 2 that follow from nothing in it."""

Figure = tuple[str, Any, Any]
"""The path of a figure, what is written there, and what it must be."""


def check_figures(result: Result, source: str, error: type[Exception], *, intervals: bool = True) -> None:
    """Check that all figures are those of the trials and runs; raise ``error``, one sentence, on the first that is not.

    Args:
        source: the file, the beginning of the sentence.
        intervals: False leaves intervals unchecked, which take a second or two of a whole suite.
    """
    with edited(source, error):
        if result.proved:
            _check_statements(result, source, error)
        _check_rows(result.environments, result.chance, result.proved, source, error)
        _check_levels(result.environments, result.chance, source, error)
        if not result.environments:
            return
        rounding = _ROUNDING if result.proved else max(_ROUNDING, 1.5 * 10.0 ** -(_places(result.environments) or 6))
        for name, stated, expected in _figures(result, intervals=intervals):
            allowed = _INTERVAL_ROUNDING if _INTERVAL in name else _ROUNDING if name == "score" else rounding
            if _INTERVAL in name and not intervals:
                continue
            numbers = all(isinstance(value, float | int | tuple) for value in (stated, expected))
            if stated != expected and not (numbers and np.allclose(stated, expected, rtol=0, atol=allowed)):
                raise error(
                    f"{source}: {one_line(name)} is {_said(stated)}, but what it is made of gives {_said(expected)}; {BY_HAND}"
                )


def _figures(result: Result, *, intervals: bool) -> Iterator[Figure]:
    """Yield all figures of a result, those of its rows first."""
    rows, rules, made = result.environments, result.chance, list(result.environments)
    if not result.proved:
        rules, made = replace(rules, decimals=_places(rows)), [_with_stated_figures(row) for row in rows]
    measured = next((run.columns for row in rows for run in row.runs.values()), result.metrics)
    columns = [column for column in measured if column != QUALITY]
    scores = totals(
        [whole_row(row, rules) for row in made],
        rules,
        suite=result.suite,
        groups=result.group_metrics,
        metrics=columns,
        evaluated=result.pipeline != "level" if result.proved else result.score is not None,
        intervals=intervals,
    )
    expected = {**vars(scores), "health": health_of(scores.environments)}
    for at, pair in enumerate(zip(rows, scores.environments, strict=True)):
        yield from _pairs(*pair, f"environments[{at}]", result.proved)
    for name in ("score", "score_interval", "level", "level_interval", *_TABLES):
        if name not in result.lacking:
            yield from _pairs(getattr(result, name), expected[name], name, result.proved)
    if result.proved and intervals:  # the note says why there are no intervals
        yield "chance.note", result.chance.note, scores.chance.note


def _pairs(stated: Any, expected: Any, name: str, proved: bool) -> Iterator[Figure]:
    """Yield the figures of two tables of one kind, side by side; schema 2 may lack some, and says some of which it holds nothing."""
    if isinstance(expected, Table) and isinstance(stated, Table):
        unknown = set() if proved else _UNKNOWN.get(name.partition("[")[0], set())
        for key in {**expected.entries(), **stated.entries()}:
            if key not in stated.lacking | unknown:
                yield from _pairs(getattr(stated, key), getattr(expected, key), f"{name}.{key}", proved)
    elif isinstance(expected, Mapping) and isinstance(stated, Mapping):
        for key in {*stated, *expected} if proved else stated:
            yield from _pairs(stated.get(key), expected.get(key), f"{name}.{key}", proved)
    else:
        yield name, stated, expected


def _said(value: Any) -> str:
    """Return a figure for a sentence."""
    if isinstance(value, tuple):
        return shown([round(float(end), 6) for end in value])
    if isinstance(value, Table | Mapping):
        return "there"
    return "nothing" if value is None else shown(round(value, 6) if isinstance(value, float) else value)


def _check_statements(result: Result, source: str, error: type[Exception]) -> None:
    """Check what every evaluation states beside figures; raise ``error`` on the first that is left out or contradicts another."""
    policy, motors, digests = result.policy, result.motors, result.provenance.digests
    terms = {*(policy.observations or ())}
    own = {"privileged": PRIVILEGED_TERMS, "exteroceptive": EXTEROCEPTIVE_TERMS}
    least = next((kind for kind, names in own.items() if terms & {*names}), "measurable")
    rules = {
        "policy.observations is empty": bool(policy.observations),
        f"policy.kind_of_observations is {shown(policy.kind_of_observations)}, but its observations are {least}": (
            least == "measurable" or policy.kind_of_observations in (least, "privileged")
        ),
        "policy.contract_hash is no SHA-256": bool(re.fullmatch("[0-9a-f]{64}", policy.contract_hash)),
        "policy.file_sha256 is no SHA-256": bool(re.fullmatch("[0-9a-f]{64}", policy.file_sha256)),
        f"motors has {len(motors.stiffness)} values of stiffness and {len(motors.damping)} of damping": (
            len(motors.stiffness) == len(motors.damping) > 0
        ),
        "training is empty and has no note": bool(result.training.trained or result.training.note),
        "commands.limits is empty": result.commands.limits is not None,
        "feet.dimension is empty": bool(result.feet.dimension),
        "solver is empty": bool(result.solver),
        "provenance.digests lacks policy, robot, suite or source": digests.keys()
        >= {"policy", "robot", "suite", "source"},
        "provenance.digests.suite is not suite.digest": digests.get("suite") == result.suite.digest,
        "provenance.versions lacks gaitgauge": "gaitgauge" in result.provenance.versions,
        f"pipeline is {shown(result.pipeline)}; it must be one of {', '.join(PIPELINES)}": result.pipeline in PIPELINES,
        "chance.confidence is not 0.95": result.chance.confidence == CONFIDENCE,
    }
    for sentence, kept in rules.items():
        if not kept:
            raise error(f"{source}: {sentence}; {BY_HAND}")


# ---- rows -----------------------------------------------------------------------------------------------------------


def _check_rows(
    rows: Sequence[EnvironmentRow], rules: ChanceRules, proved: bool, source: str, error: type[Exception]
) -> None:
    """Check that each environment is there once, with whole runs of every seed; raise ``error`` where it is not."""
    if twice := next((key for key, count in Counter(row.key for row in rows).items() if count > 1), None):
        terrain, friction, payload = twice
        raise error(
            f"{source}: {one_line(terrain, 80)} at friction {friction:g} and payload {payload:g} kg is there twice; {BY_HAND}"
        )
    first = next((run for row in rows for run in row.runs.values()), None)
    for at, row in enumerate(rows):
        place = f"environments[{at}]"
        tables = {f"{place}.runs": row.runs}
        tables |= {f"{place}.runs_by_level.{level}": runs for level, runs in row.runs_by_level.items()}
        for name, runs in tables.items():
            if runs and {*runs} != {*rules.seeds}:
                found, expected = (shown(", ".join(map(str, seeds))) for seeds in (runs, rules.seeds))
                raise error(f"{source}: {name} has the seeds {found}, but chance.seeds has {expected}; {BY_HAND}")
            for seed, run in runs.items():
                if first is not None and (wrong := _wrong_in(run, first, proved)):
                    raise error(f"{source}: {name}.{seed} {wrong}; {BY_HAND}")


def _wrong_in(run: Run, first: Run, proved: bool) -> str | None:
    """Return what no evaluation writes into a run, None where there is nothing; ``first`` is a run of the same result."""
    if {*run.columns} != {*first.columns} or {*run.commands} != {*first.commands}:
        return "has other columns or commands than the first run"
    if not proved:
        return None
    if run.health is None or {*run.mean} != {*run.columns} or {*run.mean25} != {*run.columns}:
        return "lacks mean, mean25 or health"
    for column, value in run.columns.items():
        if not run.mean25[column] - _ROUNDING <= value <= run.mean[column] + _ROUNDING:
            return f"has mean25, mean50 and mean of {column} that do not rise"
    if run.health.falls == 0 and run.health.diverged:
        return "diverged and did not fall, but a divergence counts as a fall"
    return None


def _check_levels(rows: Sequence[EnvironmentRow], rules: ChanceRules, source: str, error: type[Exception]) -> None:
    """Check that levels and outcomes are those that the trials lead to, by the plan of an evaluation; raise ``error`` where not."""
    suite = _suite_of(rules)
    for at, row in enumerate(rows):
        place, given = f"{source}: environments[{at}]", row.search is None
        if row.flat and (row.level is not None or not given or row.trials):
            raise error(f"{place} is flat ground and has a level or a search; {BY_HAND}")
        if row.flat:
            continue
        if row.level is None or row.level > rules.levels or (given and (row.trials or row.level % 1 or row.level < 1)):
            raise error(f"{place} has level {shown(row.level)}, which no search or choice gives; {BY_HAND}")
        if given:
            continue
        environment = Environment(terrain=row.terrain, friction=row.friction, payload=row.payload, level=None)
        records = {
            episode: Record(episode=episode, success=success)
            for level, outcomes in row.trials.items()
            for seed, success in outcomes.items()
            for episode in [episode_of(environment, level, seed, "search", suite)]
        }
        found = plan(environment, records, PlanRules(suite=suite, seeds=rules.seeds, quality=False))
        if found.level is None:
            needed = found.required[0]
            raise error(
                f"{place}.trials lacks levels or seeds that its search has: level {needed.level}, seed {needed.seed}; {BY_HAND}"
            )
        if more := records.keys() - {*found.counted}:
            one = min(more)
            raise error(
                f"{place}.trials has level {one.level}, seed {one.seed}, which its search never asks for; {BY_HAND}"
            )
        if abs(found.level - row.level) > _ROUNDING:
            raise error(
                f"{place}.level is {shown(row.level)}, but its trials give {round(found.level, 6):g}; {BY_HAND}"
            )
        if dict(found.passed) != dict(row.search or {}):
            raise error(f"{place}.search has other outcomes than its trials give; {BY_HAND}")


def _suite_of(rules: ChanceRules) -> Suite:
    """Return a suite that searches for levels by these rules; nothing else of it counts."""
    suite = load_suite("demo")
    names = {"pass_rate", "levels", "level", "bracket_seeds"}
    return replace(
        suite,
        goals=(),
        matrix=replace(suite.matrix, search_seeds=rules.search_seeds),
        scoring=replace(suite.scoring, **{name: getattr(rules, name) for name in names}),
    )


# ---- schema 2 -------------------------------------------------------------------------------------------------------


def _with_stated_figures(row: EnvironmentRow) -> EnvironmentRow:
    """Return a row of schema 2 with runs that have the mean, the mean@25 and the counts that the row states."""
    stated: dict[str, Statistics | None] = {QUALITY: row.quality, **row.metrics}
    mean, mean25 = (
        {column: getattr(found, name) for column, found in stated.items() if found is not None}
        for name in ("mean", "mean25")
    )
    counts: dict[str, Any]
    runs, counts = {}, {name: getattr(row, name) or 0 for name in COUNTS}
    for seed, run in row.runs.items():
        health = RunHealth(samples=0, self_contact=None, **counts)
        runs[seed] = replace(run, mean=mean, mean25=mean25, health=health)
        counts = dict.fromkeys(counts, 0)
    return replace(row, runs=runs, runs_by_level={})


def _places(rows: Sequence[EnvironmentRow]) -> int | None:
    """Return the decimals to which the suite rounds, which schema 2 does not state: those of all runs; None for six or more."""
    values = np.array([value for row in rows for run in row.runs.values() for value in run.columns.values()])
    return next((places for places in range(2, 6) if np.all(np.round(values, places) == values)), None)
