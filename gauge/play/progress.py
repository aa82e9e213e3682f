"""Progress of an evaluation: episodes that have ended, and how long the rest will take, for the progress display.

Work is counted in control steps that an episode usually takes: a quality episode walks for minutes, a level test for seconds, and
those of quality come last.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..episodes import Episode
from ..goals import count_sub_commands
from ..plan import Plan
from ..suite import Suite

_ENOUGH = 0.02
"""Share of the work from which on the time that is left is estimated."""
_SOONEST = 5.0
"""Time before which it is not [s]: workers start, and what is short ends first."""
_ALMOST = 0.95
"""Largest share of an episode that counts as done while it runs."""


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
    """Estimated share of the work that is left, 0 to 1."""


class ProgressMeter:
    """Estimates what is left from plans and from the episodes at work."""

    def __init__(self, suite: Suite, began: float) -> None:
        """Begin; ``began``: value of ``time.perf_counter()`` when the evaluation began."""
        # a target is reached, or missed, in part of the time that it may take
        crossing = 0.4 * max(suite.commands.target_time.values(), default=25.0)
        settling = suite.settling.shortest
        self._goal_steps = {
            g.name: sum(
                sum([p.seconds for p in g.sub_commands[part]] if g.sub_commands else g.phases or (crossing,)) + settling
                for part in range(count_sub_commands(suite, g.name))
            )
            / suite.physics.control_period
            for g in suite.goals
        }
        self._began = began
        self._open: set[Episode] = set()  # those that had not ended at some look: of an earlier run they are not

    def usual_steps(self, episode: Episode) -> float:
        """Return the control steps that an episode usually takes."""
        return sum(self._goal_steps[goal] for goal in episode.goals)

    def look(self, plans: Sequence[Plan], active: Mapping[Episode, int], now: float | None = None) -> Status:
        """Return the progress of the evaluation.

        Args:
            plans: of all environments.
            active: episodes at work, and the control steps that each has taken.
            now: value of ``time.perf_counter()``; None for the present one.
        """
        required = {episode for found in plans for episode in found.required}
        ended = [e for found in plans for e in found.counted if e not in required]
        possible = {e: probability for found in plans for e, probability in found.possible.items()}
        done = sum(map(self.usual_steps, ended))
        left = sum(map(self.usual_steps, required))
        left += sum(probability * self.usual_steps(e) for e, probability in possible.items())
        total = done + left
        under_way = sum(min(age, _ALMOST * self.usual_steps(e)) for e, age in active.items() if e in required)
        left = max(left - under_way, 0.0)
        # what an earlier run has done took none of this one's time, even where it counts only since a search has asked for it
        own = under_way + sum(self.usual_steps(e) for e in ended if e in self._open)
        self._open.update(required, possible)
        seconds = (time.perf_counter() if now is None else now) - self._began
        return Status(
            done=len(ended),
            expected=round(len(ended) + len(required) + sum(possible.values())),
            active=tuple(active),
            seconds=seconds,
            seconds_left=seconds * left / own if seconds >= _SOONEST and own > _ENOUGH * (own + left) else None,
            remaining_work=left / total if total else 0.0,
        )
