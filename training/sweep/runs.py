"""Describe the runs of a sweep: their settings, their progress, and the commands that take them further."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...backends.base import BackendError, DeviceError
from ...files.parsing import one_line, read_results, shown
from ...files.writing import json_text, make_folder, write_atomically
from ...gauge.result import Result
from ...gauge.suite import SuiteError, load_suite
from ...policy.base import PolicyError
from ...policy.contract import ContractError
from ...policy.finding import latest_checkpoint
from ...policy.loading import load_policy
from ...policy.native import FilePolicy
from ...studies.compare.comparison import ComparisonError, load_result
from ...studies.policies import file_digest
from ..configuration import ConfigurationError
from ..overrides import TaskError
from ..run.checkpoint import CheckpointError
from ..run.plan import prepare
from ..run.request import TrainRequest
from ..run.run_directory import read_run_json
from ..run.side_process import CHILD_PROGRAM
from .file import NO_SUITE, Sweep, SweepEntry, SweepError

KEPT = "kept"
"""Folder of a run's small form (``keeping``)."""
KEPT_CURVES = "curves.csv"
KEPT_POLICY = "policy.gauge.pt"
RESULTS = "results.json"
SCORES = ("score", "score_interval", "level", "groups")
"""Entries of results that a table shows."""
_SEEDS = ("training.run.seed", "environment.seed")
"""Settings that would be the same in all runs of an entry."""
RUN_ERRORS = (SweepError, CheckpointError, ComparisonError, PolicyError, ContractError, OSError)
"""Errors in the files of one run; the others go on."""


class DamagedNoteError(SweepError):
    """The settings noted in a run's folder cannot be read; other runs of the entry are not affected."""


def what_failed(error: Exception) -> str:
    """Return one sentence on one of ``RUN_ERRORS``."""
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
    """Settings of sweep and entry."""
    backend: str
    on_gpu: bool
    """True if its engine runs on a GPU."""
    iterations: int
    """Updates of the whole run."""
    folder: Path
    """Folder of its run directory and its gauging."""
    suite_digest: str
    """Digest of the suite that gauges it."""
    init_from: str | None = None
    """Shipped policy or checkpoint with its first networks; None for untrained ones."""

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.entry.name}, seed {self.seed}"

    @property
    def log(self) -> Path:
        """Return the output of its training."""
        return self.folder / "train.log"

    @property
    def directory(self) -> Path | None:
        """Return its run directory, the latest with a checkpoint, or the kept form of it; None before the first checkpoint."""
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
        """True if all of its iterations are done. Raises CheckpointError: its description is damaged."""
        noted = self.description()
        finished = self.directory != self._kept or noted.get("outcome") == "finished"
        return finished and noted.get("iteration", 0) >= self.iterations

    def description(self) -> dict[str, Any]:
        """Return its ``run.json`` with the ``iteration`` of its last checkpoint; empty before the first.

        Raises:
            CheckpointError: it is damaged.
        """
        run = self.directory
        if run is None:
            return {}
        try:
            noted = read_run_json(run)
        except CheckpointError as error:
            how = "is trained again" if run == self._kept else "goes on from its last checkpoint"
            raise CheckpointError(f"{error}; delete it and call again: the run {how}") from error
        last = latest_checkpoint(run)
        return noted | ({} if last is None else {"iteration": int(last.stem.removeprefix("model_"))})

    def policy(self, sweep: Sweep) -> Path | None:
        """Return the file that is gauged; None before the run is trained, and where the file was not kept.

        Raises:
            SweepError: another checkpoint was kept than the sweep asks for.
            CheckpointError, ComparisonError: a kept file is damaged.
        """
        run = self.directory
        if run is None:
            return None
        if run == self._kept:
            self._check_kept(sweep)
            return run / KEPT_POLICY if (run / KEPT_POLICY).is_file() else None
        best = run / "best.pt"
        return best if sweep.checkpoint == "best" and best.is_file() else latest_checkpoint(run)

    def wanted_iteration(self, sweep: Sweep) -> int | None:
        """Return the iteration of the checkpoint that the sweep asks for, as noted in the description; None where it is not.

        Raises:
            CheckpointError: the description is damaged.
        """
        noted = self.description()
        best = noted.get("best_iteration") if sweep.checkpoint == "best" else None
        return noted.get("iteration") if best is None else best

    def _check_kept(self, sweep: Sweep) -> None:
        wanted, there = self.wanted_iteration(sweep), self.description().get("kept_iteration")
        if there is None and (self._kept / RESULTS).is_file():
            there = read_card(self._kept).policy.provenance.get("iteration")
        if there is not None and there != wanted:
            raise SweepError(
                f"'{one_line(self._kept)}' keeps the policy of iteration {shown(there)}, and checkpoint '{sweep.checkpoint}' is that of "
                f"{wanted}; change checkpoint in the sweep's file, or give another folder"
            )

    def results(self, sweep: Sweep) -> Path | None:
        """Return the folder of the gauging of its policy; None before it is trained. Results of another suite or policy keep their place.

        Raises:
            SweepError: the kept file is of another checkpoint, or of another suite and without a policy.
            CheckpointError, ComparisonError: a file is damaged.
            OSError: its policy cannot be read.
        """
        policy = self.policy(sweep)
        if self.directory == self._kept and (self._kept / RESULTS).is_file():
            if self._is_place(self._kept, policy):
                return self._kept
            if policy is None:
                raise SweepError(
                    f"'{one_line(self._kept / RESULTS)}' is not of the suite {sweep.suite} as it is now, and without {KEPT_POLICY} beside "
                    "it the run cannot be gauged again; put that there, or give another folder"
                )
        if policy is None:
            return None
        usual = self.folder / "gauge" / policy.stem
        if self._is_place(usual, policy):
            return usual
        return usual.with_name(f"{policy.stem}-{self.suite_digest[:8]}-{file_digest(str(policy))[:8]}")

    def _is_place(self, folder: Path, policy: Path | None) -> bool:
        """Return True if a folder is free for results of this suite and a policy's file, or has them or began with them; None stands for
        any.
        """
        if (folder / RESULTS).is_file():
            card = read_card(folder)
            same_policy = policy is None or card.policy.file_sha256 == file_digest(str(policy))
            return card.suite.digest == self.suite_digest and same_policy
        if policy is None or not (folder / "request.json").is_file():
            return True
        begun = read_results(folder / "request.json", "request", SweepError)
        return begun.get("suite_digest") == self.suite_digest and begun.get("policy") == _read_policy(policy).digest

    def gauged(self, sweep: Sweep) -> bool:
        """True if its policy has been gauged on this suite; raises as ``results``."""
        results = self.results(sweep)
        return results is not None and (results / RESULTS).is_file()

    @property
    def has_results(self) -> bool:
        """True if there are results of any suite and policy."""
        return (self._kept / RESULTS).is_file() or any(self.folder.glob(f"gauge/*/{RESULTS}"))

    def damage(self, sweep: Sweep) -> str:
        """Return the damage of the checkpoint that it goes on from, or of the gauged file, as a sentence; empty for none."""
        run = self.directory
        try:
            for path in filter(None, {latest_checkpoint(run) if run else None, self.policy(sweep)}):
                _read_policy(path)
        except SweepError as error:
            return str(error)
        return ""

    def training_command(self, sweep: Sweep, *, seconds: float | None, score_threads: int) -> list[str]:
        """Return the command that begins the training or goes on with it; ``seconds`` is its wall-clock limit [s]."""
        options = ["--no-score"]
        if sweep.training_suite != NO_SUITE:
            options = ["--score-suite", sweep.training_suite, "--score-threads", str(score_threads)]
        options += [] if seconds is None else ["--time", f"{max(seconds, 1.0):.0f}s"]
        options += [] if self.on_gpu else ["--device", "cpu"]
        options += ["--no-film", "--log-root", str(self.folder / "logs")]
        if (run := self.directory) is not None:
            # The settings are those of the checkpoint; given again, functions that they name need no --trust.
            return [*CHILD_PROGRAM, "train", self.entry.task, *self.settings, "--resume", str(run), *options]
        options += ["--backend", self.backend, "--seed", str(self.seed)]
        options += [] if self.init_from is None else ["--init-from", self.init_from]
        return [*CHILD_PROGRAM, "train", self.entry.task, *self.settings, *options]

    def gauging_command(self, sweep: Sweep, *, where: Sequence[str]) -> list[str]:
        """Return the command that gauges its policy or goes on with that; ``where`` are the options ``--threads`` and ``--cluster``."""
        policy, results = self.policy(sweep), self.results(sweep)
        assert policy is not None and results is not None
        options = ["--suite", sweep.suite, *where, "--out", str(results), "--json", "--no-clip"]
        return [*CHILD_PROGRAM, "evaluate", str(policy), *options, *(["--resume"] if results.exists() else [])]

    def claim(self, *, option: str = "--out", note: bool = True) -> None:
        """Check that its folder holds no training with other settings, and ``note`` the present ones there.

        Args:
            option: which names the folder, for the sentence.

        Raises:
            DamagedNoteError: the note cannot be read.
            SweepError: the folder holds a training with other settings, or cannot be written to.
        """
        mine: Mapping[str, Any] = {
            "task": self.entry.task,
            "settings": list(self.settings),
            "seed": self.seed,
            "backend": self.backend,
        } | ({} if self.init_from is None else {"init_from": self.init_from})
        path = self.folder / "entry.json"
        if not path.exists():
            if note:
                make_folder(self.folder, SweepError, option=option)
                write_atomically(path, json_text(dict(mine)), SweepError)
            return
        try:
            found = read_results(path, "sweep's note", SweepError)
        except SweepError as error:
            how = "put it back, or delete it if the training beside it is the one that the sweep's file asks for"
            raise DamagedNoteError(f"{error}; {how}, and call again") from error
        if found != mine:
            theirs, ours = _named(found), _named(mine)
            names = sorted({**ours, **theirs}, key=lambda name: name == "settings")  # their order is told last
            name = next(n for n in names if n not in ours or n not in theirs or theirs[n] != ours[n])
            its, wanted = (shown(note[name]) if name in note else "none" for note in (theirs, ours))
            raise SweepError(
                f"'{self.folder}' holds a training whose {one_line(name, 80)} is {its}, and the sweep's file says {wanted}; give "
                f"another folder with {option}, or take this one away"
            )


def _named(note: Mapping[str, Any]) -> dict[str, Any]:
    """Return the text of a run's note, and each of its settings by name."""
    settings = note.get("settings")
    return {**note, **(dict(str(s).partition("=")[::2] for s in settings) if isinstance(settings, list) else {})}


def _read_policy(path: Path) -> FilePolicy:
    try:
        return load_policy(path)
    except (PolicyError, ContractError) as error:
        how = "the run goes on from what is left, as from a checkpoint before it"
        raise SweepError(f"{error}; put it back, or remove it and call again: {how}") from error


def read_card(folder: Path) -> Result:
    """Return the result in a folder. Raises ComparisonError: there are none, or they are damaged."""
    try:
        card = load_result(folder, intervals=False)
        for name in SCORES:
            if name in card.lacking:
                raise ComparisonError(f"results '{one_line(folder / RESULTS)}' lack {name}")
    except ComparisonError as error:
        raise ComparisonError(f"{error}; delete it and call again, which makes it anew") from error
    return card


def _is_trained(run: SweepRun) -> bool:
    """Return True if nothing of a run is left to train; a damaged description is reported when the run is to go on."""
    try:
        return run.trained
    except CheckpointError:
        return False


def _check_seeds(seeds: Sequence[int], settings: Sequence[str]) -> None:
    """Refuse an entry with runs that would not differ."""
    if not seeds or len(set(seeds)) < len(seeds):
        raise SweepError(f"seeds are {shown(list(seeds))}; give at least one, and each once")
    for setting in settings:
        if setting.partition("=")[0].strip() in _SEEDS:
            raise SweepError(f"with the setting {shown(setting)} all seeds train the same run; write seeds = […]")


def plan_runs(sweep: Sweep, folder: Path, *, to_train: bool = True) -> tuple[list[SweepRun], dict[str, str]]:
    """Return the runs of a sweep, those of the first seed first, and for each entry with a run that cannot start one sentence on the
    reason.

    Args:
        to_train: this machine must be able to train the rest, which is noted in their folders. Runs that were trained elsewhere can be
            gauged and reported on any.

    Raises:
        SuiteError: no such suite.
    """
    digest = load_suite(sweep.suite).digest
    runs: list[tuple[int, SweepRun]] = []
    refused: dict[str, str] = {}
    for entry in sweep.entry:
        settings, backend = (*sweep.settings, *entry.settings), entry.backend or sweep.backend
        device = entry.device or sweep.device
        init_from = sweep.init_from if entry.init_from is None else entry.init_from
        request = TrainRequest(
            task=entry.task,
            overrides=settings,
            backend=backend,
            device=device,
            init_from=init_from,
            score=False,
            film=False,
        )
        try:
            _check_seeds(sweep.seeds_of(entry), settings)
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
                    suite_digest=digest,
                )
                for seed in sweep.seeds_of(entry)
            ]
            if to_train and not all(map(_is_trained, own)):
                try:
                    on_gpu = prepare(request).device.startswith("cuda")
                except DeviceError as error:  # runs that were trained elsewhere can be gauged all the same
                    change = 'device = "cpu"' if device else 'device = "cpu" (slow) or backend = "mujoco"'
                    refused[entry.name] = f"{error.reason}; write {change} in the sweep's file"
                    own = [run for run in own if _is_trained(run)]
                else:
                    own = [replace(run, on_gpu=on_gpu) for run in own]
            for run in tuple(own):  # all of them before one is noted
                try:
                    run.claim(note=False)
                except DamagedNoteError as error:
                    refused.setdefault(entry.name, str(error))
                    own.remove(run)
            if to_train:
                for run in own:
                    run.claim()
        except (TaskError, ConfigurationError, BackendError, SuiteError, CheckpointError, SweepError) as error:
            refused[entry.name] = str(error)
            continue
        runs += enumerate(own)
    return [run for _, run in sorted(runs, key=lambda item: item[0])], refused
