"""Train with live progress, and say how to go on after a stop (``gaitgauge train``)."""

from __future__ import annotations

import os
import re
import sys
import time as clock
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ..files.parsing import one_line
from ..training.configuration import RunConfiguration
from ..training.run.request import TrainRequest
from ..training.run.stopping import Progress
from ..training.run.without_gpu import check_gpu
from .console import Terminal, shell_command
from .errors import UserError
from .progress import ProgressDisplay, duration

if TYPE_CHECKING:
    from ..training.run.plan import TrainPlan

_RATE_WINDOW = 20
"""Iterations over which the speed and the time left are averaged."""
_LONGEST = 10_000 * 3600.0
"""Longest time limit [s]."""
_UNITS = {"h": 3600.0, "m": 60.0, "s": 1.0}
_SHOWN = (
    ("steps/s", "Perf/total_fps", ",.0f"),
    ("reward", "Train/mean_reward", ".2f"),
    ("episode", "Train/mean_episode_length", ".0f"),
    ("level", "Curriculum/mean_level", ".2f"),
    ("value loss", "Loss/value", ".4f"),
    ("surrogate", "Loss/surrogate", ".4f"),
    ("latent", "Loss/latent", ".4f"),
    ("std", "Policy/mean_std", ".2f"),
)
"""Scalars on the display: short name, key and format."""


def run_training(request: TrainRequest, time: str | None) -> None:
    """Train for at most ``time``, show progress, say how to go on, and exit with the run's exit code."""
    began = clock.monotonic()
    seconds = None if time is None else parse_duration(time)
    check_gpu(request)  # before torch is loaded
    from ..training.processes import RUN_BEGAN, Processes
    from ..training.run.launch import train
    from ..training.run.plan import prepare
    from ..training.starting import processes_to_start, start_processes

    plan = prepare(replace(request, seconds=seconds))
    if (count := processes_to_start(request.gpus, request.device, plan.device)) > 1:
        if code := start_processes(count, sys.argv[1:], began=began):
            raise typer.Exit(code)
        return
    task = plan.request.task  # a ground and a robot have become a task
    # Of several processes, one for each GPU, the first prints; all count from the start of the command that started them.
    if Processes.told().several:
        began = float(os.environ.get(RUN_BEGAN, began))
    console = Terminal(quiet=os.environ.get("RANK", "0") != "0", may_lose=True)
    steps = plan.task.training.run.steps_per_iteration * plan.task.environment.num_envs

    def started(run: Path) -> None:
        verb = f"resuming {plan.checkpoint}" if plan.checkpoint else f"training {plan.task.shown}"
        console.say(f"{verb} on {plan.backend} ({plan.device}), {steps} steps an iteration")
        console.say(f"run directory {run}")
        console.say("building the environment")

    with ProgressDisplay(console, plan.task.shown, began=began) as display:
        watch = _Watch(display, None if seconds is None else began + seconds)
        outcome, run = train(plan, began=began, started=started, progress=watch.update, message=console.say)
    done = f"{outcome.iteration} iterations done"
    why = {"finished": "finished", "time": "time is up", "signal": "stopped"}[outcome.reason]
    console.say(f"{why}, {done}; last checkpoint {outcome.checkpoint}")
    if (run / "best.pt").is_file():
        console.say(f"best by the gauge's score: {run / 'best.pt'}")
    if outcome.reason != "finished":
        again = shell_command(["train", task, "--resume", str(run)], *_again(plan))
        start, where = _start()
        console.say(f"go on with{where}:\n  {start}{again.removeprefix('gaitgauge')}")
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)


def _start() -> tuple[str, str]:
    """Return the start of a command on as many machines as this run has, and a note on what the reader must add."""
    from ..training.processes import Processes, told_number

    count = Processes.told().count
    here = told_number("LOCAL_WORLD_SIZE", count)
    if not 0 < here < count:
        return "gaitgauge", ""
    start = f"torchrun --nnodes {count // here} --nproc-per-node {here} -m gaitgauge.cli.main"
    return start, ", on every machine and with its --rdzv options"


def _again(plan: TrainPlan) -> list[str]:
    """Return options that a resumed run needs again because checkpoints do not hold them: trust, logger, device, threads, scores."""
    run, usual = plan.task.training.run, RunConfiguration()
    found = ["--trust"] if plan.needs_trust else []
    found += ["--logger", run.logger] if run.logger != usual.logger else []
    for name in ("device", "gpus", "threads", "capture", "fuse", "film", "score", "score_suite", "score_threads"):
        value, option = getattr(plan.request, name), name.replace("_", "-")
        if value == getattr(TrainRequest, name):
            continue
        if isinstance(value, bool):
            found.append(f"--{option}" if value else f"--no-{option}")
        else:
            found += [f"--{option}", str(value)]
    if run.logger_project != usual.logger_project:
        found.append(f"training.run.logger_project={run.logger_project}")
    return found


def parse_duration(text: str) -> float:
    """Return the seconds of ``90``, ``90s``, ``9m``, ``2h`` or ``1h30m``.

    Raises:
        UserError: it is no duration, not above zero, or too long.
    """
    if re.fullmatch(r"\d+(\.\d+)?", text):
        seconds = float(text)
    elif re.fullmatch(r"(\d+(\.\d+)?[hms])+", text):
        seconds = sum(float(number) * _UNITS[unit] for number, unit in re.findall(r"([\d.]+)([hms])", text))
    else:
        raise UserError(f"--time is '{one_line(text, 80)}'; write seconds, or for example 9m, 2h or 1h30m")
    if not 0.0 < seconds <= _LONGEST:
        most = f"{_LONGEST / 3600:g} h"
        raise UserError(f"--time is '{one_line(text, 80)}'; it must be longer than 0 s and at most {most}")
    return seconds


class _Watch:
    """Show training's ``Progress`` and the time that is left."""

    def __init__(self, display: ProgressDisplay, deadline: float | None) -> None:
        """Take the value of ``time.monotonic()`` at which training stops, None for no limit."""
        self._display = display
        self._deadline = deadline
        self._recent: deque[tuple[float, int]] = deque(maxlen=_RATE_WINDOW)

    def update(self, progress: Progress) -> None:
        """Show one iteration."""
        now = clock.monotonic()
        self._recent.append((now, progress.iteration))
        done, total = progress.iteration, progress.total_iterations
        text = f"iteration {done} of {total}"
        if done >= total:
            pass  # the film and the last score follow, which training waits for
        elif len(self._recent) > 1:
            text += f", {self._duration(progress, now, total - done)} left"
            if progress.next_score is not None:
                text += f", score in {self._duration(progress, now, progress.next_score)}"
        else:
            text += ", estimating time"
        self._display.update(done / total, text, _shown(progress), last=done >= total)

    def _duration(self, progress: Progress, now: float, remaining: int) -> str:
        """Return the time for the next ``remaining`` iterations, for people."""
        (first, start), (last, end) = self._recent[0], self._recent[-1]
        seconds = progress.elapsed / max(progress.iteration, 1) * remaining
        if end > start:
            seconds = (last - first) / (end - start) * remaining
        if self._deadline is not None:
            seconds = min(seconds, max(self._deadline - now, 0.0))
        return duration(seconds)


def _shown(progress: Progress) -> dict[str, str]:
    """Return the figures of an iteration for the display, by short name."""
    scalars = progress.scalars
    values = {}
    if "Perf/total_steps" in scalars:
        values["steps"] = f"{scalars['Perf/total_steps'] / 1e6:.2f} M"
    gauge = [("gauge", key, ".4f") for key in scalars if key.startswith("Gauge/") and key.endswith("/score")]
    for name, key, form in (*_SHOWN, *gauge[:1]):
        if key in scalars:
            values[name] = format(scalars[key], form)
    if progress.best_score is not None:
        values["best gauge"] = f"{progress.best_score:.4f} at {progress.best_iteration}"
    return values
