"""Tell how far a study of several turns is, and how long the rest takes: turns of unequal cost, one after another."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ..gauge.play.progress import Status
from ..gauge.play.remaining import Stage, Stages

_INTERVAL = 0.2
"""Shortest time between two calls of ``watch`` within a turn [s]."""


@dataclass(frozen=True, kw_only=True)
class Turn:
    """Progress of a study, for the display."""

    number: int
    """Number of the turn, from 1."""
    count: int
    what: str
    share: float
    """Share of the study's time that is over, 0 to 1."""
    seconds_left: float | None
    """None while too little has been done to say."""


Watch = Callable[[Turn], None]


class EvaluationTurns:
    """Adds to the remaining time of an evaluation that of those that follow it: each is taken for as long as those before."""

    def __init__(
        self,
        watch: Callable[[Status], None] | None,
        count: int,
        *,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Prepare; ``count``: number of evaluations."""
        self._watch, self._clock, self._began = watch, clock, clock()
        self._stages = Stages([Stage("", 1.0)] * count, in_seconds=False)
        self._number, self._played = -1, False

    def begin(self) -> Callable[[Status], None] | None:
        """Begin the next evaluation; return what it calls with its progress."""
        if self._number >= 0:
            self._stages.end(self._clock(), counts=self._played)
        self._number, self._played = self._number + 1, False
        self._stages.begin(self._number, self._clock())
        return None if self._watch is None else self._look

    def _look(self, status: Status) -> None:
        assert self._watch is not None
        self._played = True
        now, own = self._clock(), status.seconds_left
        left = None if own is None else self._stages.left(now, own=own)
        whole = now - self._began + (left or 0.0)
        share = 1.0 if left is None or whole <= 0.0 else left / whole
        self._watch(replace(status, seconds_left=left, remaining_work=share))


class Turns:
    """Calls ``watch`` at the beginning of each turn and a few times a second within."""

    def __init__(
        self, watch: Watch, stages: Sequence[Stage], *, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        """Prepare; ``stages`` have costs in one unit."""
        self._watch, self._clock = watch, clock
        self._stages = Stages(stages, in_seconds=False)
        self._count, self._number, self._what = len(stages), 0, ""
        self._began = self._told = clock()

    def begin(self, what: str) -> None:
        """Begin the next turn; the one before has ended."""
        now = self._clock()
        if self._number:
            self._stages.end(now)
        self._stages.begin(self._number, now)
        self._number, self._what = self._number + 1, what
        self._tell(now, 0.0)

    def step(self, share: float) -> None:
        """Tell which share of the turn is done."""
        now = self._clock()
        if now - self._told >= _INTERVAL:
            self._tell(now, share)

    def _tell(self, now: float, share: float) -> None:
        self._told = now
        left, spent = self._stages.left(now, share), now - self._began
        self._watch(
            Turn(
                number=self._number,
                count=self._count,
                what=self._what,
                share=0.0 if left is None or spent + left <= 0.0 else spent / (spent + left),
                seconds_left=left,
            )
        )
