"""``gaitgauge evaluate``: live progress, then tables."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ..gauge.evaluate import Request, Status, evaluate, prepare
from ..gauge.report import write_report
from .errors import UserError

_REFRESH = 0.5
"""Shortest time between two updates of the display [s]."""
_LOG_EVERY = 10.0
"""Time between two lines where there is no terminal [s]."""


def run_evaluation(
    *,
    policy: str,
    pipeline: str,
    suite: str,
    backend: str,
    device: str | None,
    threads: int | None,
    out: Path | None,
    resume: bool,
    json_output: bool,
    **choices: Any,
) -> None:
    """Evaluate, show progress, print the tables and where the files are."""
    request = Request(
        policy=policy,
        pipeline=pipeline,
        suite=suite,
        backend=backend,
        device=device or default_device(backend),
        threads=threads or os.cpu_count() or 1,
        **choices,
    )
    prepare(request)  # all that can be wrong with the request is said before anything is written
    folder = out or Path("results") / f"{Path(policy).stem}-{Path(suite).stem}-{pipeline}"
    console = Console(stderr=True)
    try:
        with _display(console) as watch:
            results = evaluate(request, folder, resume=resume, command=["gaitgauge", *sys.argv[1:]], watch=watch)
    except KeyboardInterrupt:
        again = shlex.join(["gaitgauge", *[a for a in sys.argv[1:] if a != "--resume"], "--resume"])
        console.print(
            f"stopped; every finished episode is kept in {folder}. Go on with:\n  {again}",
            highlight=False,
            soft_wrap=True,
        )
        raise typer.Exit(130) from None
    report = write_report(folder)
    if json_output:
        print(json.dumps(results, indent=1))
        return
    print_results(Console(), results)
    print(f"results  {folder / 'results.json'}\nepisodes {folder / 'episodes.csv'}\nreport   {report}")


def default_device(backend: str) -> str:
    """Where an engine runs by default: cuda for the Warp engines where there is one, else cpu.

    Raises:
        UserError: a Warp engine on a machine without a GPU.
    """
    if backend.partition(":")[0] not in ("mujoco-warp", "newton"):
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda"
    raise UserError(
        f"backend '{backend}' wants a GPU and this machine has none; add --device cpu (slow), or use --backend mujoco"
    )


class _display:  # noqa: N801  (reads as a verb where it is used)
    """Context manager that shows ``Status``: a live bar on a terminal, plain lines elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last = 0.0
        self._live: Live | None = None
        self._rate: tuple[float, float] | None = None

    def __enter__(self) -> Callable[[Status], None]:
        self._last = time.monotonic()
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("[bold]{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[text]}"),
                TimeElapsedColumn(),
            )
            self._task = self._bar.add_task("gauging", total=1.0, text="")
            self._live = Live(self._bar, console=self._console, refresh_per_second=4)
            self._live.__enter__()
        return self._update

    def __exit__(self, *details: Any) -> None:
        if self._live is not None:
            self._live.__exit__(*details)

    def _update(self, status: Status) -> None:
        now = time.monotonic()
        if now - self._last < (_REFRESH if self._live else _LOG_EVERY):
            return
        self._last = now
        done = 1.0 - status.remaining_work
        left = status.seconds * status.remaining_work / done if done > 0.02 else None
        text = f"{status.done} of about {status.expected} episodes"
        places = sorted({f"{e.terrain} L{e.level}" if e.level else e.terrain for e in status.active})
        running = ", ".join(places[:5]) + (f" and {len(places) - 5} more" if len(places) > 5 else "")
        remaining = f"about {_duration(left)} left" if left is not None else "estimating time"
        if self._live:
            self._bar.update(self._task, completed=done, text=f"{text}, {remaining}\n  now: {running}")
        else:
            self._console.print(
                f"{_duration(status.seconds)}: {text}, {remaining}; now: {running}", highlight=False, soft_wrap=True
            )


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def print_results(console: Console, results: Mapping[str, Any]) -> None:
    """Tables of terrains and metrics, then the score."""
    suite = results["suite"]
    table = Table(
        title=f"{suite['name']} {suite['version']}, {results['pipeline']}, on {results['backend']}",
        title_justify="left",
    )
    for name, right in (
        ("terrain", False),
        ("level", True),
        ("mean", True),
        ("mean@25", True),
        ("mean@50", True),
        ("95 % interval", True),
    ):
        table.add_column(name, justify="right" if right else "left")
    for name, row in results["terrains"].items():
        level = "" if row["level"] is None else f"{row['level']:.2f}".rstrip("0").rstrip(".")
        if "score" in row:
            table.add_row(
                name, level, *(f"{row[k]:.4f}" for k in ("mean", "mean25", "mean50")), _interval(row["interval"])
            )
        else:
            table.add_row(name, level, "", "", "", "")
    console.print(table)
    if results["metrics"]:
        table = Table(title="metrics, weighted by level", title_justify="left")
        for name in ("metric", "mean", "mean@25", "mean@50", "95 % interval"):
            table.add_column(name, justify="left" if name == "metric" else "right")
        for name, row in results["metrics"].items():
            table.add_row(name, *(f"{row[k]:.4f}" for k in ("mean", "mean25", "mean50")), _interval(row["interval"]))
        console.print(table)
        console.print("  ".join(f"{k} {v:.4f}" for k, v in results["groups"].items()), highlight=False)
    health = results["health"]
    troubles = [f"{v} {k}" for k, v in health.items() if k != "episodes" and v]
    if troubles:
        console.print(f"in {health['episodes']} quality episodes: {', '.join(troubles)}", highlight=False)
    if results["score"] is not None:
        interval = results["score_interval"]
        note = f"95 % interval {_interval(interval)}" if interval else results["chance"]["note"]
        console.print(f"[bold]score {results['score']:.4f}[/bold]  ({note})", highlight=False)
    elif results["level"] is not None:
        interval = results["level_interval"]
        note = f"  (95 % interval {_interval(interval, 2)})" if interval else ""
        console.print(f"[bold]mean level {results['level']:.2f}[/bold]{note}", highlight=False)


def _interval(found: Sequence[float] | None, digits: int = 4) -> str:
    return f"{found[0]:.{digits}f} to {found[1]:.{digits}f}" if found else "one seed"
