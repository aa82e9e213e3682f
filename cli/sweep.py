"""``gaitgauge sweep``: what starts, ends and fails, then the table of entries and what is real of their differences."""

from __future__ import annotations

import json
import os
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import typer

from ..files.writing import lock_folder, make_folder
from ..gauge.cluster import check_address
from ..training.sweep.file import Sweep, SweepError, load_sweep
from ..training.sweep.folding import fold_sweep
from ..training.sweep.jobs import Jobs
from ..training.sweep.keeping import check_keep, keep_runs
from ..training.sweep.runs import SweepRun, plan_runs
from ..training.sweep.sharing import shared_gpus
from .console import Terminal, make_table, shell_command
from .train import parse_duration


def run_sweep(
    *,
    file: Path,
    out: Path | None,
    threads: int | None,
    per_gpu: int,
    cluster: str | None,
    time: str | None,
    report: bool,
    keep: Path | None,
    json_output: bool,
) -> None:
    """Run what is left of a sweep, print its table, and keep what is trained.

    The exit code is 1 where an entry could not be done, or was stopped from outside and no time limit was set; 128 + signal
    where the sweep was stopped.
    """
    began = clock.monotonic()
    sweep = load_sweep(file)
    folder = (out or Path("results") / f"sweep-{sweep.name}").absolute()
    deadline = None if time is None else began + parse_duration(time)
    errors = Terminal(stderr=True)
    gauging = None
    if cluster is not None:
        check_address(cluster)
        gauging = ["--cluster", cluster, *([] if threads is None else ["--threads", str(threads)])]
    if folder.exists() and not folder.is_dir():
        raise SweepError(f"'{folder}' is a file; give another folder with --out")
    make_folder(folder, SweepError)
    if keep is not None:  # what is wrong with it is said before hours of training
        make_folder(keep, SweepError, option="--keep")
        if keep.samefile(folder):
            raise SweepError(f"--keep is '{keep}', the sweep's own folder; give another one")
    lock = lock_folder(folder, SweepError)
    try:
        runs, refused = plan_runs(sweep, folder, to_train=not report)
        if not runs and len(set(refused.values())) == 1:
            raise SweepError(next(iter(refused.values())))
        if keep is not None:
            with _locked(keep):
                check_keep(runs, keep.absolute())
        begun = {run.entry.name for run in runs}
        for name, sentence in refused.items():
            errors.say(f"gaitgauge: entry '{name}' cannot start{' in full' if name in begun else ''}: {sentence}")
        if not runs:  # tables of an earlier call, perhaps of another file, are not written over
            raise typer.Exit(1)
        threads = threads or max((os.cpu_count() or 2) // 2, 1)
        shares = per_gpu > 1 and not report and any(run.on_gpu for run in runs)
        context: AbstractContextManager[Mapping[str, str]] = shared_gpus(errors.say) if shares else nullcontext({})
        with context as sharing:
            jobs = Jobs(
                sweep,
                threads=threads,
                deadline=deadline,
                say=errors.say,
                per_gpu=per_gpu,
                sharing=sharing,
                gauging=gauging,
            )
            outcome = jobs.work([] if report else runs)
        found = fold_sweep(sweep, runs, refused, outcome.failures, folder)
        failed = _failures(runs, found)
        for label, sentence in failed.items():
            if label not in outcome.failures:
                errors.say(f"{label} failed: {sentence}")
        try:
            if json_output:
                print(json.dumps(found, indent=1))
            else:
                print_sweep(Terminal(), found, folder)
        finally:
            unkept = {} if keep is None else _keep(sweep, runs, keep.absolute(), failed, errors.say)
    finally:
        lock.release()
    if outcome.unfinished:
        errors.say(f"{len(outcome.unfinished)} of {len(runs)} runs are not done; go on with:\n  {shell_command()}")
    if outcome.stopped is not None:
        raise typer.Exit(128 + outcome.stopped)
    if refused or failed or unkept or (outcome.unfinished and deadline is None):
        raise typer.Exit(1)


@contextmanager
def _locked(keep: Path) -> Iterator[None]:
    """Keep the folder of ``--keep`` for this process."""
    try:
        lock = lock_folder(keep, SweepError)
    except SweepError as error:
        raise SweepError(f"--keep cannot be used: {error}") from error
    try:
        yield
    finally:
        lock.release()


def _failures(runs: Sequence[SweepRun], found: Mapping[str, Any]) -> dict[str, str]:
    """Why runs failed, by label."""
    return {run.label: row["reason"] for run, row in zip(runs, found["runs"], strict=True) if row["reason"]}


def _keep(
    sweep: Sweep, runs: Sequence[SweepRun], folder: Path, failed: Mapping[str, str], say: Callable[[str], None]
) -> dict[str, str]:
    """Keep what is trained in a folder, with a page and a table of all that it holds; says what was kept, and returns what could
    not be, beside what has ``failed`` already.
    """
    with _locked(folder):
        labels, unkept = keep_runs(sweep, runs, folder)
        there, refused = plan_runs(sweep, folder, to_train=False)
        found = fold_sweep(sweep, there, refused, {}, folder)
    unkept = {label: sentence for label, sentence in (_failures(there, found) | unkept).items() if label not in failed}
    for label, sentence in unkept.items():
        say(f"{label} is not kept: {sentence}")
    states = [row["state"] for row in found["runs"]]
    there_now = f"{states.count('gauged') + states.count('trained')} of {len(runs)} are in {folder}"
    to_gauge = f", {states.count('trained')} of them not gauged yet" if "trained" in states else ""
    say(f"kept {len(labels)} run{'s' * (len(labels) != 1)}; {there_now}{to_gauge}")
    return unkept


def print_sweep(console: Terminal, found: Mapping[str, Any], folder: Path) -> None:
    """A table of the entries, the comparison's sentences, and where the files are."""
    groups = list(dict.fromkeys(g for e in found["entries"] if e["best"] for g in e["best"]["groups"] or {}))
    columns = ("entry", "score", "95 % interval", *groups, "level", "seed", "mean of seeds")
    table = make_table(f"{found['title']} ({found['suite']})", *columns, numbers=True)
    for entry in found["entries"]:
        best = entry["best"]
        if best is None:
            table.add_row(entry["entry"], entry["reason"] and "failed")
            continue
        low_high = "" if best["score_interval"] is None else "{:.4f} to {:.4f}".format(*best["score_interval"])
        values = [f"{best['groups'][g]:.4f}" if g in (best["groups"] or {}) else "" for g in groups]
        spread = "" if entry["deviation"] is None else f" ± {entry['deviation']:.4f}"
        table.add_row(
            entry["entry"],
            f"{best['score']:.4f}",
            low_high,
            *values,
            "" if best["level"] is None else f"{best['level']:.2f}",
            str(best["seed"]),
            f"{entry['mean']:.4f}{spread}",
        )
    console.print(table)
    for sentence in found["sentences"]:
        console.say(sentence)
    for name in ("sweep.html", *(["comparison.html"] if found["compared"] else []), "curves.csv"):
        console.say(f"{name.partition('.')[0]:11}{folder / name}")
