"""Find the real differences between policies: results of one suite side by side, with chance known and many looks corrected for.

A result is enough: its rows hold every trial and run. Policies that were given the same seeds are compared seed by seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ...files.parsing import edited, one_line, shown
from ...gauge.chance.intervals import Array, Chance, Evidence
from ...gauge.episodes import QUALITY
from ...gauge.result import CONFIDENCE, Coverage, EnvironmentRow, Interval, Result, SuiteName, read_result, unlike
from ...gauge.result_figures import BY_HAND, check_figures
from ...gauge.totals import ONE_SEED, environment_weights, runs_at
from ..naming import distinct_names

KINDS = ("score", "level", "group", "terrain", "friction", "payload", "metric", "metric as measured", "command")
"""Kinds of differences, in the order in which it is shown. The first stands alone, the others are one family of tests. A metric is
``Result.metrics``, weighted by level. Metrics as measured and sub-commands are compared in the environments where both policies
were measured at the same level; all else counts levels."""
_SAME = {"backend": "engine", "robot": "robot", "pipeline": "pipeline"}
"""Fields that must be the same in all results, and their names for readers."""


class ComparisonError(ValueError):
    """Results that cannot be compared; the message says why and what to do."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One quantity of two policies."""

    kind: str
    """One of ``KINDS``."""
    name: str
    """Terrain, metric …"""
    first: str
    second: str
    """Labels of the policies."""
    values: tuple[float, float]
    difference: float
    """Of the second minus the first."""
    interval: tuple[float, float] | None
    """95 % interval of the difference by itself; None with one seed."""
    p_value: float | None
    """Chance of so large a difference if both are the same, looked at alone."""
    corrected: float | None
    """The same among all that are looked at (Holm)."""

    @property
    def real(self) -> bool:
        """True where chance is ruled out, all looks considered."""
        return self.corrected is not None and self.corrected < 1.0 - CONFIDENCE


@dataclass(frozen=True, kw_only=True)
class Compared:
    """One policy of a comparison."""

    label: str
    path: str
    file_sha256: str
    coverage: Coverage
    score: float
    score_interval: Interval | None
    """Of its runs and trials."""
    level: float | None
    seeds: tuple[int, ...]

    def plain(self) -> dict[str, Any]:
        """Return it as plain data."""
        return vars(self) | {"coverage": {"kind": self.coverage.kind, "text": self.coverage.text}}


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The outcome of a comparison of some policies."""

    suite: SuiteName
    policies: tuple[Compared, ...]
    paired: bool
    """True where all were given the same seeds."""
    differences: tuple[Difference, ...]
    """Of all pairs, in the order of ``KINDS``."""
    unlike: Sequence[str] = ()
    """Versions, source and solver's settings that are not the same in all, in words."""

    @property
    def sentences(self) -> list[str]:
        """Sentences on the scores, one for each pair, on details, on other versions, and on parts of a suite."""
        scores = [d for d in self.differences if d.kind == "score"]
        found = [_score_sentence(d, len(scores)) for d in scores] + [self._details_sentence()]
        if self.unlike:
            found.append(
                f"They were made with other versions or settings, which may be part of a difference: {'; '.join(self.unlike)}."
            )
        return found + ([] if self.complete else [self._coverage_sentence()])

    @property
    def complete(self) -> bool:
        """True where all are scores of the whole suite."""
        return all(p.coverage.complete for p in self.policies)

    def _coverage_sentence(self) -> str:
        texts = {p.label: p.coverage.words for p in self.policies}
        if len(set(texts.values())) == 1:
            return f"None of these is a score of {self.suite}; all hold the same, {next(iter(texts.values()))}."
        each = "; ".join(f"'{label}' {text}" for label, text in texts.items())
        return f"Not all of these are scores of {self.suite}: {each}."

    def _details_sentence(self) -> str:
        details = [d for d in self.differences if d.kind != "score"]
        if any(d.corrected is None for d in details):
            return "Nor can it be said of any detail."
        real = sorted((d for d in details if d.real), key=lambda d: d.corrected or 0.0)
        if not real:
            return f"None of the {len(details)} differences in detail is real after Holm's correction."
        pairs = len(self.policies) > 2
        shown = ", ".join(
            f"{_named(d)}{f' ({d.second} and {d.first})' if pairs else ''} {d.difference:+.4f}" for d in real[:4]
        )
        more = f" and {len(real) - 4} more" if len(real) > 4 else ""
        return f"Of {len(details)} differences in detail {len(real)} are real after Holm's correction: {shown}{more}."

    def plain(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "schema": 1,
            "suite": self.suite.to_data(),
            "policies": [p.plain() for p in self.policies],
            "paired": self.paired,
            "sentences": self.sentences,
            "differences": [asdict(d) | {"real": d.real} for d in self.differences],
        }


@edited("one of the results", ComparisonError)
def compare(results: Sequence[Result], labels: Sequence[str] | None = None) -> Comparison:
    """Compare all pairs of some results.

    Args:
        labels: names of the policies; None for those of their files, see ``distinct_names``.

    Raises:
        ComparisonError: results of different suites, engines, robots or environments, without scores, or the same twice.
    """
    if len(results) < 2:
        raise ComparisonError(f"a comparison needs at least two policies or results, not {len(results)}")
    labels = list(labels) if labels else distinct_names([r.policy.path for r in results])
    check_different(results, labels)
    check_alike(results, labels)
    order = {row.key: at for at, row in enumerate(results[0].environments)}
    weights = environment_weights([row.terrain for row in results[0].environments])
    evidence: list[Evidence] = []
    policies: list[Compared] = []
    for at, (label, found) in enumerate(zip(labels, results, strict=True)):
        same_order = sorted(found.environments, key=lambda row: order[row.key])
        with edited(f"the results of '{label}'", ComparisonError):
            evidence.append(Evidence(same_order, found.chance, name=str(at)))
            score = found.score or 0.0
            interval = evidence[-1].chance(weights).interval(score)
        policies.append(
            Compared(
                label=label,
                path=found.policy.path,
                file_sha256=found.policy.file_sha256,
                coverage=found.coverage,
                score=score,
                score_interval=interval and (round(interval[0], 6), round(interval[1], 6)),
                level=found.level,
                seeds=found.chance.seeds,
            )
        )
    paired = len({(r.chance.seeds, len(r.chance.search_seeds)) for r in results}) == 1
    raw: list[tuple[str, str, int, int, tuple[float, float], Chance]] = []
    for first, second in combinations(range(len(results)), 2):
        for kind, name, measure in _quantities(results[0], evidence[first], evidence[second]):
            (one, chance), (other, chance_of_other) = measure(evidence[first]), measure(evidence[second])
            values = (_reported(results[first], kind, name, one), _reported(results[second], kind, name, other))
            raw.append((kind, name, first, second, values, chance_of_other.minus(chance, paired=paired)))
    p_values = [chance.p_value(values[1] - values[0]) for *_, values, chance in raw]
    corrected: dict[int, float] = {}
    for family in (True, False):
        members = [at for at, item in enumerate(raw) if (item[0] == "score") is family and p_values[at] is not None]
        corrected |= dict(zip(members, holm([p_values[at] or 0.0 for at in members]), strict=True))
    differences = [
        Difference(
            kind=kind,
            name=name,
            first=labels[first],
            second=labels[second],
            values=(round(values[0], 6), round(values[1], 6)),
            difference=round(values[1] - values[0], 6),
            interval=chance.interval(values[1] - values[0], None),
            p_value=p_values[at],
            corrected=corrected.get(at),
        )
        for at, (kind, name, first, second, values, chance) in enumerate(raw)
    ]
    return Comparison(
        suite=results[0].suite,
        policies=tuple(policies),
        paired=paired,
        differences=tuple(sorted(differences, key=lambda d: KINDS.index(d.kind))),
        unlike=unlike([r.versions | {f"solver.{k}": v for k, v in r.solver.items()} for r in results]),
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Apply Holm's step-down correction: the chance of one false alarm or more among all, whatever they have in common."""
    order = np.argsort(p_values, kind="stable")
    found = np.zeros(len(p_values))
    highest = 0.0
    for rank, at in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[at]))
        found[at] = highest
    return found.tolist()


def load_result(path: Path, *, intervals: bool = True) -> Result:
    """Read a results folder, its ``results.json``, or a copy of that, and check that its figures follow from its trials and runs.

    Args:
        intervals: False leaves intervals unchecked, which take a second or two of a whole suite.

    Raises:
        ComparisonError: there is none, or it is damaged, edited, or too old to compare.
    """
    found = read_result(path, ComparisonError)
    file = path / "results.json" if path.is_dir() else path
    check_figures(found, f"results '{one_line(file)}'", ComparisonError, intervals=intervals)
    return found


def check_different(contestants: Sequence[object], labels: Sequence[str]) -> None:
    """Refuse the same results, or the same file, twice. Raises ComparisonError."""
    for (one, first), (other, second) in combinations(zip(labels, contestants, strict=True), 2):
        if first == second:
            raise ComparisonError(
                f"'{one}' and '{other}' are one and the same; a comparison needs different policies or results"
            )


@edited("one of the results", ComparisonError)
def check_alike(results: Sequence[Result], labels: Sequence[str]) -> None:
    """Refuse results that were not given the same episodes; of what is yet to be played, what is known of them before.

    Raises:
        ComparisonError: one sentence.
    """
    for label, found in zip(labels, results, strict=True):
        if found.score is None:
            raise ComparisonError(
                f"the results of '{label}' have levels and no scores; use the pipeline stress or multi"
            )
        found.check_replicates(f"the results of '{label}'", ComparisonError)
    first, name = results[0], labels[0]
    for label, found in zip(labels[1:], results[1:], strict=True):
        if str(found.suite) != str(first.suite):
            raise ComparisonError(
                f"results of different suites do not compare: '{name}' has {first.suite}, '{label}' has {found.suite}; "
                "evaluate both on one suite (--suite)"
            )
        if found.suite.digest != first.suite.digest:
            raise ComparisonError(
                f"'{name}' and '{label}' name the suite {first.suite}, but its rules were changed between them; "
                "evaluate both again"
            )
        for key, word in _SAME.items():
            if getattr(found, key) != getattr(first, key):
                raise ComparisonError(
                    f"results with different {word}s do not compare: '{name}' has {getattr(first, key)}, "
                    f"'{label}' has {getattr(found, key)}; evaluate both alike"
                )
        files = [first.robot_digest, found.robot_digest]
        if None not in files and files[0] != files[1]:
            raise ComparisonError(
                f"'{name}' and '{label}' name the robot {found.robot}, but its files differ "
                f"({' and '.join(str(f)[:12] for f in files)}); evaluate both on one robot (--robot)"
            )
        if rule := first.chance.unlike(found.chance, "seeds", "search_seeds"):
            raise ComparisonError(
                f"the rules of chance differ, though the suite is one: chance.{rule} is {getattr(first.chance, rule)} in '{name}' "
                f"and {getattr(found.chance, rule)} in '{label}'; {BY_HAND}"
            )
        searched = [any(row.trials for row in r.environments) for r in (first, found)]
        if searched[0] != searched[1]:
            given, other = (label, name) if searched[0] else (name, label)
            raise ComparisonError(
                f"'{given}' was given its level and that of '{other}' was searched for; evaluate both with the same --level"
            )
        levels = [list(r.coverage.levels) for r in (first, found)]
        if levels[0] != levels[1]:
            raise ComparisonError(
                f"'{name}' was given level {shown(levels[0])} and '{label}' level {shown(levels[1])}; evaluate both with "
                "the same --level"
            )
        both = [{row.key for row in r.environments} for r in (first, found)]
        lone = sorted(both[0] ^ both[1])
        if lone:
            terrain, friction, payload = lone[0]
            owner = name if lone[0] in both[0] else label
            raise ComparisonError(
                f"'{name}' and '{label}' were not given the same environments: only '{owner}' has {terrain} at friction "
                f"{friction:g} and payload {payload:g} kg; give both the same --terrain, --friction and --payload"
            )


def _reported(result: Result, kind: str, name: str, value: float) -> float:
    """Return a value as the result has it, which may be rounded by the suite's rules on its way."""
    if kind == "score":
        return result.score or 0.0
    if kind == "group":
        return result.groups[name]
    if kind == "metric":
        return result.metrics[name].mean50
    found = result.terrains[name].score if kind == "terrain" else value
    return 0.0 if found is None else found


Measure = Callable[[Evidence], tuple[float, Chance]]


def _quantities(result: Result, first: Evidence, second: Evidence) -> Iterator[tuple[str, str, Measure]]:
    """Yield everything in which two policies are compared: kind, name, and the function that gives its value and chance."""
    rows = first.rows
    terrains = [row.terrain for row in rows]
    yield "score", "score", partial(_score, environment_weights(terrains), (QUALITY,))
    levelled = np.array([t != "flat" for t in terrains], dtype=np.float64)
    if any(row.trials for row in rows):
        yield "level", "mean level", partial(_level, levelled / levelled.sum())
    even = np.full(len(rows), 1.0 / len(rows))
    for group, metrics in result.group_metrics.items():
        yield "group", group, partial(_score, even, tuple(metrics))
    names = list(dict.fromkeys(terrains))
    for terrain in names if len(names) > 1 else ():
        mine = np.array([t == terrain for t in terrains])
        yield "terrain", terrain, partial(_score, mine / mine.sum(), (QUALITY,))
    for axis, other in (("friction", "payload"), ("payload", "friction")):
        for value, weights in _sweep(rows, axis, other):
            yield axis, f"{value:g}", partial(_score, weights, (QUALITY,))
    for metric in result.metrics:
        yield "metric", metric, partial(_score, even, (metric,))
    at_same = _at_same_levels(first, second)
    alike = np.array([bool(row.runs) for row in at_same[first].rows])
    if alike.any():
        same = alike / alike.sum()
        commands = next(list(next(iter(row.runs.values())).commands) for row in rows if row.runs)
        for metric in result.metrics:
            yield "metric as measured", metric, partial(_as_measured, same, (metric,), at_same)
        for command in commands:
            yield "command", command, partial(_as_measured, same, (command,), at_same)


def _at_same_levels(first: Evidence, second: Evidence) -> dict[Evidence, Evidence]:
    """Return the runs of two evaluations at levels that both were measured at, the lowest one of each environment; no runs elsewhere."""
    found: tuple[list[EnvironmentRow], list[EnvironmentRow]] = ([], [])
    for one, other in zip(first.rows, second.rows, strict=True):
        tables = (runs_at(one), runs_at(other))
        common = sorted(tables[0].keys() & tables[1].keys())
        for rows, row, table in zip(found, (one, other), tables, strict=True):
            rows.append(replace(row, trials={}, runs=table[common[0]] if common else {}))
    return {first: first.of(found[0]), second: second.of(found[1])}


def _score(weights: Array, columns: Sequence[str], evidence: Evidence) -> tuple[float, Chance]:
    return evidence.value(weights, columns), evidence.chance(weights, columns)


def _level(weights: Array, evidence: Evidence) -> tuple[float, Chance]:
    return float(weights @ [row.reached for row in evidence.rows]), evidence.level_chance(weights)


def _as_measured(
    weights: Array, columns: Sequence[str], at_same: Mapping[Evidence, Evidence], evidence: Evidence
) -> tuple[float, Chance]:
    found = at_same[evidence]
    return float(weights @ found.runs(columns).mean(1)), found.chance_at_levels(weights, columns)


def _sweep(rows: Sequence[EnvironmentRow], axis: str, other: str) -> Iterator[tuple[float, Array]]:
    """Yield values of friction, or of payload, and weights of their environments: those where the other was played with several."""
    places = [(getattr(row, axis), getattr(row, other)) for row in rows]
    along = {o: {value for value, at in places if at == o} for _, o in places}
    for value in sorted({value for value, _ in places}):
        mine = [at for at, (own, o) in enumerate(places) if own == value and len(along[o]) > 1]
        if mine:
            weights = np.zeros(len(rows))
            weights[mine] = environment_weights([rows[at].terrain for at in mine])
            yield value, weights


def _named(found: Difference) -> str:
    return found.name if found.kind == "level" else f"{found.kind} {found.name}"


def _score_sentence(found: Difference, pairs: int) -> str:
    higher, lower = (found.second, found.first) if found.difference > 0 else (found.first, found.second)
    if found.interval is None or found.corrected is None:
        return (
            f"Whether '{higher}' or '{lower}' is better cannot be said: scores differ by {abs(found.difference):.4f}, "
            f"{ONE_SEED}; evaluate with two seeds or more."
        )
    low, high = found.interval if found.difference > 0 else (-found.interval[1], -found.interval[0])
    among = f" after correction for {pairs} comparisons" if pairs > 1 else ""
    odds = f"p {format_p(found.corrected)}{among}"
    if found.real:
        return (
            f"'{higher}' is better than '{lower}': its score is higher by {abs(found.difference):.4f} "
            f"(95 % interval {low:.4f} to {high:.4f}, {odds})."
        )
    return (
        f"The scores do not tell '{found.first}' and '{found.second}' apart: they differ by {abs(found.difference):.4f}, "
        f"and {max(abs(low), abs(high)):.4f} either way could hide in chance ({odds})."
    )


def format_p(value: float | None) -> str:
    """Return a p-value for readers."""
    if value is None:
        return "–"
    return "< 0.001" if value < 0.001 else f"= {value:.3f}"
