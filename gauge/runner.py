"""Runs the episodes of an agenda in lock step on any backend: the loop of gauge protocol §3.3, vectorized over worlds.

A world is a slot. Segments of episodes sit in the slots; when one ends, the next moves in, with its own terrain, friction and
payload. What happens in a segment depends on that segment alone: not on its slot, its neighbours, the number of threads, or
how often somebody looks.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import torch

from ..backends.base import PhysicsBackend
from ..policy.base import Policy, PolicyError
from .episodes import QUALITY, Episode, Record
from .goals import TARGET
from .sampling import Samples
from .seats import Figures
from .segments import Agenda, Outcome, Segment, SegmentQueue, cut_short
from .slots import Slots
from .suite import Suite

LOOK_INTERVAL = 10
"""Control steps between two looks at a GPU. A look waits for the device and moves robots with one more physics step of all
worlds; until it comes, a segment that has ended keeps its world for some steps. Ten make either a small part of the time."""


class Progress:
    """How far the runner is; handed to the ``watch`` callback at every look, and good until it returns."""

    def __init__(self, runner: EpisodeRunner) -> None:
        self._runner = runner

    @property
    def control_steps(self) -> int:
        """Control steps so far, each of all worlds."""
        return self._runner.control_steps

    @property
    def physics_steps(self) -> int:
        """Physics steps so far, added up over worlds."""
        return self._runner.physics_steps

    def active(self) -> dict[Episode, int]:
        """Episodes at work, and the control steps that each has behind it, added up over its segments."""
        return self._runner.ages()


class EpisodeRunner:
    """Plays the episodes of an agenda on one backend."""

    def __init__(
        self,
        suite: Suite,
        policy: Policy,
        backend: PhysicsBackend,
        terrain_index: Callable[[Episode], int],
        *,
        look_interval: int | None = None,
        capture: bool = True,
    ) -> None:
        """Prepare the slots, one for each of the backend's worlds.

        Args:
            suite: the rules.
            policy: what is judged.
            backend: worlds to play in; its scene's palette holds every terrain that an episode asks for.
            terrain_index: the palette index of an episode's terrain.
            look_interval: control steps between two looks at the data; None for a look whenever one is useful on the CPU,
                and for every ``LOOK_INTERVAL`` steps on a GPU. Changes the time alone.
            capture: whether to record what surrounds the physics as CUDA graphs, on a GPU. Changes the time alone.
        """
        self.suite, self.backend = suite, backend
        self._terrain_index = terrain_index
        self._at_once = look_interval is None and backend.device.type == "cpu"
        self._look_interval = 1 if self._at_once else look_interval or LOOK_INTERVAL
        self._slots = Slots(suite, policy, backend, looks=self._at_once, capture=capture)
        self.columns = (*self._slots.metrics, QUALITY)
        self._queue = SegmentQueue(self._slots.rules, self.columns)
        self._segment: list[Segment | None] = [None] * backend.num_worlds
        self._free = list(range(backend.num_worlds))
        self._seated_at = [0] * backend.num_worlds
        self._targets = 0  # segments in the slots that aim at a target
        self._complete: list[Record] = []  # episodes of which the agenda has not heard yet
        self.control_steps = 0

    @property
    def physics_steps(self) -> int:
        """Physics steps up to the last look, added up over worlds."""
        return self._slots.physics_steps

    def run(
        self,
        agenda: Agenda,
        watch: Callable[[Progress], None] | None = None,
        needless: Callable[[], Collection[Episode]] = tuple,
    ) -> None:
        """Play until the agenda has nothing left.

        Args:
            agenda: what to play.
            watch: called at every look.
            needless: asked at every look for episodes at work that nobody needs any more.

        Raises:
            PolicyError: the policy's output is not finite.
        """
        with torch.inference_mode():
            while self._fill(agenda):
                self._slots.advance(self._look_interval)
                self.control_steps += self._look_interval
                if self._at_once:
                    self._look()
                    self._report(agenda, watch)
                    self._drop(needless())
                else:  # a GPU is at work by now: files are written and searches folded meanwhile
                    self._report(agenda, watch)
                    self._drop(needless())
                    self._look()

    def ages(self) -> dict[Episode, int]:
        """Episodes with segments in the slots, and the control steps played of each, ended segments included."""
        ages: dict[Episode, int] = {}
        for segment, begun in zip(self._segment, self._seated_at, strict=True):
            if segment is not None:
                ages[segment.episode] = ages.get(segment.episode, 0) + self.control_steps - begun
        return {episode: age + self._queue.steps_behind(episode) for episode, age in ages.items()}

    def _fill(self, agenda: Agenda) -> bool:
        """Let segments begin in the free slots; returns whether any are at work."""
        if len(self._free) == len(self._segment):
            self._report(agenda)  # nobody is at work meanwhile, and more may follow
        if self._free:
            segments = self._queue.take(agenda, len(self._free))
            if segments:
                slots, self._free = self._free[: len(segments)], self._free[len(segments) :]
                self._slots.seat(slots, segments, [self._terrain_index(s.episode) for s in segments])
                for slot, segment in zip(slots, segments, strict=True):
                    self._segment[slot] = segment
                    self._seated_at[slot] = self.control_steps
                    self._targets += segment.goal == TARGET
        self._slots.begin(targets=self._targets > 0)
        return len(self._free) < len(self._segment)

    def _look(self) -> None:
        """See what has ended, and take it out of the slots."""
        found = self._slots.look()
        for slot in found.not_finite:
            segment = self._segment[slot]
            if segment is not None:
                value, step = self._slots.blame(slot)
                raise PolicyError(
                    f"the policy returned {value} for a finite observation at control step {step} of {segment.goal}, part "
                    f"{segment.part + 1}, of episode {segment.episode.key}; a policy must return finite numbers"
                )
        if not found.ended:
            return
        outcomes = {}
        for slot, (figures, samples) in zip(found.ended, self._slots.figures(found.ended), strict=True):
            segment = self._segment[slot]
            assert segment is not None
            outcomes[segment] = self._outcome(segment, figures, samples)
        records, hidden = self._queue.finish(outcomes)
        self._complete += records
        self._leave([slot for slot, segment in enumerate(self._segment) if segment in outcomes or segment in hidden])

    def _report(self, agenda: Agenda, watch: Callable[[Progress], None] | None = None) -> None:
        """Hand complete episodes to the agenda, drop what it does not need any more, and tell how far the runner is."""
        needless: set[Episode] = set()
        for record in self._complete:
            needless.update(agenda.finished(record))
        self._complete.clear()
        self._drop(needless)
        if watch is not None:
            watch(Progress(self))

    def _drop(self, needless: Collection[Episode]) -> None:
        """Leave what nobody needs any more."""
        if needless:
            self._queue.drop(needless)
            seated = enumerate(self._segment)
            self._leave([slot for slot, segment in seated if segment is not None and segment.episode in needless])

    def _leave(self, slots: list[int]) -> None:
        """Free slots."""
        for slot in slots:
            segment = self._segment[slot]
            self._targets -= segment is not None and segment.goal == TARGET
            self._segment[slot] = None
        self._slots.leave(slots)
        self._free = sorted(self._free + slots)

    def _outcome(self, segment: Segment, figures: Figures, sampled: Samples | None) -> Outcome:
        """What came of a segment that has ended."""
        samples = np.zeros((figures.lost, len(self.columns)), dtype=np.float32)
        keep = np.zeros(0, dtype=np.bool_)
        if sampled is not None:
            values, keep = sampled
            samples = np.concatenate((values[keep], samples))
        aims = segment.goal == TARGET
        outcome = Outcome(
            samples=samples,
            control_steps=figures.control_steps,
            physics_steps=figures.physics_steps,
            falls=figures.falls,
            diverged=figures.diverged,
            overflowed=figures.overflowed,
            reached=figures.reached,
            restarted=figures.deep and aims,
        )
        if not figures.deep or aims:
            return outcome
        beginning = cut_short(
            outcome,
            samples=int(keep[: figures.deep_samples].sum()),
            control_steps=figures.deep_control_steps,
            physics_steps=figures.deep_physics_steps,
            overflowed=figures.deep_overflowed,
        )
        return replace(outcome, until_penetration=beginning)
