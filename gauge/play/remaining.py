"""Estimate how long work still takes. Nothing here reads a clock, so that tests replay recorded timelines.

``Pace`` learns what control steps cost, from workers' counters. ``Stages`` adds up parts of unequal cost, each by its own pace.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

_SAMPLE = 0.5
"""Time of a worker that makes one sample [s]."""
_TRUST = 6.0
"""Weight of the cost that was expected, in samples of one second."""
_MEMORY = 60.0
"""Worker time after which a sample counts by 1/e: other programs come and go [s]."""
_LEAST_KNOWN = 0.3
"""Worker time from which on a pace is known [s]."""
_EARLY = 0.05
"""Weight of a stage's expected cost, as a share of all stages' cost, against what stages took."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """Control steps that one worker takes."""

    loops: float = 0.0
    """Control steps in a row, each of all worlds at work."""
    world_steps: float = 0.0
    """Control steps added up over worlds."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """The cost of control steps in one worker."""

    loop: float
    """Time of a control step however many worlds are at work [s]."""
    world: float
    """Further time for each world at work [s]."""
    start: float = 0.0
    """Time until the first control step: a start of processes, a compilation [s]."""

    def seconds(self, work: Work) -> float:
        """Return the time of some work, the start not included [s]."""
        return self.loop * work.loops + self.world * work.world_steps


CPU_COST = Cost(loop=3e-3, world=1.5e-3, start=1.0)
"""MuJoCo's cost on one core of a server of 2022, a prior that measured steps replace."""
GPU_COST = Cost(loop=8e-3, world=5e-7, start=10.0)
"""The cost of a Warp engine on a GPU: a prior, too."""


class Pace:
    """Learns the cost of control steps from the counters of workers (ridge regression towards the expected cost)."""

    def __init__(self, expected: Cost) -> None:
        """Begin with the ``expected`` cost; its scale is learned at once, the ratio of its parts as worlds vary."""
        self._expected = expected
        self._before = (0.0, Work())
        self._sums = [[0.0, 0.0], [0.0, 0.0]]
        self._right = [0.0, 0.0]
        self._taken = self._planned = 0.0
        self.seconds_seen = 0.0

    def see(self, seconds: float, work: Work) -> None:
        """Take the counters of all workers since they began: time in the control loop [s], and control steps."""
        before_seconds, before = self._before
        taken = seconds - before_seconds
        if taken < _SAMPLE:
            return
        self._before = (seconds, work)
        self.seconds_seen += taken
        loops, worlds = max(work.loops - before.loops, 0.0), max(work.world_steps - before.world_steps, 0.0)
        row = (self._expected.loop * loops, self._expected.world * worlds)
        fade = math.exp(-taken / _MEMORY)
        self._taken = fade * self._taken + taken
        self._planned = fade * self._planned + sum(row)
        for i in range(2):
            self._right[i] = fade * self._right[i] + row[i]
            for j in range(2):
                self._sums[i][j] = fade * self._sums[i][j] + row[i] * row[j] / taken

    @property
    def known(self) -> bool:
        """Return whether steps were seen; before, the cost is the expected one."""
        return self.seconds_seen >= _LEAST_KNOWN and self._planned > 0.0

    @property
    def scale(self) -> float:
        """Return the time taken over the time expected: above 1 on a slower or a busy machine."""
        return self._taken / self._planned if self.known else 1.0

    @property
    def cost(self) -> Cost:
        """Return the cost as far as it is known."""
        scale, expected = self.scale, self._expected
        if not self.known:
            return expected
        # min sum (taken - a row_0 - b row_1)^2 / taken + trust (a - scale)^2 + …, in units of the scale
        (p, q), (_, r) = self._sums
        p, q, r = (scale * scale * v for v in (p, q, r))
        s, t = (scale * v for v in self._right)
        weight = min(self._taken, _TRUST)
        a, b, c = p + weight, q, r + weight
        u, v = s + weight, t + weight
        determinant = a * c - b * b
        loops, worlds = (
            ((u * c - v * b) / determinant, (a * v - b * u) / determinant) if determinant > 0.0 else (1.0, 1.0)
        )
        return Cost(
            loop=expected.loop * scale * max(loops, 0.05),
            world=expected.world * scale * max(worlds, 0.05),
            start=expected.start,
        )

    def seconds(self, work: Work) -> float:
        """Return the time that some work takes [s]."""
        return self.cost.seconds(work)


@dataclass(frozen=True)
class Stage:
    """A part of a command's work."""

    name: str
    cost: float
    """Expected time, or work in any unit that all stages share."""
    kind: str = ""
    """Stages of one kind, such as one engine's, are off by the same factor."""


@dataclass
class Stages:
    """Estimates the rest of several stages, one after another, from what those before took."""

    stages: Sequence[Stage]
    in_seconds: bool = True
    """True if costs are times [s]; otherwise nothing is estimated before the first work is done."""
    _taken: dict[str, float] = field(default_factory=dict)
    _planned: dict[str, float] = field(default_factory=dict)
    _now: int = -1
    _began: float = 0.0

    def begin(self, number: int, now: float) -> None:
        """Begin the stage of that number; ``now`` is the time by any clock [s]."""
        self._now, self._began = number, now

    def end(self, now: float, *, counts: bool = True) -> None:
        """End the stage at work; one that had nothing to do does not count."""
        stage = self.stages[self._now]
        if counts:
            self._taken[stage.kind] = self._taken.get(stage.kind, 0.0) + now - self._began
            self._planned[stage.kind] = self._planned.get(stage.kind, 0.0) + stage.cost
        self._now += 1
        self._began = now

    def left(self, now: float, share: float = 0.0, own: float | None = None) -> float | None:
        """Return the estimated rest of all stages [s]; None while nothing tells.

        Args:
            share: of the stage at work that is done, 0 to 1.
            own: the rest of the stage at work where it has an estimate of its own [s].
        """
        if self._now >= len(self.stages):
            return 0.0
        stage = self.stages[max(self._now, 0)]
        spent = now - self._began if self._now >= 0 else 0.0
        taken, planned = dict(self._taken), dict(self._planned)
        so_far, whole = spent, stage.cost * share
        if own is not None and spent + own > 0.0:
            so_far, whole = spent + own, stage.cost  # as if it had ended as it expects
        if whole > 0.0:
            taken[stage.kind] = taken.get(stage.kind, 0.0) + so_far
            planned[stage.kind] = planned.get(stage.kind, 0.0) + whole
        total = sum(s.cost for s in self.stages)
        if not self.in_seconds and sum(planned.values()) < 0.02 * total:
            return None
        factors = _factors(taken, planned, _EARLY * total if self.in_seconds else 0.0)
        every = factors[None]
        here = factors.get(stage.kind, every)
        rest = (
            own
            if own is not None
            else max(here * stage.cost - spent if share <= 0.0 else here * stage.cost * (1 - share), 0.0)
        )
        return rest + sum(factors.get(s.kind, every) * s.cost for s in self.stages[max(self._now, 0) + 1 :])

    @property
    def share(self) -> float:
        """Return the share of the expected work in stages that have ended."""
        total = sum(s.cost for s in self.stages)
        return sum(s.cost for s in self.stages[: max(self._now, 0)]) / total if total else 1.0


def _factors(taken: Mapping[str, float], planned: Mapping[str, float], prior: float) -> dict[str | None, float]:
    """Return the time taken over the one expected by kind, drawn to that of all kinds (key None), which is drawn to 1."""
    every = (sum(taken.values()) + prior) / (sum(planned.values()) + prior)
    found: dict[str | None, float] = {None: every}
    weight = prior or 0.1 * sum(planned.values())
    return found | {k: (taken[k] + weight * every) / (planned[k] + weight) for k in taken}
