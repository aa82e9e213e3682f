"""A search from request to ``worst.json``: a random sample, the search, what each failure needs, and every failure again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...backends.registry import engine_class
from ...files.choices import cpu_threads
from ...files.provenance import provenance
from ...files.writing import json_text, make_folder, write_atomically
from ..consistency.variants import Variant
from ..policies import describe
from ..trials.scenario import Scenario, scenario_text
from .folder import SearchLog
from .playing import Play, Players
from .prepared import PreparedSearch, identity, prepare_search
from .ranges import PARAMETERS, Case, describe_case, scenario_of
from .request import WorstError, WorstRequest, WorstStatus
from .search import (
    CAUSE_APART,
    CONFIDENCE,
    VALUES_APART,
    Archive,
    Elite,
    Outcome,
    Reduction,
    choose_different,
    hardness,
    random_case,
    upper_bound,
    waiting,
)
from .sentences import sentences

SCHEMA = 1
SEARCHED = (range(1), range(1, 2), range(2, 6))
"""Seeds of the search, in the order in which they are played: a case is a failure if the robot falls with each of them."""
CONFIRMING = range(6, 12)
"""Seeds with which a failure of the gallery is played again: the search has seen none of them."""
GALLERY = 10
"""Failures that are filmed."""
_SAMPLED = 0.25
"""Share of the budget that the random sample takes."""
_NEEDED, _SETTLED = 0.5, 0.85
"""Shares of the budget at which it is no longer asked what the falls of the sample need, and what those of the search need."""
_ROUNDS = 3
"""Rounds of such questions that are played in any case: enough for up to two factors."""
_REST, _REST_PLAYS = 0.4, 500
"""Largest share of the budget that is left to what follows the search, and about the plays that it takes."""
_LEAST_SAMPLE, _MOST_SAMPLE = 30, 10_000
"""Least and largest number of cases of the random sample; 30 without a fall bound its probability by 10 %."""
_MOST_FALLS = 200
"""Falls of the random sample that are kept as scenarios."""
_REDUCED = 12
"""Number of the sample's falls that lose their needless factors before the search."""

Watch = Callable[[WorstStatus], None]


def search_worst(
    request: WorstRequest | PreparedSearch,
    folder: Path,
    *,
    resume: bool = False,
    reserve: float = 0.0,
    command: Sequence[str] = (),
    watch: Watch = lambda _: None,
) -> dict[str, Any]:
    """Search for failures; every finished batch is on disk at once.

    Args:
        reserve: share of the budget that is left to the caller, for films.

    Returns the content of ``worst.json`` (docs/guides/worst.md).

    Raises:
        WorstError: the folder belongs to another search, or holds this one and ``resume`` is not asked for.
        ConsistencyError, SuiteError, RobotError, PolicyError, ContractError, BackendError: one sentence.
    """
    prepared = request if isinstance(request, PreparedSearch) else prepare_search(request)
    torch.set_num_threads(1)  # several would change the last bits of the policy's output
    with ExitStack() as stack:
        log = stack.enter_context(SearchLog(folder, identity(prepared), resume=resume))
        policy, robot = prepared.loaded.policy, prepared.robot
        players = stack.enter_context(Players(policy, robot, cpu_threads(prepared.request.threads)))
        search = _Search(prepared, log, players, (1.0 - reserve) * 60.0 * prepared.request.minutes, watch)
        found = search.run()
        results = _results(prepared, search, found, command)
        ranked = [f for f in results["failures"] if f["rank"] is not None]
        fallen = [elite.case for elite in found.sampled if elite.outcome.fell][:_MOST_FALLS]
        cases = {failure["scenario"]: search.case(failure["name"]) for failure in ranked}
        cases |= {f"falls/{case.name}.toml": case for case in fallen}
        for name in ("scenarios", "falls"):
            make_folder(folder / name, WorstError)
        for name, case in cases.items():
            write_atomically(folder / name, scenario_text(search.scenario(case)), WorstError)
        write_atomically(folder / "worst.json", json_text(results), WorstError)
    return results


@dataclass(kw_only=True)
class _Found:
    """Findings of a search."""

    sampled: list[Elite]
    sample_again: dict[str, list[Outcome]]
    """The falls of the sample, in each other engine."""
    failures: list[Elite]
    again: dict[str, dict[str, list[bool]]]
    """True where a failure fell, by its name and the engine, for each seed that was played."""
    chosen: list[str]
    """Names of the failures that differ, played with all seeds."""


class _Search:
    """One search at work."""

    def __init__(self, prepared: PreparedSearch, log: SearchLog, players: Players, budget: float, watch: Watch) -> None:
        self.prepared, self._log, self._players, self._watch = prepared, log, players, watch
        self._budget, self._seed, self._batch = budget, prepared.request.seed, prepared.request.batch
        self.archive, self._needed = Archive(prepared.ranges), Archive(prepared.ranges)
        self.used = 0.0
        self.played = self.fallen = self.generations = 0
        self._cases: dict[str, Case] = {}

    def scenario(self, case: Case) -> Scenario:
        """Return a case as a scenario."""
        return scenario_of(case, self.prepared.measures)

    def case(self, name: str) -> Case:
        """Return the reduced case of a failure."""
        return self._cases[name]

    def run(self) -> _Found:
        """Return what was found when the budget is spent."""
        sampled = self._sample()
        fallen = [elite for elite in sampled if elite.outcome.fell]
        again = {
            v.label: self._play("sampled falls in other engines", [e.case for e in fallen], engine=v)
            for v in self.prepared.others
        }
        self._reduce("what falls of the sample need", fallen[:_REDUCED], _NEEDED, SEARCHED[:2])
        self._explore()
        self._reduce("what each failure needs", self.archive.failures, _SETTLED)
        failures = self._needed.failures
        self._cases = {elite.case.name: elite.case for elite in failures}
        return _Found(sampled=sampled, sample_again=again, failures=failures, **self._again(failures))

    def _play(
        self, stage: str, cases: Sequence[Case], *, engine: Variant | None = None, seeds: Sequence[int] = (0,)
    ) -> list[Outcome]:
        """Return what comes of cases with each of some seeds, batch by batch: all seeds of the first case come first."""
        variant = engine or self.prepared.engine
        found: list[Outcome] = []
        plays = [(case, seed) for case in cases for seed in seeds]
        for at in range(0, len(plays), self._batch):
            part = plays[at : at + self._batch]
            self._report(stage)
            key = [variant.label, variant.device, [[c.name, list(c.values), sorted(c.factors), s] for c, s in part]]
            made: list[Play] = [(self.scenario(case), seed) for case, seed in part]
            outcomes, seconds = self._log.batch(key, lambda made=made: self._players.play(made, variant))  # type: ignore[misc]
            self.used += seconds
            self.played += len(part)
            self.fallen += sum(outcome.fell for outcome in outcomes)
            found += outcomes
        self._report(stage)
        return found

    def _fell(
        self, stage: str, cases: Sequence[Case], seeds: Sequence[int], engine: Variant | None = None
    ) -> list[list[bool]]:
        """Return for each case whether the robot fell, by seed."""
        outcomes = iter(self._play(stage, cases, engine=engine, seeds=seeds))
        return [[next(outcomes).fell for _ in seeds] for _ in cases]

    def _report(self, stage: str) -> None:
        left = max(self._budget - self.used, 0.0)
        share = min(self.used / self._budget, 1.0)
        status = WorstStatus(stage=stage, played=self.played, fallen=self.fallen, share=share, seconds_left=left)
        self._watch(status)

    def _random(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, *stream])

    def _sample(self) -> list[Elite]:
        """Return an independent sample of the whole ranges; its size is fixed before any of it is played."""
        ranges = self.prepared.ranges
        tried = [random_case(self._random(0, i), ranges, f"speed-{i}") for i in range(min(16, self._batch))]
        began = self.used
        self._play("measuring the speed", tried)
        each = max((self.used - began) / len(tried), 1e-6)
        count = self._log.kept("sample", max(min(int(_SAMPLED * self._budget / each), _MOST_SAMPLE), _LEAST_SAMPLE))
        cases = [random_case(self._random(1, i), ranges, f"sample-{i}") for i in range(count)]
        return _elites(cases, self._play("random sample", cases))

    def _explore(self) -> None:
        """Search until its share of the budget is spent, for at least one generation."""
        while not self.generations or self.used < self._budget - self._rest:
            names = [f"search-{self.generations}-{i}" for i in range(self._batch)]
            cases = self.archive.propose(self._random(2, self.generations), names)
            played = _elites(cases, self._play("search", cases))
            self.archive.add(self._assure("search", played, self.archive.wants))
            self.generations += 1

    def _assure(
        self,
        stage: str,
        elites: Sequence[Elite],
        wanted: Callable[[Elite], bool] = lambda _: True,
        turns: Sequence[Sequence[int]] = SEARCHED,
    ) -> list[Elite]:
        """Return cases that were played with the first seed; those that fell and are wanted are played with the others too."""
        sure = [elite.case for elite in elites if elite.outcome.fell and wanted(elite)]
        for seeds in turns[1:]:
            fell = self._fell(stage, sure, seeds)
            sure = [case for case, own in zip(sure, fell, strict=True) if all(own)]
        return [replace(elite, sure=elite.case in sure) for elite in elites]

    def _reduce(
        self, stage: str, elites: Sequence[Elite], end: float, seeds: Sequence[Sequence[int]] = SEARCHED
    ) -> None:
        """Take from cases that fall what their falls, with some of the search's seeds, do not need; from those at the front first.

        What remains goes into the archive. Those that are not done at the share ``end`` of the budget wait.
        """
        reductions = [Reduction(elite, self._random(3, at)) for at, elite in enumerate(elites)]
        rounds = 0
        while turns := list(islice(waiting(reductions), self._batch)):
            if rounds >= _ROUNDS and self.used >= end * self._budget:
                break
            rounds += 1
            cases = [case for _, case in turns]
            played = self._assure(stage, _elites(cases, self._play(stage, cases)), turns=seeds)
            for (reduction, _), tried in zip(turns, played, strict=True):
                reduction.tell(tried)
        left = [reduction.elite for reduction in reductions]
        if seeds != SEARCHED:
            left = self._assure(stage, left)
        self.archive.add(left)
        self._needed.add([elite for elite, done in zip(left, reductions, strict=True) if done.next is None])

    @property
    def _rest(self) -> float:
        """Return the time that what follows the search takes [s]."""
        return min(_REST * self._budget, _REST_PLAYS * self._each) if self.archive.failures else 0.0

    @property
    def _each(self) -> float:
        """Return the mean time of a play so far [s]."""
        return max(self.used / max(self.played, 1), 1e-6)

    def _again(self, failures: Sequence[Elite]) -> dict[str, Any]:
        """Play every failure with a new seed in all engines, and those that differ with more seeds."""
        engines = [self.prepared.engine, *self.prepared.others]
        cases = [elite.case for elite in failures]
        again: dict[str, dict[str, list[bool]]] = {case.name: {} for case in cases}
        for engine in engines:
            fell = self._fell("failures again", cases, CONFIRMING[:1], engine)
            for case, own in zip(cases, fell, strict=True):
                again[case.name][engine.label] = own
        here, more = self.prepared.engine.label, CONFIRMING[1:]
        fell_again = [case for case in cases if again[case.name][here][0]]
        time_for = int((self._budget - self.used) / (self._each * len(more) * len(engines)))
        most = min(max(time_for, GALLERY // 2), 2 * GALLERY)
        chosen: list[Case] = []
        while True:  # those that are not confirmed make room for others
            held = [case for case in chosen if _confirmed(again[case.name][here])]
            tried = held + [case for case in fell_again if case not in chosen]
            new = [tried[i] for i in choose_different(tried, self.prepared.ranges, GALLERY) if i >= len(held)]
            if not (new := new[: most - len(chosen)]):
                return {"again": again, "chosen": [case.name for case in chosen]}
            for engine in engines:
                fell = self._fell("failures with other seeds", new, more, engine)
                for case, own in zip(new, fell, strict=True):
                    again[case.name][engine.label] += own
            chosen += new


def _confirmed(fell: Sequence[bool]) -> bool:
    """Return whether a robot fell with at least half of the confirming seeds; False where some were not played."""
    return len(fell) == len(CONFIRMING) and 2 * sum(fell) >= len(fell)


def _elites(cases: Sequence[Case], outcomes: Iterable[Outcome]) -> list[Elite]:
    return [Elite(case, outcome) for case, outcome in zip(cases, outcomes, strict=True)]


def _results(prepared: PreparedSearch, search: _Search, found: _Found, command: Sequence[str]) -> dict[str, Any]:
    """Return the content of ``worst.json``."""
    others = [variant.label for variant in prepared.others]
    failures = [_failure(prepared, elite, found) for elite in found.failures]
    gallery = [f for f in failures if f["name"] in found.chosen and f["confirmed"]]
    gallery.sort(key=lambda f: (f["only_here"], len(f["factors"]), f["hardness"]))
    for rank, failure in enumerate(gallery[:GALLERY], 1):
        failure |= {"rank": rank, "scenario": f"scenarios/worst-{rank:02d}.toml", "film": None}
    falls = sum(elite.outcome.fell for elite in found.sampled)
    results: dict[str, Any] = {
        "schema": SCHEMA,
        "policy": describe(prepared.label, prepared.loaded),
        "suite": prepared.request.suite,
        "engine": prepared.engine.label,
        "family": engine_class(prepared.engine.backend).family,
        "others": [{"engine": v.label, "family": engine_class(v.backend).family} for v in prepared.others],
        "skipped": prepared.skipped,
        "seed": prepared.request.seed,
        "minutes": prepared.request.minutes,
        "ranges": {name: list(pair) for name, pair in asdict(prepared.ranges).items()},
        "rules": {
            "cause_apart": CAUSE_APART,
            "values_apart": VALUES_APART,
            "searched_seeds": list(chain(*SEARCHED)),
            "seeds": list(CONFIRMING),
            "confidence": CONFIDENCE,
        },
        "sample": {
            "cases": len(found.sampled),
            "falls": falls,
            "diverged": sum(elite.outcome.diverged for elite in found.sampled),
            "bound": upper_bound(falls, len(found.sampled)),
            "again": {label: sum(o.fell for o in found.sample_again[label]) for label in others},
        },
        "search": {"generations": search.generations, "plays": search.played, "falls": search.fallen},
        "failures": failures,
        "provenance": provenance(
            command=command,
            device=prepared.engine.device,
            threads=cpu_threads(prepared.request.threads),
            seconds=round(search.used, 1),
        ),
    }
    return results | {"sentences": sentences(results)}


def _failure(prepared: PreparedSearch, elite: Elite, found: _Found) -> dict[str, Any]:
    """Return what is said of a failure."""
    case, again = elite.case, found.again[elite.case.name]
    here = again[prepared.engine.label]
    elsewhere = [any(again[variant.label]) for variant in prepared.others]
    return {
        "name": case.name,
        "factors": list(case.words),
        "words": describe_case(case, prepared.measures),
        "values": {p.name: v for p, v in zip(PARAMETERS, case.values, strict=True) if p.factor in case.factors},
        "hardness": hardness(case, prepared.ranges),
        "seconds": elite.outcome.seconds,
        "diverged": elite.outcome.diverged,
        "again": again,
        "confirmed": _confirmed(here),
        "only_here": bool(elsewhere) and not any(elsewhere),
        "rank": None,
        "scenario": None,
        "film": None,
    }
