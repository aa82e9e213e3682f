"""Episodes in pieces that can be played side by side, and how their outcomes make up what playing them in a row would give.

Every sub-command of a velocity goal begins with a reset to the spawn, so that an episode falls into independent segments. What
one of them does to another in a row (a fall ends its goal, a penetration starts the goal again) is decided here, afterwards.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..episodes import Episode, Record
from ..goals import SUB_COMMANDS, TARGET, Schedule, count_sub_commands
from ..suite import Suite


def count_segments(episode: Episode, suite: Suite | None = None) -> int:
    """Return the number of segments that can be played side by side at first; without the suite, its own goals count as one each."""
    if suite is not None:
        return sum(count_sub_commands(suite, goal) for goal in episode.goals)
    return sum(len(SUB_COMMANDS[goal]) if goal in SUB_COMMANDS else 1 for goal in episode.goals)


@dataclass(frozen=True, kw_only=True, eq=False)
class Segment:
    """One sub-command of a velocity goal, or a target goal as a whole; equal to itself alone, which makes looking it up cheap."""

    episode: Episode
    goal: str
    goal_index: int
    """Place of the goal in the order in which the episode plays them."""
    sub_command: int
    again: bool = False
    """True after the episode's one penetration that counts."""


@dataclass(frozen=True, kw_only=True)
class SegmentOutcome:
    """The outcome of a segment, or of its beginning."""

    samples: NDArray[np.float32]
    """(T, columns)."""
    touching: NDArray[np.bool_]
    """True for samples in which parts of the robot touch each other, (T,)."""
    control_steps: int
    physics_steps: int
    falls: int = 0
    diverged: bool = False
    overflowed: bool = False
    reached: bool = False
    """True if the target was reached."""
    restarted: bool = False
    """True if a penetration made a target goal start again."""
    until_penetration: SegmentOutcome | None = None
    """The outcome of a velocity segment up to its first penetration, if one matters; the segment itself ran on."""


class AtWork(NamedTuple):
    """How far an episode is."""

    steps: int
    """Control steps so far, added up over its segments."""
    parts: int
    """Segments at work or waiting; others may follow."""
    spent: int
    """Control steps of those at work."""
    youngest: int
    """Control steps of the one that has taken the fewest."""


class SegmentRules:
    """The rules of a suite about segments."""

    def __init__(self, suite: Suite, schedule: Schedule) -> None:
        self.sub_commands = {name: len(commands) for name, commands in schedule.sub_commands.items()}
        self.fall_closes_goal = suite.events.fall == "close-goal"
        self.restarts = suite.events.penetration is not None
        settling = math.floor(suite.settling.longest / suite.physics.control_period) + 3
        longest = max((len(steps) for commands in schedule.sub_commands.values() for steps in commands), default=0)
        self.stretch = settling + longest
        """Control steps that no segment of a velocity goal exceeds: each has so much of its episode's noise."""
        crossing = max(schedule.target_steps.values(), default=0) + 2 * settling
        self._target_steps = crossing * (2 if self.restarts else 1)

    def most_steps(self, segment: Segment) -> int:
        """Return the control steps that the segment does not exceed."""
        return self._target_steps if segment.goal == TARGET else self.stretch

    def goals(self, episode: Episode) -> list[str]:
        """Return the goals of an episode in the order in which it plays them."""
        return [name for name in self.sub_commands if name in episode.goals]

    def noise_start(self, segment: Segment) -> int:
        """Return the beginning of a segment in its episode's noise, in control steps: no two segments share a draw.

        First come the velocity goals' sub-commands in order, then their second attempts, then the target goal.
        """
        goals = [name for name in self.goals(segment.episode) if name != TARGET]
        total = sum(self.sub_commands[name] for name in goals)
        if segment.goal == TARGET:
            return 2 * total * self.stretch
        before = sum(self.sub_commands[name] for name in goals[: goals.index(segment.goal)])
        return (before + segment.sub_command + (total if segment.again else 0)) * self.stretch

    def segments(self, episode: Episode, goal_index: int, *, again: bool) -> list[Segment]:
        """Return all segments of one goal of an episode."""
        name = self.goals(episode)[goal_index]
        return [
            Segment(episode=episode, goal=name, goal_index=goal_index, sub_command=number, again=again)
            for number in range(self.sub_commands[name])
        ]


@dataclass
class OpenEpisode:
    """An episode with segments that are still to be played."""

    episode: Episode
    rules: SegmentRules
    number: int = 0
    """Number of episodes that began before it."""
    outcomes: dict[Segment, SegmentOutcome] = field(default_factory=dict)
    started: set[Segment] = field(default_factory=set)
    """Segments that have been handed out."""
    _made: dict[tuple[int, bool], list[Segment]] = field(default_factory=dict)

    def missing(self) -> set[Segment]:
        """Return segments that are needed as far as is known, and have not ended."""
        return set(self._follow()[1])

    def start(self) -> list[Segment]:
        """Hand out the needed segments that have not been handed out yet."""
        found = [s for s in self._follow()[1] if s not in self.started]
        self.started.update(found)
        return found

    def _follow(self) -> tuple[list[tuple[Segment, SegmentOutcome]], list[Segment], bool]:
        """Go through the episode in order, as far as outcomes are known.

        Returns:
            What counts, complete only if nothing is missing; the segments that are missing; whether a goal was begun again.
        """
        counted: list[tuple[Segment, SegmentOutcome]] = []
        missing: list[Segment] = []
        restarted = False
        for index, goal in enumerate(self.rules.goals(self.episode)):
            if goal == TARGET and missing:
                continue  # whether a penetration still matters to it depends on what comes before
            lies_behind = goal == TARGET and restarted
            sure = not missing
            some, absent = self._play(self._segments(index, again=lies_behind), sure and not restarted)
            counted += some
            missing += absent
            if sure and not absent and not restarted and some[-1][1].restarted:
                restarted = True
                if goal != TARGET:
                    some, absent = self._play(self._segments(index, again=True), False)
                    counted += some
                    missing += absent
        return counted, missing, restarted

    def _segments(self, goal_index: int, *, again: bool) -> list[Segment]:
        """Return the segments of one goal, the same ones every time."""
        if (goal_index, again) not in self._made:
            self._made[goal_index, again] = self.rules.segments(self.episode, goal_index, again=again)
        return self._made[goal_index, again]

    def _play(
        self, segments: Sequence[Segment], watched: bool
    ) -> tuple[list[tuple[Segment, SegmentOutcome]], list[Segment]]:
        """Return the segments of a goal that count, up to the one that ends the attempt, and those that are missing for that.

        ``watched`` says whether it is certain that a penetration interrupts the goal.
        """
        counted, absent = [], []
        for segment in segments:
            outcome = self.outcomes.get(segment)
            if outcome is None:
                absent.append(segment)
                continue
            cut = outcome.until_penetration if watched else None
            counted.append((segment, cut or outcome))
            if cut is not None or (outcome.falls and self.rules.fall_closes_goal):
                break
        return counted, absent

    def record(self, columns: tuple[str, ...]) -> Record:
        """Return the episode's record; nothing may be missing."""
        counted, missing, restarted = self._follow()
        assert not missing
        outcomes = [outcome for _, outcome in counted]
        lengths = [len(outcome.samples) for outcome in outcomes]

        def index(values: list[int]) -> NDArray[np.int16]:
            return np.repeat(np.asarray(values, dtype=np.int16), lengths)

        has_samples = sum(lengths) > 0
        has_target = TARGET in self.episode.goals
        return Record(
            episode=self.episode,
            success=any(o.reached for o in outcomes) if has_target else None,
            falls=sum(o.falls for o in outcomes),
            fallen=tuple((s.goal_index, s.sub_command) for s, o in counted for _ in range(o.falls)),
            diverged=any(o.diverged for o in outcomes),
            overflowed=any(o.overflowed for o in outcomes),
            restarted=restarted,
            control_steps=sum(o.control_steps for o in outcomes),
            physics_steps=sum(o.physics_steps for o in outcomes),
            columns=columns if has_samples else (),
            samples=np.concatenate([o.samples for o in outcomes]),
            touching=np.concatenate([o.touching for o in outcomes]),
            goal_index=index([s.goal_index for s, _ in counted]),
            part_index=index([s.sub_command for s, _ in counted]),
        )


class SegmentQueue:
    """Segments that wait for a world, and the episodes that they belong to."""

    def __init__(self, rules: SegmentRules, columns: tuple[str, ...]) -> None:
        """Prepare an empty queue; ``columns`` are those of the samples."""
        self._rules, self._columns = rules, columns
        self._open: dict[Episode, OpenEpisode] = {}
        self._begun = 0
        self._waiting: deque[Segment] = deque()

    def __len__(self) -> int:
        """Return the number of segments that wait."""
        return len(self._waiting)

    def add(self, episodes: Sequence[Episode]) -> None:
        """Let episodes begin: level tests, on which others wait, before all that waits, the others behind it."""
        tests = [e for e in episodes if e.stage == "search"]
        for episode in reversed(tests):
            self._waiting.extendleft(reversed(self._begin(episode)))
        for episode in episodes:
            if episode.stage != "search":
                self._waiting.extend(self._begin(episode))

    def waiting(self) -> dict[Episode, int]:
        """Return the number of segments that wait, by episode."""
        return Counter(segment.episode for segment in self._waiting)

    def take(self, most: int) -> list[Segment]:
        """Return up to ``most`` segments to play now."""
        return [self._waiting.popleft() for _ in range(min(most, len(self._waiting)))]

    def _begin(self, episode: Episode) -> list[Segment]:
        opened = self._open[episode] = OpenEpisode(episode, self._rules, self._begun)
        self._begun += 1
        return opened.start()

    def finish(self, outcomes: Mapping[Segment, SegmentOutcome]) -> tuple[list[Record], set[Segment]]:
        """Take the outcomes of segments.

        Returns:
            Records of the episodes that are complete with them, in the order in which they began, and segments that may still be
            at work although nothing in the record will come of them.
        """
        touched: dict[int, OpenEpisode] = {}
        records, hidden = [], set()
        for segment, outcome in outcomes.items():
            opened = self._open[segment.episode]
            opened.outcomes[segment] = outcome
            touched[opened.number] = opened
        for _, opened in sorted(touched.items()):
            self._waiting.extendleft(reversed(opened.start()))
            needed = opened.missing()
            hidden |= opened.started - needed - opened.outcomes.keys()
            if not needed:
                records.append(opened.record(self._columns))
                del self._open[opened.episode]
        if hidden:
            self._waiting = deque(s for s in self._waiting if s not in hidden)
        return records, hidden

    def drop(self, episodes: Collection[Episode]) -> None:
        """Forget cancelled episodes."""
        for episode in episodes:
            self._open.pop(episode, None)
        self._waiting = deque(s for s in self._waiting if s.episode not in episodes)

    def steps_behind(self, episode: Episode) -> int:
        """Return the control steps of an open episode's segments that have ended."""
        return sum(outcome.control_steps for outcome in self._open[episode].outcomes.values())
