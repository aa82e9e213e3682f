"""Progress of an evaluation: episodes that have ended, and how long the rest will take, for the progress display.

Three things decide how long the rest takes, and all are counted in control steps: the work of all worlds, the longest chain of
episodes that wait for each other (a level's test comes before the next one, quality last), and the work of one worker alone.
``remaining.Pace`` turns them into time. What episodes usually take is learned from those that have ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from ..episodes import Episode, Record
from ..goals import TARGET, count_sub_commands
from ..plan import Plan
from ..result import FLAT
from ..suite import Suite
from .remaining import CPU_COST, Cost, Pace, Work
from .segments import AtWork

_WATCH_INTERVAL = 0.2
"""Shortest time between two calls of ``watch`` [s]."""
_SEARCHES = {"bisection": (4.3, 1.0, 1.0), "curve": (5.2, 1.9, 0.75), "area": (2.0, 1.95, 1.0)}
"""Of a usual search: rounds of tests, one after another; levels at which quality is evaluated; tests that are played over those that
the plan takes for likely."""
_FORMER = 2.0
"""Weight of what was expected, in episodes or searches."""
_EASY = 8.0
"""The same for level tests: the first ones are of easy levels and short, those at the end of a search take longer."""
_AGAIN = 1.2
"""Length of a quality episode over the usual one where a penetration begins a goal again."""
_SETTLING = 0.1
"""Share of the time up to its limit that the longest segment of an episode takes on beyond the usual length."""
_SLOWEST = 0.6
"""The same for the slowest of many episodes that are played side by side, beyond that of one."""
_UNEVEN = 1.1
"""Time of a search over that of its tests played without a wait."""
_OVERTIME = 0.35
"""Share of the time up to its limit that an episode is expected to take on beyond its usual length."""


@dataclass(frozen=True, kw_only=True)
class Status:
    """Progress of an evaluation, for the display."""

    done: int
    """Counted episodes that have ended, those of an earlier run included."""
    expected: int
    """Episodes expected in all, those of searches that are still open by their probability."""
    active: tuple[Episode, ...]
    """Episodes at work."""
    seconds: float
    """Time since the evaluation began, or was gone on with [s]."""
    seconds_left: float | None
    """Estimated time until its end [s]; None while too little has been done to say."""
    remaining_work: float
    """Estimated share of the time that is left, 0 to 1."""


class Playing(Protocol):
    """Counters that the meter reads; ``Dispatcher`` has them."""

    plans: list[Plan]

    @property
    def records(self) -> Mapping[Episode, Record]:
        """Return the episodes that have ended."""

    @property
    def workers(self) -> int:
        """Return the number of workers."""

    @property
    def worlds(self) -> int:
        """Return the worlds of each."""

    @property
    def busy_seconds(self) -> float:
        """Return the time of all workers in their control loops [s]."""

    @property
    def work(self) -> Work:
        """Return the control steps of all workers."""

    def active(self) -> dict[Episode, AtWork]:
        """Return the episodes at work."""


class Length(NamedTuple):
    """Usual length of an episode in control steps."""

    parts: int
    """Segments, which are played side by side."""
    steps: float
    """Of one of them."""
    longest: float
    """Of the longest of them."""
    limit: float
    """That none of them exceeds."""


class Lengths:
    """Usual lengths of episodes: from the suite at first, then from episodes that have ended on the same terrain and on others."""

    def __init__(self, suite: Suite) -> None:
        self._suite, self._known = suite, dict[tuple[str, ...], Length]()
        self.seen: set[Episode] = set()
        self._ratios: dict[tuple[str, str | None], tuple[float, int]] = {}

    def see(self, records: Mapping[Episode, Record]) -> None:
        """Learn from the episodes that have ended, each once."""
        for episode, record in records.items():
            if episode not in self.seen:
                self.seen.add(episode)
                self.learn(episode, record.control_steps)

    def learn(self, episode: Episode, steps: float) -> None:
        """Learn from one that took so many control steps."""
        ratio = steps / self.usual(episode)
        for key in ((episode.stage, None), (episode.stage, episode.terrain)):
            total, count = self._ratios.get(key, (0.0, 0))
            self._ratios[key] = (total + ratio, count + 1)

    def usual(self, episode: Episode) -> float:
        """Return the control steps of an episode by the suite alone, added up over its segments."""
        length = self._length(episode.goals)
        return length.parts * length.steps

    def of(self, episode: Episode) -> Length:
        """Return the length to expect."""
        length = self._length(episode.goals)
        begins_again = (
            episode.stage == "eval" and self._suite.events.penetration is not None and episode.terrain != FLAT
        )
        ratio = _AGAIN if begins_again else 1.0
        weight = _EASY if episode.stage == "search" else _FORMER
        for key in ((episode.stage, None), (episode.stage, episode.terrain)):
            total, count = self._ratios.get(key, (0.0, 0))
            ratio = (weight * ratio + total) / (weight + count)
        longest = ratio * length.longest
        if episode.stage == "eval":  # of several segments, one settles for longer
            longest += _SETTLING * max(length.limit - longest, 0.0)
        return length._replace(steps=ratio * length.steps, longest=longest)

    def _length(self, goals: tuple[str, ...]) -> Length:
        if goals not in self._known:
            suite, period = self._suite, self._suite.physics.control_period
            slowest = max(suite.commands.target_time.values(), default=25.0)
            crossing = 0.4 * slowest  # a target is reached, or missed, in part of the time that it may take
            mine = [g for g in suite.goals if g.name in goals]
            times = [
                sum([p.seconds for p in g.sub_commands[part]] if g.sub_commands else g.phases or (crossing,))
                + suite.settling.shortest
                for g in mine
                for part in range(count_sub_commands(suite, g.name))
            ]
            limit = slowest if TARGET in goals else max(times, default=0.0)
            steps = [t / period for t in times] or [1.0]
            self._known[goals] = Length(
                parts=len(steps),
                steps=sum(steps) / len(steps),
                longest=max(steps),
                limit=(limit + suite.settling.longest) / period,
            )
        return self._known[goals]


class ProgressMeter:
    """Estimates what is left from plans, from the episodes at work, and from those that have ended."""

    def __init__(self, suite: Suite, began: float, expected: Cost = CPU_COST, lengths: Lengths | None = None) -> None:
        """Begin.

        Args:
            began: value of ``time.perf_counter()`` when the evaluation began.
            expected: cost of control steps before any were seen.
            lengths: of episodes, where others were played before.
        """
        self.lengths = lengths or Lengths(suite)
        self.pace = Pace(expected)
        self._suite, self._began = suite, began
        self._rounds, self._levels, self._kept = _SEARCHES[suite.scoring.level]

    def look(self, playing: Playing, now: float | None = None) -> Status:
        """Return the progress of the evaluation; ``now``: value of ``time.perf_counter()``, None for the present one."""
        plans, active = playing.plans, playing.active()
        self.lengths.see(playing.records)
        self.pace.see(playing.busy_seconds, playing.work)
        done = sum(len(found.counted) - len(found.required) for found in plans)
        work, more = self.left(plans, active, playing.workers, playing.worlds)
        seconds = (time.perf_counter() if now is None else now) - self._began
        left = self.pace.seconds(work)
        if not playing.work.loops:
            left = max(left + self.pace.cost.start - seconds, 0.0)
        known = self.pace.known or not any(found.required for found in plans)
        return Status(
            done=done,
            expected=round(done + sum(len(found.required) for found in plans) + more),
            active=tuple(active),
            seconds=seconds,
            seconds_left=left if known else None,
            remaining_work=left / (seconds + left) if known and left > 0.0 else 0.0 if known else 1.0,
        )

    def left(
        self, plans: Sequence[Plan], active: Mapping[Episode, AtWork], workers: int, worlds: int
    ) -> tuple[Work, float]:
        """Return the work that the busiest worker has left, and how many episodes may be required beyond those that are.

        Args:
            worlds: of each worker.
        """
        rounds = self._usual_rounds(plans)
        total, longest, alone, more = 0.0, 0.0, 0.0, 0.0
        whole: list[float] = []  # quality episodes, of which each has one worker
        for found in plans:
            chain, mine, single = 0.0, 0.0, 0.0
            for stage in ("search", "eval"):
                each = [self._rest(e, active.get(e)) for e in found.required if e.stage == stage]
                own = [steps for _, steps in each]
                mine += sum(own)
                whole += own if stage == "eval" else []
                chain += max((loops for loops, _ in each), default=0.0)
                if stage == "eval" and own:  # the more episodes, the surer it is that one settles for long
                    length = self.lengths.of(found.required[-1])
                    chain += _SLOWEST * (1.0 - (1.0 - _SETTLING) ** (len(own) - 1)) * (length.limit - length.longest)
                # tests share a worker; each quality episode has one
                single += sum(own) if stage == "search" else max(own, default=0.0)
            possible = {e: p for e, p in found.possible.items() if e.stage == "search"}
            if possible:
                length, counted = (
                    self.lengths.of(next(iter(possible))),
                    [e for e in found.counted if e.stage == "search"],
                )
                ahead = min(max(rounds - self._played(counted), 0.5), len({e.level for e in possible}))
                tests = self._kept * sum(possible.values())
                if possible.keys() <= active.keys() | self.lengths.seen:  # all of them have begun already
                    chain = max(chain, *(self._rest(e, active[e])[0] for e in possible if e in active), 0.0)
                else:
                    chain += ahead * length.longest
                mine += tests * length.steps
                single += tests * length.steps
                more += tests
            quality = {e: p for e, p in found.possible.items() if e.stage == "eval"}
            if quality:
                each = [self._rest(e, active.get(e)) for e in quality]
                seeds, passed = len({e.seed for e in quality}), min(sum(quality.values()), 1.0)
                evaluated = min(self._levels, len({e.level for e in quality})) * seeds * passed
                steps = sum(p * s for p, (_, s) in zip(quality.values(), each, strict=True)) / sum(quality.values())
                mine += evaluated * steps
                single += passed * steps
                chain += passed * sum(loops for loops, _ in each) / len(each)
                more += evaluated
            total, longest, alone = total + mine, max(longest, chain), max(alone, single)
        alone = max(alone, sum(sorted(whole, reverse=True)[::workers]))
        uneven = _UNEVEN if any(found.possible for found in plans) else 1.0
        share, longest, alone = (uneven * v for v in (total / workers, longest, alone))
        return Work(loops=max(longest, share / worlds), world_steps=max(share, alone)), more

    def _rest(self, episode: Episode, at: AtWork | None) -> tuple[float, float]:
        """Return the control steps in a row, and of all worlds, that an episode has yet to take."""
        length = self.lengths.of(episode)
        if at is None:
            return length.longest, length.parts * length.steps
        over = 0.0
        if (
            episode.stage == "search" or at.youngest > length.longest
        ):  # robots settle for longer, or those before fell early
            over = _OVERTIME * max(length.limit - at.youngest, 0.0)
        rest = max(length.longest - at.youngest, over, 5.0)
        steps = max(
            length.parts * length.steps - at.steps,
            at.parts * length.steps - at.spent,
            at.parts * min(rest, 5.0),
            over * at.parts,
        )
        return rest, steps

    def _played(self, tests: Sequence[Episode]) -> int:
        """Return the rounds that a search has begun."""
        if self._suite.scoring.level == "area":
            return 1 if len(tests) <= self._suite.scoring.levels else 2
        return max(len({e.level for e in tests}), 1)

    def _usual_rounds(self, plans: Sequence[Plan]) -> float:
        """Return the rounds of tests that searches usually have, from those that have found their level, too."""
        rounds, weight = _FORMER * self._rounds, _FORMER
        for found in plans:
            mine = [e for e in found.counted if e.stage == "search"]
            if mine and not found.possible and not any(e.stage == "search" for e in found.required):
                rounds += self._played(mine) + (self._suite.scoring.level != "area")
                weight += 1.0
        return rounds / weight


def watcher(meter: ProgressMeter, watch: Callable[[Status], None]) -> Callable[[Playing], None]:
    """Return the function that tells ``watch`` a few times a second how far playing is."""
    next_time = 0.0

    def on_progress(playing: Playing) -> None:
        nonlocal next_time
        if time.perf_counter() >= next_time:
            watch(meter.look(playing))
            next_time = time.perf_counter() + _WATCH_INTERVAL

    return on_progress
