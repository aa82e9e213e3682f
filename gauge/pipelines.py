"""Which episodes a pipeline asks for, and what follows from their outcomes (gauge protocol: Base, Multi, Level, Stress; §7).

Every pipeline is a list of environments. An environment is played at a given level, or at the level that a binary search finds;
then its quality episodes run, unless only the level was asked for.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from .episodes import Episode, Record
from .goals import TARGET
from .suite import Suite, SuiteError

PIPELINES = ("base", "multi", "level", "stress")
_FEW_LEVELS = 3
"""Levels that a search may still find, of which the quality episodes are begun early: more of them would mostly be in vain."""
_FEW_TESTS = 0.25
"""Share of the episodes of a search that are still open when that begins: until then, worlds have better things to do."""


class Store(Protocol):
    """Where finished episodes are kept."""

    def get(self, episode: Episode) -> Record | None:
        """The record of an episode that has already run."""

    def put(self, record: Record) -> None:
        """Keep a record."""


class LevelTest:
    """One level, played with the search seeds, in rounds that stop as soon as the outcome is certain.

    A round has as many episodes as must still succeed: the outcome is that of playing all seeds, and the set of episodes depends on
    nothing but their results. Shorter rounds would save episodes where a level is failed, and cost rounds where it is passed; a
    search is a chain of rounds, and the longest chain is what a run of few environments waits for.
    """

    def __init__(self, seeds: Sequence[int], pass_rate: float, *, all_at_once: bool) -> None:
        self._waiting = list(seeds)
        self._needed = math.ceil(pass_rate * len(seeds) - 1e-9)
        self._may_fail = len(seeds) - self._needed
        self._running = 0
        self._all = all_at_once
        self.successes = 0
        self.failures = 0

    @property
    def passed(self) -> bool | None:
        """Whether the level is passed; None while open."""
        if self.successes >= self._needed:
            return True
        return False if self.failures > self._may_fail else None

    def next_round(self) -> list[int]:
        """Seeds to play now; empty while a round is running or once decided."""
        if self._running or self.passed is not None:
            return []
        size = len(self._waiting) if self._all else self._needed - self.successes
        seeds, self._waiting = self._waiting[:size], self._waiting[size:]
        self._running = len(seeds)
        return seeds

    def record(self, success: bool) -> None:
        """An episode of the round has ended."""
        self._running -= 1
        self.successes += success
        self.failures += not success

    @property
    def nearly_passed(self) -> bool:
        """Whether nothing has failed and one more success decides."""
        return self.failures == 0 and self.successes == self._needed - 1

    @property
    def idle(self) -> bool:
        """No episode of it is running."""
        return self._running == 0


@dataclass(kw_only=True)
class Environment:
    """One terrain at one friction and payload, and how far its gauging is."""

    terrain: str
    friction: float
    payload: float
    level: int | None
    """Level reached or given; None while searched for. 0 on flat ground, and where not even level 1 is passed."""
    searched: bool
    """Whether the level is found by search."""
    tests: dict[int, LevelTest] = field(default_factory=dict)
    records: list[Record] = field(default_factory=list)
    """Quality episodes, in the order of the seeds once complete."""
    trials: list[Record] = field(default_factory=list)
    """Episodes of the level tests."""
    low: int = 0
    high: int = 0
    waiting: set[Episode] = field(default_factory=set)
    """Episodes that wait or are at work, those that are ``early`` left out."""
    early: dict[int, dict[Episode, Record | None]] = field(default_factory=dict)
    """Quality episodes of levels that may come out, begun before the level is known, and their records once there are any."""

    ahead: dict[Episode, Record | None] = field(default_factory=dict)
    """Episodes begun although nobody has asked for them yet, and their records once there are any."""

    @property
    def key(self) -> str:
        """Unique name."""
        return f"{self.terrain}-f{self.friction:.12g}-m{self.payload:.12g}"

    def prospects(self) -> tuple[set[int], set[int]]:
        """Levels about which the search may still ask, and those that it may find, after what is known so far."""
        asked: set[int] = set()
        found: set[int] = set()
        ranges = [(self.low, self.high)]
        while ranges:
            low, high = ranges.pop()
            if low >= high:
                found.add(low)
                continue
            middle = (low + high + 1) // 2
            passed = self.tests[middle].passed if middle in self.tests else None
            if passed is None:
                asked.add(middle)
            if passed is not False:
                ranges.append((middle, high))
            if passed is not True:
                ranges.append((low, middle - 1))
        return asked, found


class Plan:
    """The agenda of one pipeline run (see ``runner.Agenda``)."""

    def __init__(
        self,
        suite: Suite,
        environments: Sequence[Environment],
        seeds: Sequence[int],
        store: Store,
        *,
        evaluate: bool = True,
        speculative: bool = False,
    ) -> None:
        """Queue what can start at once.

        Args:
            suite: the rules.
            environments: what to gauge.
            seeds: seeds of the quality episodes.
            store: finished episodes; those found there are not run again.
            evaluate: whether quality episodes follow once the level is known.
            speculative: play every level at once instead of searching step by step, begin the quality episodes of the last few
                levels that may come out, and drop what turns out not to matter: more work, fewer steps in a row.
        """
        self.suite, self.environments, self.seeds = suite, list(environments), list(seeds)
        self._store, self._evaluate, self._speculative = store, evaluate, speculative
        self._tests: deque[Episode] = deque()
        self._quality: deque[Episode] = deque()
        self._early: deque[Episode] = deque()  # quality of levels that are not known yet
        self._of: dict[Episode, Environment] = {}  # of the episodes that wait or are at work
        self.total_known = 0
        self.done = 0
        for environment in self.environments:
            if environment.level is None:
                environment.low, environment.high = 0, suite.scoring.levels
                self._search(environment)
            elif evaluate and (environment.level > 0 or environment.terrain == "flat"):
                self._queue_quality(environment)
        self._tests_at_first = len(self._tests)

    # ---- the runner's side ----------------------------------------------------------------------------------------

    def take(self, most: int, *, urgent: bool = False) -> list[Episode]:
        """Episodes that can start now. Level tests come first: others wait for them, while quality can be played at any time.

        Args:
            most: largest number of episodes.
            urgent: level tests alone.
        """
        taken = self._take(self._tests, most)
        while not urgent and len(taken) < most and (self._tests or self._quality or self._begin_early()):
            taken += self._take(self._tests or self._quality or self._early, 1)
        return taken

    def take_quality(self, most: int) -> list[Episode]:
        """Quality episodes that can start now."""
        return self._take(self._quality, most)

    def _take(self, queue: deque[Episode], most: int) -> list[Episode]:
        """The next episodes of a queue that have not run yet; what follows from the others is folded in."""
        taken: list[Episode] = []
        while queue and len(taken) < most:
            episode = queue.popleft()
            known = self._store.get(episode)
            if known is None:
                taken.append(episode)
            else:
                environment = self._of[episode]
                self._fold(known)
                self._take_over(environment)
        return taken

    def finished(self, record: Record) -> Collection[Episode]:
        """Keep an episode's record and ask for what follows from it.

        Returns:
            Episodes at work that nobody needs any more: of level tests played at once whose outcome is certain by now.
        """
        environment = self._of.get(record.episode)
        if environment is not None and record.episode in environment.ahead:
            environment.ahead[record.episode] = record
            return ()
        if environment is None and not self._speculative:
            return ()  # given up in the moment in which it ended
        self._store.put(record)
        needless = self._fold(record)
        if environment is not None:
            self._take_over(environment)
        return needless

    @property
    def waiting(self) -> tuple[int, int]:
        """Number of episodes that can start now: of level tests, and for quality."""
        return len(self._tests), len(self._quality)

    def expected_left(self) -> float:
        """Rough number of episodes still to come, searches that are not decided yet counted by their usual length."""
        open_searches = sum(e.searched and e.level is None for e in self.environments)
        later = open_searches * (4.0 + (len(self.seeds) if self._evaluate else 0))
        return self.total_known - self.done + later

    # ---- ahead of time --------------------------------------------------------------------------------------------

    def take_ahead(self, most: int) -> list[Episode]:
        """Episodes that will be asked for if level tests end as they began, for those who have nothing better to play.

        What comes of them is kept in memory until somebody asks for it, and forgotten where nobody does: neither results nor store
        show what was played ahead.
        """
        taken: list[Episode] = []
        for environment, episode in self.likely()[:most]:
            environment.ahead[episode] = None
            self._of[episode] = environment
            taken.append(episode)
        return taken

    def likely(self) -> list[tuple[Environment, Episode]]:
        """What ``take_ahead`` has to offer."""
        found = []
        for environment in self.environments:
            level = (environment.low + environment.high + 1) // 2
            test = environment.tests.get(level) if environment.level is None else None
            if test is not None and test.nearly_passed:
                found += [(environment, e) for e in self._if_passed(environment, level) if e not in environment.ahead]
        return [(environment, e) for environment, e in found if self._store.get(e) is None]

    def _if_passed(self, environment: Environment, level: int) -> list[Episode]:
        """What a search asks for next if a level is passed."""
        if level < environment.high:
            following = (level + environment.high + 1) // 2
            return [self._episode(environment, following, s, "search") for s in self._new_test().next_round()]
        return [self._episode(environment, level, s, "eval") for s in self.seeds] if self._evaluate else []

    def needless(self) -> list[Episode]:
        """Forget what was begun ahead and will never be asked for; returns the episodes of it that are at work."""
        at_work = []
        for environment in self.environments:
            if not environment.ahead:
                continue
            asked, found = environment.prospects()
            for episode in sorted(environment.ahead):
                if episode.level not in (asked if episode.stage == "search" else found):
                    del self._of[episode]
                    if environment.ahead.pop(episode) is None:
                        at_work.append(episode)
        return at_work

    def _take_over(self, environment: Environment) -> None:
        """What was begun ahead and is asked for by now becomes like any other episode."""
        while asked := sorted(environment.ahead.keys() & environment.waiting):
            for episode in asked:
                (self._quality if episode.stage == "eval" else self._tests).remove(episode)
                record = environment.ahead.pop(episode)
                if record is not None:
                    self._store.put(record)
                    self._fold(record)

    # ---- folding --------------------------------------------------------------------------------------------------

    def _add(self, environment: Environment, episodes: Sequence[Episode]) -> None:
        for episode in episodes:
            self._of[episode] = environment
            environment.waiting.add(episode)
            (self._quality if episode.stage == "eval" else self._tests).append(episode)
        self.total_known += len(episodes)

    def _fold(self, record: Record) -> Collection[Episode]:
        environment = self._of.pop(record.episode, None)
        if environment is None:
            return ()  # it ended together with the one after which nobody needed it
        early = environment.early.get(record.episode.level, {})
        if record.episode in early:
            early[record.episode] = record
            return ()
        environment.waiting.discard(record.episode)
        self.done += 1
        if record.episode.stage == "eval":
            environment.records.append(record)
            environment.records.sort(key=lambda r: self.seeds.index(r.episode.seed))
            return ()
        environment.trials.append(record)
        environment.tests[record.episode.level].record(bool(record.success))
        self._search(environment)
        return self._drop_needless(environment) if self._speculative else ()

    def _drop_needless(self, environment: Environment) -> Collection[Episode]:
        """Forget episodes that decide about nothing any more; returns those that are at work."""
        asked, found = environment.prospects()
        needless = {e for e in environment.waiting if e.stage == "search" and e.level not in asked}
        environment.waiting -= needless
        for episode in needless:
            del self._of[episode]
        self.total_known -= len(needless)
        waiting = needless.intersection(self._tests)
        if waiting:
            self._tests = deque(e for e in self._tests if e not in waiting)
        at_work = needless - waiting
        for level in environment.early.keys() - found:
            begun = self._at_work(environment.early.pop(level))
            at_work.update(episode for episode, record in begun.items() if record is None)
        return at_work

    def _search(self, environment: Environment) -> None:
        """Go on with the binary search as far as the outcomes allow."""
        if self._speculative and not environment.tests:
            for level in range(1, self.suite.scoring.levels + 1):
                self._queue_test(environment, level)
        while environment.level is None:
            if environment.low >= environment.high:
                environment.level = environment.low
                if self._evaluate and environment.level > 0:
                    self._queue_quality(environment)
                return
            middle = (environment.low + environment.high + 1) // 2
            passed = self._queue_test(environment, middle)
            if passed is None:
                return
            if passed:
                environment.low = middle
            else:
                environment.high = middle - 1

    def _queue_test(self, environment: Environment, level: int) -> bool | None:
        """Queue the next round of a level's test; returns its outcome if it has one."""
        if level not in environment.tests:
            environment.tests[level] = self._new_test()
        test = environment.tests[level]
        self._add(environment, [self._episode(environment, level, s, "search") for s in test.next_round()])
        return test.passed if test.idle or self._speculative else None

    def _new_test(self) -> LevelTest:
        seeds, rate = self.suite.matrix.search_seeds, self.suite.scoring.pass_rate
        return LevelTest(seeds, rate, all_at_once=self._speculative)

    def _queue_quality(self, environment: Environment) -> None:
        level = environment.level or 0
        begun = self._at_work(environment.early.pop(level, {}))
        episodes = [self._episode(environment, level, s, "eval") for s in self.seeds]
        self._add(environment, [e for e in episodes if e not in begun])
        self.total_known += len(begun)
        for episode, record in begun.items():
            self._of[episode] = environment
            environment.waiting.add(episode)
            if record is not None:
                self._fold(record)

    def _begin_early(self) -> bool:
        """Where a search is about to end, begin the quality episodes of the levels that it may find; returns whether any wait."""
        if (
            self._early
            or not (self._speculative and self._evaluate)
            or len(self._of) > _FEW_TESTS * self._tests_at_first
        ):
            return bool(self._early)
        for environment in self.environments:
            if environment.level is not None:
                continue
            levels = environment.prospects()[1] - {0}
            for level in sorted(levels - environment.early.keys()) if len(levels) <= _FEW_LEVELS else ():
                episodes = [self._episode(environment, level, seed, "eval") for seed in self.seeds]
                environment.early[level] = dict.fromkeys(episodes)
                self._of.update(dict.fromkeys(episodes, environment))
                self._early.extend(episodes)
        return bool(self._early)

    def _at_work(self, early: dict[Episode, Record | None]) -> dict[Episode, Record | None]:
        """Those of some early episodes that have begun; the others are forgotten."""
        waiting = set(self._early).intersection(early)
        if waiting:
            self._early = deque(e for e in self._early if e not in waiting)
        for episode in early:
            self._of.pop(episode, None)
        return {episode: record for episode, record in early.items() if episode not in waiting}

    def _episode(self, environment: Environment, level: int, seed: int, stage: str) -> Episode:
        names = [g.name for g in self.suite.goals]
        goals = tuple(n for n in names if (n == TARGET) == (stage == "search"))
        return Episode(
            terrain=environment.terrain,
            level=level,
            friction=environment.friction,
            payload=environment.payload,
            seed=seed,
            stage=stage,
            goals=goals,
        )


def make_environments(
    suite: Suite,
    *,
    terrains: Sequence[str],
    frictions: Sequence[float] | None,
    payloads: Sequence[float] | None,
    level: int | None,
) -> list[Environment]:
    """The environments of a run: terrain by terrain, payload by payload, friction by friction.

    Args:
        suite: the rules.
        terrains: terrain names.
        frictions: None for the suite's. Without payloads they are played at the nominal one where the suite does not cross both.
        payloads: None for the suite's. Without frictions they are played as the suite does: a payload other than the nominal one
            at the nominal friction only, unless it crosses both.
        level: the level to play at; None to search for it.

    Raises:
        SuiteError: a level outside the suite's.
    """
    matrix = suite.matrix
    if level is not None and not 1 <= level <= suite.scoring.levels:
        raise SuiteError(f"level {level} does not exist; choose 1 to {suite.scoring.levels}")
    pairs = [
        (f, p) for p in dict.fromkeys(payloads or matrix.payloads) for f in dict.fromkeys(frictions or matrix.frictions)
    ]
    if not matrix.crossed and frictions is None:
        pairs = [(f, p) for f, p in pairs if p == matrix.nominal_payload or f == matrix.nominal_friction]
    elif not matrix.crossed and payloads is None:
        pairs = [(f, p) for f, p in pairs if p == matrix.nominal_payload]
    found = []
    for terrain in terrains:
        flat = terrain == "flat"
        for friction, payload in pairs:
            found.append(
                Environment(
                    terrain=terrain,
                    friction=friction,
                    payload=payload,
                    level=0 if flat else level,
                    searched=not flat and level is None,
                )
            )
    return found
