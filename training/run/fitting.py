"""Fit the length of a run to its wall-clock limit, once its speed is known (``--fit``)."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any

from .run_directory import update_run_json
from .state import RunState

SKIPPED, MEASURED = 10, 30
"""Iterations done before the speed is measured, and when it is known."""
SLOWER = 1.4
"""Time of an iteration in a later stretch over one in the first: its contacts cost more."""
BUILDING = 40.0
"""Time to build the worlds of a later stretch [s]."""
USED = 0.97
"""Share of the limit to fill."""


def iterations_that_fit(*, done: int, each: float, left: float, begins: Sequence[float]) -> int:
    """Return the iterations of a whole run that ends in time.

    Args:
        done: iterations done.
        each: time of one [s].
        left: time that is left [s].
        begins: fractions of the run at which stretches are still to begin.
    """
    first = min(begins, default=1.0)
    seconds = USED * left - BUILDING * len(begins)
    return max(int((done + seconds / each) / (first + SLOWER * (1.0 - first))), done + 1)


class Fit:
    """Measures a run's first iterations, then shortens the run and its schedules to what fits into the limit."""

    def __init__(self, run: RunState) -> None:
        """Begin at an iteration of a run that has done none."""
        self._run, self._begin = run, 0.0

    def total(self, total: int, left: float) -> int:
        """Return the iterations of the whole run, in all processes alike, after an iteration with ``left`` seconds of the limit."""
        run, now = self._run, time.monotonic()
        if run.iteration == SKIPPED:
            self._begin = now
        if run.iteration != MEASURED:
            return total
        env: Any = run.env
        each = (now - self._begin) / (MEASURED - SKIPPED)
        begins = [stretch.begin for stretch in env.cfg.schedule.stretches[env.stretch :] if stretch.begin < 1.0]
        fitting = iterations_that_fit(done=run.iteration, each=each, left=left, begins=begins)
        fitted: int = min(run.processes.firsts(fitting), total)
        if fitted == total:
            run.message(f"All {total} iterations fit into the time.")
            return total
        steps = fitted * run.configuration.run.steps_per_iteration
        env.set_horizon(steps)
        run.settings = copy.deepcopy(run.settings)
        run.settings["training"]["run"]["iterations"] = fitted
        run.settings["environment"]["schedule"]["horizon_steps"] = steps
        if run.log_dir is not None and run.processes.rank == 0:
            update_run_json(run.log_dir, {"settings": run.settings})
        run.message(f"{fitted} iterations of {total} fit into the time, {each:.2f} s each: schedules end with them.")
        return fitted
