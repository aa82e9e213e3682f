"""The runs of a sweep: what each is to be, how far it is, and the commands that take it further."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...backends.base import BackendError
from ...files.parsing import one_line, read_results
from ...files.writing import json_text, make_folder, write_atomically
from ...gauge.comparison import ComparisonError
from ...gauge.suite import SuiteError, load_suite
from ...policy.base import PolicyError
from ...policy.contract import ContractError
from ...policy.finding import latest_checkpoint
from ..checkpoint import CheckpointError
from ..configuration import ConfigurationError
from ..launch import TrainRequest, prepare
from ..overrides import TaskError
from ..run_directory import read_run_json
from ..side_process import PROGRAM
from .file import NO_SUITE, Sweep, SweepEntry, SweepError

KEPT = "kept"
"""Folder of a run's small form (``keeping``)."""
KEPT_CURVES = "curves.csv"
KEPT_POLICY = "policy.gauge.pt"
RESULTS = "results.json"
RUN_ERRORS = (SweepError, CheckpointError, ComparisonError, PolicyError, ContractError, OSError)
"""What may be wrong with the files of one run; the others go on."""


def what_failed(error: Exception) -> str:
    """One sentence on one of ``RUN_ERRORS``."""
    if not isinstance(error, OSError):
        return str(error)
    reason = (error.strerror or one_line(error)).lower()
    return f"'{one_line(error.filename)}': {reason}; mend that and call again" if error.filename else reason


@dataclass(frozen=True, kw_only=True)
class SweepRun:
    """One training: an entry with one seed."""

    entry: SweepEntry
    seed: int
    settings: tuple[str, ...]
    """Of sweep and entry."""
    backend: str
    on_gpu: bool
    """Whether its engine runs on a GPU."""
    iterations: int
    """Updates of the whole run."""
    folder: Path
    """Where its run directory and its gauging go."""
    init_from: str | None = None
    """What it begins with; None for nothing."""

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.entry.name}, seed {self.seed}"

    @property
    def log(self) -> Path:
        """What its training printed."""
        return self.folder / "train.log"

    @property
    def directory(self) -> Path | None:
        """Its run directory, the latest with a checkpoint, or what was kept of it; None before the first checkpoint."""
        found = [run for run in self.folder.glob("logs/*/*") if latest_checkpoint(run)]
        if found:
            return max(found, key=lambda run: run.name)
        whole = (self._kept / "run.json").is_file() and any(
            (self._kept / name).is_file() for name in (KEPT_POLICY, RESULTS)
        )
        return self._kept if whole else None

    @property
    def _kept(self) -> Path:
        return self.folder / KEPT

    @property
    def trained(self) -> bool:
        """Whether all of its iterations are done.

        Raises:
            CheckpointError: its description is damaged.
        """
        run = self.directory
        noted = read_run_json(run) if run else {}
        return noted.get("outcome") == "finished" and noted.get("iteration", 0) >= self.iterations

    def policy(self, sweep: Sweep) -> Path | None:
        """What of it is gauged; None before it is trained, and where it was not kept."""
        run = self.directory
        if run is None:
            return None
        if run == self._kept:
            return run / KEPT_POLICY if (run / KEPT_POLICY).is_file() else None
        best = run / "best.pt"
        return best if sweep.checkpoint == "best" and best.is_file() else latest_checkpoint(run)

    def results(self, sweep: Sweep) -> Path | None:
        """Where the gauging of its policy goes; None before it is trained."""
        if self.directory == self._kept and (self._kept / RESULTS).is_file():
            return self._kept
        policy = self.policy(sweep)
        return self.folder / "gauge" / policy.stem if policy else None

    def gauged(self, sweep: Sweep) -> bool:
        """Whether its policy has been gauged."""
        results = self.results(sweep)
        return results is not None and (results / RESULTS).is_file()

    def training_command(self, sweep: Sweep, *, seconds: float | None, score_threads: int) -> list[str]:
        """Begins the training or goes on with it; ``seconds`` is its wall-clock limit [s]."""
        options = ["--no-score"]
        if sweep.training_suite != NO_SUITE:
            options = ["--score-suite", sweep.training_suite, "--score-threads", str(score_threads)]
        options += [] if seconds is None else ["--time", f"{max(seconds, 1.0):.0f}s"]
        options += [] if self.on_gpu else ["--device", "cpu"]
        if (run := self.directory) is not None:
            # The settings are those of the checkpoint; given again, functions that they name need no --trust.
            return [*PROGRAM, "train", self.entry.task, *self.settings, "--resume", str(run), *options]
        options += ["--backend", self.backend, "--seed", str(self.seed), "--log-root", str(self.folder / "logs")]
        options += [] if self.init_from is None else ["--init-from", self.init_from]
        return [*PROGRAM, "train", self.entry.task, *self.settings, *options]

    def gauging_command(self, sweep: Sweep, *, where: Sequence[str]) -> list[str]:
        """Gauges its policy, or goes on with that; ``where`` are the options ``--threads`` and ``--cluster``."""
        policy, results = self.policy(sweep), self.results(sweep)
        assert policy is not None and results is not None
        options = ["--suite", sweep.suite, *where, "--out", str(results), "--json", "--no-clip"]
        return [*PROGRAM, "evaluate", str(policy), *options, *(["--resume"] if results.exists() else [])]

    def claim(self) -> None:
        """Note in its folder what it is trained with, or check that it is the same as before.

        Raises:
            SweepError: the folder holds a training with other settings.
        """
        mine: Mapping[str, Any] = {
            "task": self.entry.task,
            "settings": list(self.settings),
            "seed": self.seed,
            "backend": self.backend,
        } | ({} if self.init_from is None else {"init_from": self.init_from})
        note = self.folder / "entry.json"
        if not note.exists():
            make_folder(self.folder, SweepError)
            write_atomically(note, json_text(dict(mine)), SweepError)
        elif (found := read_results(note, "sweep's note", SweepError)) != mine:
            changed = next(name for name in {**mine, **found} if found.get(name) != mine.get(name))
            raise SweepError(
                f"'{self.folder}' holds a training with another {one_line(changed, 80)}; give another folder with --out, or take this one "
                "away"
            )


def _is_trained(run: SweepRun) -> bool:
    """Whether nothing of a run is left to train; one whose description is damaged is told of when it is to go on."""
    try:
        return run.trained
    except CheckpointError:
        return False


def plan_runs(sweep: Sweep, folder: Path, *, to_train: bool = True) -> tuple[list[SweepRun], dict[str, str]]:
    """The runs of a sweep, those of the first seed first, and of each entry that cannot start one sentence on why.

    Args:
        to_train: whether this machine must be able to train what is left to train. What was trained elsewhere can be gauged and
            reported on any.

    Raises:
        SuiteError: no such suite.
    """
    for suite in {sweep.suite, sweep.training_suite} - {NO_SUITE}:
        load_suite(suite)
    runs: list[tuple[int, SweepRun]] = []
    refused: dict[str, str] = {}
    for entry in sweep.entry:
        settings, backend = (*sweep.settings, *entry.settings), entry.backend or sweep.backend
        init_from = sweep.init_from if entry.init_from is None else entry.init_from
        request = TrainRequest(
            task=entry.task,
            overrides=settings,
            backend=backend,
            device=entry.device,
            init_from=init_from,
            score_suite=None,
        )
        try:
            iterations = prepare(replace(request, device="cpu")).task.training.run.iterations
            own = [
                SweepRun(
                    entry=entry,
                    seed=seed,
                    settings=settings,
                    backend=backend,
                    on_gpu=False,
                    iterations=iterations,
                    init_from=init_from,
                    folder=folder / "runs" / entry.name / f"seed-{seed}",
                )
                for seed in (sweep.seeds if entry.seeds is None else entry.seeds)
            ]
            if to_train and not all(map(_is_trained, own)):
                try:
                    on_gpu = prepare(request).device.startswith("cuda")
                except BackendError as error:  # what was trained elsewhere can be gauged all the same
                    refused[entry.name] = str(error)
                    own = [run for run in own if _is_trained(run)]
                else:
                    own = [replace(run, on_gpu=on_gpu) for run in own]
            for run in own:
                run.claim()
        except (TaskError, ConfigurationError, BackendError, SuiteError, CheckpointError, SweepError) as error:
            refused[entry.name] = str(error)
            continue
        runs += enumerate(own)
    return [run for _, run in sorted(runs, key=lambda item: item[0])], refused
