"""What is to be played in an environment, as a pure function of the episodes that have ended (gauge protocol §7).

``plan(environment, records, rules)`` returns the level as far as it is known, the episodes that count, those of them that
have not ended (required), and those that may be required yet, with the probability of that. A first run, a resumed one, the
scheduling of episodes and the folding of results all ask this function; there is no other state than the records.

Two rules hold, and tests check them. What counts depends on the outcomes of the counted episodes alone: records of others,
played ahead of time, change when something is known and never what. And what is required once stays counted.

A suite says how a level is found: by bisection over level tests, or as an expected level (``level_curve``, ``level_area``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from .chance.level_area import follow_area
from .chance.level_curve import CurveSearch, bracketing_levels, fitted_curve, follow, nearness
from .episodes import Episode, Record
from .goals import TARGET
from .pipelines import Environment
from .suite import Suite

Records = Mapping[Episode, Record]
"""Episodes that have ended."""


@dataclass(frozen=True, kw_only=True)
class PlanRules:
    """Inputs of a plan beside environment and records."""

    suite: Suite
    seeds: tuple[int, ...]
    """Seeds of the quality episodes."""
    quality: bool = True
    """True where quality is evaluated at the level, False for the level alone."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """State of an environment, and the episodes to be played there."""

    level: float | None
    """Level reached or given, None while searched for; 0 on flat ground, and where not even level 1 is passed. A whole number but
    where the suite asks for an expected level."""
    passed: Mapping[int, bool] = field(default_factory=dict)
    """Outcomes of the levels that the search has asked for, in its order; empty while the trials of a curve are open."""
    counted: tuple[Episode, ...]
    """Episodes of the results, in order, as far as they are known."""
    required: tuple[Episode, ...]
    """Those of them that have not ended."""
    possible: Mapping[Episode, float] = field(default_factory=dict)
    """Episodes that have not ended and may be required yet, and how probable that is."""


def plan(environment: Environment, records: Records, rules: PlanRules) -> Plan:
    """Plan an environment: its level unless it is given, then its quality. ``records`` may hold those of other environments, too."""
    if environment.level is None and rules.suite.scoring.level != "bisection":
        return _plan_expected(environment, records, rules)
    counted: list[Episode] = []
    passed: dict[int, bool] = {}
    low, high = 0, rules.suite.scoring.levels
    if environment.level is not None:
        low = high = int(environment.level)
    while low < high:
        test = _level_test(environment, (low + high + 1) // 2, records, rules)
        counted += test.counted
        if test.passed is None:
            break
        passed[test.level] = test.passed
        low, high = (test.level, high) if test.passed else (low, test.level - 1)
    level = low if low == high else None
    if level is not None:
        counted += _quality(environment, level, rules)
    possible = dict(_possible(environment, low, high, records, rules, 1.0)) if level is None else {}
    return _plan(level, passed, counted, possible, records)


def _plan(
    level: float | None,
    passed: Mapping[int, bool],
    counted: Sequence[Episode],
    possible: Mapping[Episode, float],
    records: Records,
) -> Plan:
    """A plan, without what has ended or counts among what is possible."""
    counts = set(counted)
    return Plan(
        level=level,
        passed=passed,
        counted=tuple(counted),
        required=tuple(e for e in counted if e not in records),
        possible={e: p for e, p in possible.items() if p > 0.0 and e not in records and e not in counts},
    )


def plan_list(episodes: Sequence[Episode], records: Records) -> Plan:
    """The plan of a fixed list of episodes, at levels that are given."""
    return Plan(level=None, counted=tuple(episodes), required=tuple(e for e in episodes if e not in records))


def _possible(
    environment: Environment, low: int, high: int, records: Records, rules: PlanRules, probability: float
) -> Iterator[tuple[Episode, float]]:
    """Episodes that a search between two levels may ask for, and how probable that is, given how probable the search is."""
    if low == high:
        yield from ((episode, probability) for episode in _quality(environment, low, rules))
        return
    test = _level_test(environment, (low + high + 1) // 2, records, rules)
    # a round that has begun is played to its end, even where the outcome is certain before
    yield from ((episode, probability) for episode in test.counted)
    yield from ((episode, probability * test.goes_on) for episode in test.later)
    if test.probability > 0.0:
        yield from _possible(environment, test.level, high, records, rules, probability * test.probability)
    if test.probability < 1.0:
        yield from _possible(environment, low, test.level - 1, records, rules, probability * (1.0 - test.probability))


# ---- one level --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class LevelTest:
    """One level, played with the search seeds in rounds.

    A round has as many episodes as must still succeed: the outcome is that of playing all seeds, and the episodes that count
    depend on nothing but their results. Shorter rounds would save episodes where a level is failed, and cost rounds where it is
    passed; a search is a chain of rounds, and the longest chain is what a run of few environments waits for.
    """

    level: int
    counted: Sequence[Episode]
    """Episodes of the rounds so far."""
    later: Sequence[Episode]
    """Episodes that another round may have."""
    passed: bool | None
    """True where the level is passed, False where it is failed, as soon as that is certain."""
    probability: float
    """How probable it is that the level is passed: 0 or 1 once that is certain."""
    goes_on: float
    """How probable it is that the present round leaves the outcome open."""


def _level_test(environment: Environment, level: int, records: Records, rules: PlanRules) -> LevelTest:
    """How far the test of a level is."""
    suite = rules.suite
    seeds = suite.matrix.search_seeds
    episodes = [episode_of(environment, level, seed, "search", suite) for seed in seeds]
    outcomes = [bool(records[e].success) if e in records else None for e in episodes]
    needed = math.ceil(suite.scoring.pass_rate * len(seeds) - 1e-9)
    most_failures = len(seeds) - needed
    size = needed
    while None not in outcomes[:size]:
        missing = needed - outcomes[:size].count(True)
        if missing <= 0 or missing > len(seeds) - size:
            break
        size += missing
    successes, failures = outcomes.count(True), outcomes.count(False)
    passed = True if successes >= needed else False if failures > most_failures else None
    known = successes, failures
    at_least, open_until = needed - successes, most_failures - failures
    running = outcomes[:size].count(None)
    return LevelTest(
        level=level,
        counted=episodes[:size],
        later=episodes[size:],
        passed=passed,
        probability=sum(_successes(*known, outcomes.count(None))[max(at_least, 0) :]) if passed is None else passed,
        goes_on=sum(
            p for more, p in enumerate(_successes(*known, running)) if more < at_least and running - more <= open_until
        ),
    )


@lru_cache
def _successes(successes: int, failures: int, more: int) -> tuple[float, ...]:
    """Probabilities of 0 to ``more`` successes in that many further episodes, after some successes and failures.

    Every rate of success is equally probable to begin with, which makes it a beta-binomial distribution.
    """

    def beta(a: int, b: int) -> float:
        return math.factorial(a) * math.factorial(b) / math.factorial(a + b + 1)

    before = beta(successes, failures)
    return tuple(math.comb(more, k) * beta(successes + k, failures + more - k) / before for k in range(more + 1))


def _quality(environment: Environment, level: float, rules: PlanRules) -> list[Episode]:
    """The quality episodes at a level, or at the two levels beside it; none where not even level 1 is passed."""
    if not rules.quality:
        return []
    levels = [0] if environment.terrain == "flat" else list(bracketing_levels(level))
    return [episode_of(environment, at, seed, "eval", rules.suite) for at in levels for seed in rules.seeds]


def episode_of(environment: Environment, level: int, seed: int, stage: str, suite: Suite) -> Episode:
    """Return an episode of a suite, with the goals of its stage."""
    return Episode(
        terrain=environment.terrain,
        level=level,
        friction=environment.friction,
        payload=environment.payload,
        seed=seed,
        stage=stage,
        goals=tuple(g.name for g in suite.goals if (g.name == TARGET) == (stage == "search")),
    )


# ---- an expected level ------------------------------------------------------------------------------------------------


def _plan_expected(environment: Environment, records: Records, rules: PlanRules) -> Plan:
    """The level as the area under a curve, then the quality episodes beside it."""
    suite = rules.suite
    seeds, levels = suite.matrix.search_seeds, suite.scoring.levels

    def trial(level: int, seed: int) -> Episode:
        return episode_of(environment, level, seed, "search", suite)

    def outcomes(level: int) -> list[bool | None]:
        found = [records.get(trial(level, seed)) for seed in seeds]
        return [None if r is None else bool(r.success) for r in found]

    if suite.scoring.level == "area":
        area = follow_area(outcomes, levels, len(seeds))
        known, counts, near = area.level, area.seeds, area.near
        begins = max(counts.values()) == 1  # every trial that may count does so once each level has its first outcome
        likely = {at: _share(*near, levels, 4) * nearness(at, *near) for at in range(1, levels + 1) if begins}
    else:
        found = follow(outcomes, levels, len(seeds), suite.scoring.bracket_seeds)
        known, counts, near = found.level, found.seeds, (found.lowest, found.highest)
        likely = _likely_levels(found, levels)
    counted = [trial(level, seed) for level, count in counts.items() for seed in seeds[:count]]
    if known is None:
        possible = {trial(level, seed): p for level, p in likely.items() for seed in seeds}
        for level in range(1, levels + 1):
            chance = _share(*near, levels, 2) * nearness(level, *near)
            possible |= dict.fromkeys(_quality(environment, level, rules), chance)
        return _plan(None, {}, counted, possible, records)
    fit = fitted_curve({level: [bool(o) for o in outcomes(level)[:count]] for level, count in counts.items()})
    passed = {level: fit[level] >= 0.5 for level in counts}
    return _plan(known, passed, [*counted, *_quality(environment, known, rules)], {}, records)


def _likely_levels(found: CurveSearch, levels: int) -> dict[int, float]:
    """Levels of which all seeds may count yet, and how probable that is, roughly."""
    below = range(1, found.lowest) if found.goes_down else range(0)
    above = range(found.highest + 1, levels + 1) if found.goes_up else range(0)
    within = range(max(found.lowest, 1), min(found.highest, levels) + 1)
    share = _share(found.lowest, found.highest, levels, 4)
    return {level: share * nearness(level, found.lowest, found.highest) for level in (*within, *below, *above)}


def _share(lowest: int, highest: int, levels: int, wanted: int) -> float:
    """Part of the levels in question that ``wanted`` of them are, at most 0.8: the more are in question, the less is known of each."""
    return min(wanted / (min(highest, levels) - max(lowest, 1) + 1), 0.8)


# ---- the end ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class EnvironmentResult(Environment):
    """An environment at the level reached or given, and what came of it."""

    search: Mapping[int, bool] | None
    """Levels that the search asked for, and whether they were passed (by half of the seeds or more, where the level is an expected
    one); None where the level was given."""
    trials: Sequence[Record]
    """Episodes of the level tests."""
    records: Sequence[Record]
    """Quality episodes, level by level, in the order of the seeds."""

    @property
    def searched(self) -> bool:
        """Return whether the level was found by search."""
        return self.search is not None


def environment_result(environment: Environment, records: Records, rules: PlanRules) -> EnvironmentResult:
    """Outcome of an environment after all its required episodes."""
    found = plan(environment, records, rules)
    counted = [records[episode] for episode in found.counted]
    return EnvironmentResult(
        terrain=environment.terrain,
        friction=environment.friction,
        payload=environment.payload,
        level=found.level,
        search=found.passed if environment.searched else None,
        trials=[r for r in counted if r.episode.stage == "search"],
        records=[r for r in counted if r.episode.stage == "eval"],
    )
