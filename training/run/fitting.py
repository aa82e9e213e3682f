"""Fit the length of a run to its wall-clock limit, once its speed is known (``--fit``)."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from .run_directory import update_run_json, write_parameters
from .state import RunState

SKIPPED, MEASURED = 10, 20
"""Iterations at the begin of a stretch before the speed is measured, and those that are measured first."""
EVERY = 0.1
"""Share of the run after which the speed is measured again: robots that still fall are slower to compute."""
CHANGE = 0.005
"""Relative change of the length below which the schedules stay as they are."""
SLOWER = 1.4
"""Time of an iteration in a later stretch over one in the first: its contacts cost more."""
BUILDING = 35.0
"""Time to build the worlds of a later stretch, with kernels cached [s]."""
SPARE = 0.025
"""Share of the limit to leave, for the last checkpoint and what is not foreseen."""


def iterations_that_fit(*, done: int, each: float, left: float, begins: Sequence[float]) -> int:
    """Return the iterations of a whole run that ends in time.

    Args:
        done: iterations done.
        each: time of one [s].
        left: time to fill [s].
        begins: fractions of these iterations after which stretches are still to begin.
    """
    first = min(begins, default=1.0)
    seconds = left - BUILDING * len(begins)
    return max(int((done + seconds / each) / (first + SLOWER * (1.0 - first))), done + 1)


class Fit:
    """Measures the speed of a run again and again, and has the run and its schedules end with the limit."""

    def __init__(self, run: RunState, total: int, limit: float) -> None:
        """Begin a run of at most ``total`` iterations that has ``limit`` seconds."""
        env: Any = run.env
        self._run, self._longest, self._spare = run, total, SPARE * limit
        self._first = self._stretch = env.stretch
        self._from, self._until, self._begin = SKIPPED, SKIPPED + MEASURED, 0.0

    def total(self, total: int, left: float) -> int:
        """Return the iterations of the whole run, in all processes alike, after an iteration with ``left`` seconds of the limit."""
        run, now = self._run, time.monotonic()
        env: Any = run.env
        if env.stretch != self._stretch:
            self._stretch, self._from = env.stretch, run.iteration + SKIPPED
            self._until = self._from + MEASURED
        if run.iteration == self._from:
            self._begin = now
        if run.iteration != self._until:
            return total
        each = (now - self._begin) / (self._until - self._from)
        schedule = env.cfg.schedule
        begins = [stretch.begin - schedule.begin for stretch in schedule.stretches if stretch.begin < 1.0]
        fitting = iterations_that_fit(
            done=run.iteration, each=each, left=left - self._spare, begins=begins[env.stretch :]
        )
        if env.stretch > self._first:  # one that has begun must not lie ahead again
            fitting = min(fitting, int(run.iteration / begins[env.stretch - 1]))
        fitted = min(run.processes.firsts(fitting), self._longest)
        self._from, self._until, self._begin = run.iteration, run.iteration + max(round(EVERY * fitted), MEASURED), now
        if abs(fitted - total) > CHANGE * total:
            total = fitted
            self._spread(total)
            run.message(
                f"{total} iterations of {self._longest} fit into the time, {each:.2f} s each now: schedules end with them."
            )
        elif run.iteration == SKIPPED + MEASURED:
            run.message(f"All {total} iterations fit into the time.")
        return total

    def _spread(self, iterations: int) -> None:
        """Let all schedules, here and in the run's files, end with a number of iterations."""
        run, steps = self._run, iterations * self._run.configuration.run.steps_per_iteration
        env: Any = run.env
        env.set_horizon(steps)
        run.settings = copy.deepcopy(run.settings)
        run.settings["training"]["run"]["iterations"] = iterations
        run.settings["environment"]["schedule"]["horizon_steps"] = steps
        if run.log_dir is not None and run.processes.rank == 0:
            update_run_json(run.log_dir, {"settings": run.settings})
            agent = replace(run.configuration, run=replace(run.configuration.run, iterations=iterations))
            write_parameters(run.log_dir, environment=run.settings["environment"], agent=agent)
