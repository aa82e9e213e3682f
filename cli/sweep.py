"""``gaitgauge sweep``: what starts, ends and fails, then the table of entries and what is real of their differences."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import typer

from ..files.choices import cores
from ..gauge.play.cluster import check_address
from ..training.sweep.call import Kept, work_through
from ..training.sweep.file import load_sweep
from ..training.sweep.jobs import SweepStatus
from .console import Terminal, make_table, print_json, shell_command
from .progress import ProgressDisplay
from .requests import SweepRequest
from .train import parse_duration


def run_sweep(asked: SweepRequest) -> None:
    """Run what is left of a sweep, print its table, and keep what is trained.

    The exit code is 1 where an entry could not be done or kept, or was stopped from outside and no time limit was set; 128 + signal
    where the sweep was stopped.
    """
    began = clock.monotonic()
    sweep, threads = load_sweep(asked.file), asked.threads
    folder = (asked.out or Path("results") / f"sweep-{sweep.name}").absolute()
    deadline = None if asked.time is None else began + parse_duration(asked.time)
    errors = Terminal(stderr=True)
    gauging = None
    if asked.cluster is not None:
        check_address(asked.cluster)
        gauging = ["--cluster", asked.cluster, *([] if threads is None else ["--threads", str(threads)])]
    with ProgressDisplay(errors, "sweep") as display:
        done = work_through(
            sweep,
            folder,
            threads=threads or max(cores() // 2, 1),
            per_gpu=asked.per_gpu,
            gauging=gauging,
            deadline=deadline,
            report=asked.report,
            keep=asked.keep,
            say=errors.say,
            watch=partial(_show, display),
        )
    if done is None:
        raise typer.Exit(1)
    outcome = done.outcome
    for label, sentence in done.failures.items():
        if label not in outcome.failures:  # those were told when they happened
            errors.say(f"{label} failed: {sentence}")
    if asked.json_output:
        print_json(done.found)
    else:
        print_sweep(Terminal(), done.found, folder)
    if done.kept is not None:
        assert asked.keep is not None
        print_kept(errors, done.kept, f"{len(done.runs)} are in {asked.keep.absolute()}")
    if outcome.unfinished:
        errors.say(f"{len(outcome.unfinished)} of {len(done.runs)} runs are not done; go on with:\n  {shell_command()}")
    if outcome.stopped is not None:
        raise typer.Exit(128 + outcome.stopped)
    unkept = {} if done.kept is None else done.kept.unkept
    if done.refused or done.failures or unkept or (outcome.unfinished and deadline is None):
        raise typer.Exit(1)


def _show(display: ProgressDisplay, status: SweepStatus) -> None:
    text = f"{status.done} of {status.count} runs done"
    text += ", estimating time" * (status.seconds_left is None)
    display.update(status.done / status.count, text, {"now:": ", ".join(status.running)}, left=status.seconds_left)


def print_kept(console: Terminal, kept: Kept, of_all: str) -> None:
    """Print the runs that were kept, those that could not be, and how many of ``of_all`` are there."""
    for label, sentence in kept.unkept.items():
        console.say(f"{label} is not kept: {sentence}")
    to_gauge = f", {kept.to_gauge} of them not gauged yet" if kept.to_gauge else ""
    console.say(f"kept {len(kept.labels)} run{'s' * (len(kept.labels) != 1)}; {kept.there} of {of_all}{to_gauge}")


def print_sweep(console: Terminal, found: Mapping[str, Any], folder: Path) -> None:
    """Print a table of the entries, the comparison's sentences, and the places of the files."""
    groups = list(dict.fromkeys(g for e in found["entries"] if e["best"] for g in e["best"]["groups"] or {}))
    several = any(e["range"] for e in found["entries"])
    columns = ("entry", "score", "95 % interval", *groups, "level", "seed", "mean of seeds", *["range"] * several)
    table = make_table(f"{found['title']} ({found['suite']})", *columns, numbers=True)
    for entry in found["entries"]:
        best = entry["best"]
        if best is None:
            table.add_row(entry["entry"], entry["reason"] and "failed")
            continue
        values = [f"{best['groups'][g]:.4f}" if g in (best["groups"] or {}) else "" for g in groups]
        deviation = "" if entry["deviation"] is None else f" ± {entry['deviation']:.4f}"
        table.add_row(
            entry["entry"],
            f"{best['score']:.4f}",
            _low_high(best["score_interval"]),
            *values,
            "" if best["level"] is None else f"{best['level']:.2f}",
            str(best["seed"]),
            f"{entry['mean']:.4f}{deviation}",
            *[_low_high(entry["range"])] * several,
        )
    console.print(table)
    for sentence in found["sentences"]:
        console.say(sentence)
    for name in ("sweep.html", *(["comparison.html"] if found["compared"] else []), "curves.csv"):
        console.say(f"{name.partition('.')[0]:11}{folder / name}")


def _low_high(pair: Sequence[float] | None) -> str:
    return "{:.4f} to {:.4f}".format(*pair) if pair else ""
