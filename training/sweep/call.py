"""Carry out one call of a sweep, from its plan to the kept runs, with the folders that it writes to locked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...files.writing import lock_folder, make_folder
from .file import Sweep, SweepError
from .folding import fold_sweep
from .jobs import Jobs, SweepOutcome, SweepStatus
from .keeping import check_keep, keep_runs
from .runs import SweepRun, plan_runs
from .sharing import shared_gpus


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Contents of the folder of ``--keep``."""

    labels: Sequence[str]
    """Runs that were kept by this call."""
    unkept: Mapping[str, str]
    """Reasons why runs could not be kept, by label, besides earlier failures."""
    there: int
    """Number of the call's runs that it holds."""
    to_gauge: int
    """Number of those that are not gauged yet."""


@dataclass(frozen=True, kw_only=True)
class SweepCall:
    """Result of a call."""

    runs: Sequence[SweepRun]
    refused: Mapping[str, str]
    """Reasons why entries cannot start, by name."""
    outcome: SweepOutcome
    found: Mapping[str, Any]
    """As ``fold_sweep``."""
    kept: Kept | None
    """None where nothing was to be kept."""

    @property
    def failures(self) -> dict[str, str]:
        """Return reasons why runs failed, by label."""
        return _failures(self.runs, self.found)


def work_through(
    sweep: Sweep,
    folder: Path,
    *,
    threads: int,
    per_gpu: int,
    gauging: Sequence[str] | None,
    deadline: float | None,
    report: bool,
    keep: Path | None,
    say: Callable[[str], None],
    watch: Callable[[SweepStatus], None] = lambda _: None,
) -> SweepCall | None:
    """Do the rest of a sweep, write its tables, and keep trained runs.

    Args:
        report: write the tables of present results, and start nothing.
        keep: folder of kept runs; None for none.

    Returns:
        None where no entry can start: then tables of an earlier call, perhaps of another file, are not written over.

    Raises:
        SweepError: a folder cannot be used, or all entries are refused for one and the same reason.
        SuiteError: no such suite.
    """
    if folder.exists() and not folder.is_dir():
        raise SweepError(f"'{folder}' is a file; give another folder with --out")
    make_folder(folder, SweepError)
    if keep is not None:  # errors in it are reported before hours of training
        make_folder(keep, SweepError, option="--keep")
        if keep.samefile(folder):
            raise SweepError(f"--keep is '{keep}', the sweep's own folder; give another one")
        keep = keep.absolute()
    with ExitStack() as closing:
        closing.callback(lock_folder(folder, SweepError).release)
        runs, refused = plan_runs(sweep, folder, to_train=not report)
        if not runs and len(set(refused.values())) == 1:
            raise SweepError(next(iter(refused.values())))
        if keep is not None:
            with _locked(keep):
                check_keep(runs, keep)
        begun = {run.entry.name for run in runs}
        for name, sentence in refused.items():
            say(f"gaitgauge: entry '{name}' cannot start{' in full' if name in begun else ''}: {sentence}")
        if not runs:
            return None
        shares = per_gpu > 1 and not report and any(run.on_gpu for run in runs)
        context: AbstractContextManager[Mapping[str, str]] = shared_gpus(say) if shares else nullcontext({})
        with context as sharing:
            jobs = Jobs(
                sweep,
                threads=threads,
                deadline=deadline,
                say=say,
                per_gpu=per_gpu,
                sharing=sharing,
                gauging=gauging,
                watch=watch,
            )
            outcome = jobs.work([] if report else runs)
        found = fold_sweep(sweep, runs, refused, outcome.failures, folder)
        kept = None if keep is None else _keep(sweep, runs, keep, _failures(runs, found))
    return SweepCall(runs=runs, refused=refused, outcome=outcome, found=found, kept=kept)


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
    return {run.label: row["reason"] for run, row in zip(runs, found["runs"], strict=True) if row["reason"]}


def _keep(sweep: Sweep, runs: Sequence[SweepRun], folder: Path, failed: Mapping[str, str]) -> Kept:
    """Keep trained runs in a folder, with a page and a table of all that it holds."""
    with _locked(folder):
        labels, unkept = keep_runs(sweep, runs, folder)
        there, refused = plan_runs(sweep, folder, to_train=False)
        found = fold_sweep(sweep, there, refused, {}, folder)
    unkept = {label: sentence for label, sentence in (_failures(there, found) | unkept).items() if label not in failed}
    mine = {run.label for run in runs}
    states = [row["state"] for run, row in zip(there, found["runs"], strict=True) if run.label in mine]
    to_gauge = states.count("trained")
    return Kept(labels=labels, unkept=unkept, there=states.count("gauged") + to_gauge, to_gauge=to_gauge)
