"""``gaitgauge train``: live progress, and how to go on when it stops."""

from __future__ import annotations

import os
import re
import shlex
import time as clock
from collections import deque
from pathlib import Path
from typing import Any

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from ..training.launch import TrainRequest, prepare, train
from ..training.stopping import Progress
from .errors import UserError

_REFRESH = 0.25
"""Shortest time between two updates of the display [s]."""
_LOG_EVERY = 10.0
"""Time between two lines where there is no terminal [s]."""
_RATE_WINDOW = 20
"""Iterations over which the speed and the time left are averaged."""
_UNITS = {"h": 3600.0, "m": 60.0, "s": 1.0}


def run_training(*, task: str, time: str | None, **choices: Any) -> None:
    """Train, show progress, say where the checkpoints are and how to go on; exits with the run's exit code."""
    began = clock.monotonic()
    seconds = None if time is None else duration(time)
    plan = prepare(TrainRequest(task=task, seconds=seconds, **choices))
    # Of several processes, one for each GPU, the first speaks.
    console = Console(highlight=False, quiet=os.environ.get("RANK", "0") != "0")
    steps = plan.task.training.run.steps_per_iteration * plan.task.environment.num_envs
    display = _Display(console, title=task, deadline=None if seconds is None else began + seconds)

    def started(run: Path) -> None:
        verb = f"resuming {plan.checkpoint}" if plan.checkpoint else f"training {task}"
        console.print(f"{verb} on {plan.backend} ({plan.device}), {steps} steps an iteration", soft_wrap=True)
        console.print(f"run directory {run}", soft_wrap=True)
        console.print("building the environment", soft_wrap=True)

    with display:
        outcome, run = train(plan, began=began, started=started, progress=display.update, message=display.say)
    done = f"{outcome.iteration} iterations done"
    why = {"finished": "finished", "time": "time is up", "signal": "stopped"}[outcome.reason]
    console.print(f"{why}, {done}; last checkpoint {outcome.checkpoint}", soft_wrap=True)
    if (run / "best.pt").is_file():
        console.print(f"best by the gauge's score: {run / 'best.pt'}", soft_wrap=True)
    if outcome.reason != "finished":
        again = shlex.join(["gaitgauge", "train", task, "--resume", str(run)])
        console.print(f"go on with:\n  {again}", soft_wrap=True)
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)


def duration(text: str) -> float:
    """Seconds of ``90``, ``90s``, ``9m``, ``2h`` or ``1h30m``.

    Raises:
        UserError: it is no duration, or not above zero.
    """
    if re.fullmatch(r"\d+(\.\d+)?", text):
        seconds = float(text)
    elif re.fullmatch(r"(\d+(\.\d+)?[hms])+", text):
        seconds = sum(float(number) * _UNITS[unit] for number, unit in re.findall(r"([\d.]+)([hms])", text))
    else:
        raise UserError(f"--time is '{text}'; write seconds, or for example 9m, 2h or 1h30m")
    if seconds <= 0.0:
        raise UserError(f"--time is '{text}'; it must be longer than 0 s")
    return seconds


class _Display:
    """Shows ``Progress``: a live block on a terminal, plain lines elsewhere."""

    def __init__(self, console: Console, *, title: str, deadline: float | None) -> None:
        """Show nothing yet.

        Args:
            console: where to.
            title: name of the task.
            deadline: value of ``time.monotonic()`` at which training stops, None for no limit.
        """
        self._console = console
        self._title = title
        self._deadline = deadline
        self._live: Live | None = None
        self._last = float("-inf")
        self._recent: deque[tuple[float, int]] = deque(maxlen=_RATE_WINDOW)

    def __enter__(self) -> _Display:
        if self._console.is_terminal:
            self._live = Live(console=self._console, refresh_per_second=4)
            self._live.__enter__()
        return self

    def __exit__(self, *details: Any) -> None:
        if self._live is not None:
            self._live.__exit__(*details)

    def say(self, sentence: str) -> None:
        """Print a sentence above the display."""
        self._console.print(Text(sentence), soft_wrap=True)

    def update(self, progress: Progress) -> None:
        """Show one iteration, if it is time to."""
        now = clock.monotonic()
        self._recent.append((now, progress.iteration))
        last_one = progress.iteration >= progress.total_iterations
        if now - self._last < (_REFRESH if self._live else _LOG_EVERY) and not last_one:
            return
        self._last = now
        values = _shown(progress)
        left = self._left(progress, now)
        if self._live is not None:
            self._live.update(self._block(progress, values, left))
            return
        head = f"iteration {progress.iteration}/{progress.total_iterations}"
        text = ", ".join(f"{name} {value}" for name, value in values.items())
        self._console.print(Text(f"{head}, {text}, {left}"), soft_wrap=True)

    def _left(self, progress: Progress, now: float) -> str:
        """How long training still takes, for people."""
        remaining = progress.total_iterations - progress.iteration
        (first, start), (last, end) = self._recent[0], self._recent[-1]
        seconds = progress.elapsed / max(progress.iteration, 1) * remaining
        if end > start:
            seconds = (last - first) / (end - start) * remaining
        elif len(self._recent) < 2:
            return "estimating time"
        if self._deadline is not None:
            seconds = min(seconds, max(self._deadline - now, 0.0))
        return f"{_clock(seconds)} left"

    def _block(self, progress: Progress, values: dict[str, str], left: str) -> RenderableType:
        table = Table.grid(padding=(0, 2))
        cells = [Text.assemble((f"{name} ", "dim"), value) for name, value in values.items()]
        for i in range(0, len(cells), 4):
            table.add_row(*cells[i : i + 4])
        head = Text.assemble(
            (self._title, "bold"), f"  iteration {progress.iteration} of {progress.total_iterations}, {left}"
        )
        bar = ProgressBar(total=progress.total_iterations, completed=progress.iteration, width=60)
        return Group(head, bar, table)


def _shown(progress: Progress) -> dict[str, str]:
    """What the display says of an iteration, by short name."""
    scalars = progress.scalars
    values: dict[str, str] = {}

    def add(name: str, key: str, form: str) -> None:
        if key in scalars:
            values[name] = format(scalars[key], form)

    if "Perf/total_steps" in scalars:
        values["steps"] = f"{scalars['Perf/total_steps'] / 1e6:.2f} M"
    add("steps/s", "Perf/total_fps", ",.0f")
    add("reward", "Train/mean_reward", ".2f")
    add("episode", "Train/mean_episode_length", ".0f")
    add("level", "Curriculum/mean_level", ".2f")
    add("value loss", "Loss/value", ".4f")
    add("surrogate", "Loss/surrogate", ".4f")
    add("latent", "Loss/latent", ".4f")
    add("std", "Policy/mean_std", ".2f")
    gauge = [key for key in scalars if key.startswith("Gauge/") and key.endswith("/score")]
    for key in gauge[:1]:
        add("gauge", key, ".4f")
    if progress.best_score is not None:
        values["best gauge"] = f"{progress.best_score:.4f} at {progress.best_iteration}"
    return values


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
