"""Which differences between policies are real: results of one suite side by side, with chance known and many looks corrected for.

Works on ``results.json`` alone (schema 2, whose rows hold every trial and run). Policies that were given the same seeds are
compared seed by seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ...files.parsing import edited, one_line, read_results, shown
from ...gauge.chance.intervals import CONFIDENCE, Array, Chance, ChanceRules, Evidence
from ...gauge.coverage import COMPLETE, coverage_of, coverage_words
from ...gauge.episodes import QUALITY
from ...gauge.result_check import chance_rules_of, check_result, robot_digest_of, unlike, versions_of
from ...gauge.result_figures import BY_HAND
from ...gauge.results import ONE_SEED, SCHEMA, environment_weights
from ..naming import distinct_names

KINDS = ("score", "level", "group", "terrain", "friction", "payload", "metric", "command")
"""What is compared, in the order in which it is shown. The first stands alone, the others are one family of tests. Metrics and
sub-commands are compared as measured, in the environments where both policies were measured at the same level; all else counts
levels."""
_SAME = {"suite": "suite", "backend": "engine", "robot": "robot", "pipeline": "pipeline"}
"""What must be the same in all results, and its name for readers."""


class ComparisonError(ValueError):
    """Results that cannot be compared; the message says why and what to do."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One quantity of two policies."""

    kind: str
    """One of ``KINDS``."""
    name: str
    """Which terrain, metric …"""
    first: str
    second: str
    """Labels of the policies."""
    values: tuple[float, float]
    difference: float
    """Of the second minus the first."""
    interval: tuple[float, float] | None
    """95 % interval of the difference by itself; None with one seed."""
    p_value: float | None
    """How likely so large a difference is if both are the same, looked at alone."""
    corrected: float | None
    """The same among all that are looked at (Holm)."""

    @property
    def real(self) -> bool:
        """Whether chance is ruled out, all looks considered."""
        return self.corrected is not None and self.corrected < 1.0 - CONFIDENCE


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What the comparison of some policies found."""

    suite: Mapping[str, Any]
    policies: tuple[Mapping[str, Any], ...]
    """Label, path, file digest, coverage (kind and text), score, interval of its runs and trials, and level of each."""
    paired: bool
    """Whether all were given the same seeds."""
    differences: tuple[Difference, ...]
    """Of all pairs, in the order of ``KINDS``."""
    unlike: Sequence[str] = ()
    """Versions, source and solver's settings that are not the same in all, in words."""

    @property
    def sentences(self) -> list[str]:
        """What the scores say, one for each pair, what the details add, what was not alike, of what suite this is not the score."""
        scores = [d for d in self.differences if d.kind == "score"]
        found = [_score_sentence(d, len(scores)) for d in scores] + [self._details_sentence()]
        if self.unlike:
            found.append(
                f"They were made with other versions or settings, which may be part of a difference: {'; '.join(self.unlike)}."
            )
        return found + ([] if self.complete else [self._coverage_sentence()])

    @property
    def complete(self) -> bool:
        """Whether all that is compared are scores of the whole suite."""
        return all(p["coverage"]["kind"] == COMPLETE for p in self.policies)

    def _coverage_sentence(self) -> str:
        suite = f"{self.suite['name']} {self.suite['version']}"
        texts = {p["label"]: coverage_words(p["coverage"]) for p in self.policies}
        if len(set(texts.values())) == 1:
            return f"None of these is a score of {suite}; all hold the same, {next(iter(texts.values()))}."
        each = "; ".join(f"'{label}' {text}" for label, text in texts.items())
        return f"Not all of these are scores of {suite}: {each}."

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
        """As plain data."""
        return {
            "schema": 1,
            "suite": dict(self.suite),
            "policies": [dict(p) for p in self.policies],
            "paired": self.paired,
            "sentences": self.sentences,
            "differences": [asdict(d) | {"real": d.real} for d in self.differences],
        }


@edited("one of the results", ComparisonError)
def compare(results: Sequence[Mapping[str, Any]], labels: Sequence[str] | None = None) -> Comparison:
    """Compare all pairs of some results.

    Args:
        results: contents of ``results.json``, two or more.
        labels: names of the policies; None for those of their files, see ``distinct_names``.

    Raises:
        ComparisonError: results of different suites, engines, robots or environments, without scores, or the same twice.
    """
    if len(results) < 2:
        raise ComparisonError(f"a comparison needs at least two policies or results, not {len(results)}")
    labels = list(labels) if labels else distinct_names([r["policy"]["path"] for r in results])
    check_different(results, labels)
    check_alike(results, labels)
    rows = results[0]["environments"]
    order = {_key(row): at for at, row in enumerate(rows)}
    weights = environment_weights([row["terrain"] for row in rows])
    evidence: list[Evidence] = []
    intervals: list[tuple[float, float] | None] = []
    for at, (label, found) in enumerate(zip(labels, results, strict=True)):
        source = f"the results of '{label}'"
        same_order = sorted(found["environments"], key=lambda row: order[_key(row)])
        with edited(source, ComparisonError):
            evidence.append(Evidence(same_order, chance_rules_of(found, source, ComparisonError), name=str(at)))
            intervals.append(evidence[-1].chance(weights).interval(found["score"]))
    paired = len({(tuple(r["chance"]["seeds"]), len(r["chance"]["search_seeds"])) for r in results}) == 1
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
        suite=results[0]["suite"],
        policies=tuple(
            {
                "label": label,
                "path": found["policy"]["path"],
                "file_sha256": found["policy"]["file_sha256"],
                "coverage": {key: coverage_of(found)[key] for key in ("kind", "text")},
                "score": found["score"],
                "score_interval": interval and [round(end, 6) for end in interval],
                "level": found["level"],
                "seeds": list(found["chance"]["seeds"]),
            }
            for label, found, interval in zip(labels, results, intervals, strict=True)
        ),
        paired=paired,
        differences=tuple(sorted(differences, key=lambda d: KINDS.index(d.kind))),
        unlike=unlike(
            [versions_of(r) | {f"solver.{k}": v for k, v in (r.get("solver") or {}).items()} for r in results]
        ),
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: chance of one false alarm or more among all, whatever they have in common."""
    order = np.argsort(p_values, kind="stable")
    found = np.zeros(len(p_values))
    highest = 0.0
    for rank, at in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[at]))
        found[at] = highest
    return found.tolist()


def load_result(path: Path) -> dict[str, Any]:
    """Read a results folder, its ``results.json``, or a copy of that.

    Raises:
        ComparisonError: there is none, or it is damaged, or too old to compare.
    """
    try:
        file = path / "results.json" if path.is_dir() else path
        there = file.exists()
    except OSError as error:
        raise ComparisonError(f"'{one_line(path)}' cannot be read: {error.strerror}") from error
    if not there:
        raise ComparisonError(f"there are no results at '{one_line(path)}'; give a folder of 'gaitgauge evaluate'")
    found = read_results(file, "results", ComparisonError)
    if (schema := found.get("schema")) != SCHEMA or "environments" not in found:
        raise ComparisonError(
            f"'{file}' has schema {shown(schema)}, a comparison needs {SCHEMA}, which holds trials and runs; "
            "run its evaluation again with --resume"
        )
    check_result(found, f"results '{one_line(file)}'", ComparisonError)
    return found


def check_different(contestants: Sequence[object], labels: Sequence[str]) -> None:
    """Refuse the same results, or the same file, twice.

    Raises:
        ComparisonError: one sentence.
    """
    for (one, first), (other, second) in combinations(zip(labels, contestants, strict=True), 2):
        if first == second:
            raise ComparisonError(
                f"'{one}' and '{other}' are one and the same; a comparison needs different policies or results"
            )


@edited("one of the results", ComparisonError)
def check_alike(results: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> None:
    """Refuse results that were not given the same episodes; of what is yet to be played, what is known of them before.

    Raises:
        ComparisonError: one sentence.
    """
    for label, found in zip(labels, results, strict=True):
        if found["score"] is None:
            raise ComparisonError(
                f"the results of '{label}' have levels and no scores; use the pipeline stress or multi"
            )
    suites = [f"{r['suite']['name']} {r['suite']['version']}" for r in results]
    rules = [
        chance_rules_of(r, f"the results of '{label}'", ComparisonError)
        for label, r in zip(labels, results, strict=True)
    ]
    for label, suite, mine, found in zip(labels[1:], suites[1:], rules[1:], results[1:], strict=True):
        if suite != suites[0]:
            raise ComparisonError(
                f"results of different suites do not compare: '{labels[0]}' has {suites[0]}, '{label}' has {suite}; "
                "evaluate both on one suite (--suite)"
            )
        if found["suite"]["digest"] != results[0]["suite"]["digest"]:
            raise ComparisonError(
                f"'{labels[0]}' and '{label}' name the suite {suite}, but its rules were changed between them; "
                "evaluate both again"
            )
        for key, word in list(_SAME.items())[1:]:
            if found.get(key) != results[0].get(key):
                raise ComparisonError(
                    f"results with different {word}s do not compare: '{labels[0]}' has {results[0].get(key)}, "
                    f"'{label}' has {found.get(key)}; evaluate both alike"
                )
        files = [robot_digest_of(r) for r in (results[0], found)]
        if None not in files and files[0] != files[1]:
            raise ComparisonError(
                f"'{labels[0]}' and '{label}' name the robot {found['robot']}, but its files differ "
                f"({' and '.join(str(f)[:12] for f in files)}); evaluate both on one robot (--robot)"
            )
        for name in (f.name for f in fields(ChanceRules) if f.name not in ("seeds", "search_seeds")):
            first, other = getattr(rules[0], name), getattr(mine, name)
            if first != other:
                raise ComparisonError(
                    f"the rules of chance differ, though the suite is one: chance.{name} is {first} in '{labels[0]}' and {other} in "
                    f"'{label}'; {BY_HAND}"
                )
        searched = [any(row.get("trials") for row in r["environments"]) for r in (results[0], found)]
        if searched[0] != searched[1]:
            given, other = (label, labels[0]) if searched[0] else (labels[0], label)
            raise ComparisonError(
                f"'{given}' was given its level and that of '{other}' was searched for; evaluate both with the same --level"
            )
        levels = [coverage_of(r).get("levels", []) for r in (results[0], found)]
        if levels[0] != levels[1]:
            raise ComparisonError(
                f"'{labels[0]}' was given level {shown(levels[0])} and '{label}' level {shown(levels[1])}; evaluate both with "
                "the same --level"
            )
        both = [{_key(row) for row in r["environments"]} for r in (results[0], found)]
        lone = sorted(both[0] ^ both[1])
        if lone:
            terrain, friction, payload = lone[0]
            owner = labels[0] if lone[0] in both[0] else label
            raise ComparisonError(
                f"'{labels[0]}' and '{label}' were not given the same environments: only '{owner}' has {terrain} at friction "
                f"{friction:g} and payload {payload:g} kg; give both the same --terrain, --friction and --payload"
            )


def _reported(results: Mapping[str, Any], kind: str, name: str, value: float) -> float:
    """A value as the results have it, which may be rounded by the suite's rules on its way."""
    if kind == "score":
        return float(results["score"])
    if kind == "group":
        return float(results["groups"][name])
    return float(results["terrains"][name]["score"]) if kind == "terrain" else value


Measure = Callable[[Evidence], tuple[float, Chance]]


def _quantities(results: Mapping[str, Any], first: Evidence, second: Evidence) -> Iterator[tuple[str, str, Measure]]:
    """Everything in which two policies are compared: kind, name, and what gives its value and chance."""
    rows = first.rows
    terrains = [row["terrain"] for row in rows]
    yield "score", "score", partial(_score, environment_weights(terrains), (QUALITY,))
    levelled = np.array([t != "flat" for t in terrains], dtype=np.float64)
    if any(row.get("trials") for row in rows):
        yield "level", "mean level", partial(_level, levelled / levelled.sum())
    even = np.full(len(rows), 1.0 / len(rows))
    for group, metrics in results["group_metrics"].items():
        yield "group", group, partial(_score, even, tuple(metrics))
    names = list(dict.fromkeys(terrains))
    for terrain in names if len(names) > 1 else ():
        mine = np.array([t == terrain for t in terrains])
        yield "terrain", terrain, partial(_score, mine / mine.sum(), (QUALITY,))
    for axis, other in (("friction", "payload"), ("payload", "friction")):
        for value, weights in _sweep(rows, axis, other):
            yield axis, f"{value:g}", partial(_score, weights, (QUALITY,))
    at_same = _at_same_levels(first, second)
    alike = np.array([bool(row.get("runs")) for row in at_same[first].rows])
    if alike.any():
        same = alike / alike.sum()
        commands = next(list(next(iter(row["runs"].values()))["commands"]) for row in rows if row.get("runs"))
        for metric in results["metrics"]:
            yield "metric", metric, partial(_as_measured, same, (metric,), at_same)
        for command in commands:
            yield "command", command, partial(_as_measured, same, (command,), at_same)


def _at_same_levels(first: Evidence, second: Evidence) -> dict[Evidence, Evidence]:
    """The runs of two evaluations at levels that both were measured at, the lowest one of each environment; no runs elsewhere."""
    found: tuple[list[dict[str, Any]], list[dict[str, Any]]] = ([], [])
    for one, other in zip(first.rows, second.rows, strict=True):
        tables = (_runs_by_level(one), _runs_by_level(other))
        common = sorted(tables[0].keys() & tables[1].keys(), key=int)
        for rows, row, table in zip(found, (one, other), tables, strict=True):
            rows.append({**row, "trials": {}, "runs": table[common[0]] if common else {}})
    return {first: first.of(found[0]), second: second.of(found[1])}


def _runs_by_level(row: Mapping[str, Any]) -> Mapping[str, Mapping[str, Any]]:
    """Runs of an environment by the level at which they were played, 0 on flat ground."""
    if not row.get("runs"):
        return {}
    return row.get("runs_by_level") or {str(math.ceil(row["level"] or 0)): row["runs"]}


def _score(weights: Array, columns: Sequence[str], evidence: Evidence) -> tuple[float, Chance]:
    return evidence.value(weights, columns), evidence.chance(weights, columns)


def _level(weights: Array, evidence: Evidence) -> tuple[float, Chance]:
    return float(weights @ [row["level"] or 0 for row in evidence.rows]), evidence.level_chance(weights)


def _as_measured(
    weights: Array, columns: Sequence[str], at_same: Mapping[Evidence, Evidence], evidence: Evidence
) -> tuple[float, Chance]:
    found = at_same[evidence]
    return float(weights @ found.runs(columns).mean(1)), found.chance_at_levels(weights, columns)


def _sweep(rows: Sequence[Mapping[str, Any]], axis: str, other: str) -> Iterator[tuple[float, Array]]:
    """Values of friction, or of payload, and weights of their environments: those where the other was played with several."""
    along = {o: {r[axis] for r in rows if r[other] == o} for o in {r[other] for r in rows}}
    for value in sorted({r[axis] for r in rows}):
        mine = [at for at, r in enumerate(rows) if r[axis] == value and len(along[r[other]]) > 1]
        if mine:
            weights = np.zeros(len(rows))
            weights[mine] = environment_weights([rows[at]["terrain"] for at in mine])
            yield value, weights


def _key(row: Mapping[str, Any]) -> tuple[str, float, float]:
    return row["terrain"], row["friction"], row["payload"]


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
    """A p-value for readers."""
    if value is None:
        return "–"
    return "< 0.001" if value < 0.001 else f"= {value:.3f}"
