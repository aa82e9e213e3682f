"""Trainings and gaugings as processes, each in a place of its own: some on each GPU, one on the CPU, one gauging beside them."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import torch

from ...files.parsing import one_line
from ..run.side_process import ENVIRONMENT, await_end, parent_pipe
from ..run.stopping import STOP_SIGNALS, StopSignals
from .file import Sweep, SweepError
from .runs import RUN_ERRORS, SweepRun, what_failed
from .schedule import Running, seconds_left, told_left

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_POLL = 0.1
"""Time between two looks at the processes [s]."""
_WATCH_INTERVAL = 1.0
"""Time between two calls of ``watch`` [s]."""
_STOPPED = tuple(128 + number for number in STOP_SIGNALS)
"""Exit codes of trainings that were asked to stop (``stopping.StopSignals``)."""
_PATIENCE = 120.0
"""Longest wait for processes that were asked to stop [s]: an iteration and its checkpoint."""
_LAST_PATIENCE = 10.0
"""Longest wait for processes that were interrupted [s], before they are killed: they end their side processes."""


@dataclass(frozen=True, kw_only=True)
class SweepOutcome:
    """End of the processes of a sweep."""

    failures: Mapping[str, str]
    """One sentence for each run that failed, by label."""
    unfinished: Sequence[str]
    """Labels of the runs that a later call goes on with."""
    stopped: int | None
    """The signal that stopped it."""


@dataclass(kw_only=True)
class _Job:
    run: SweepRun
    place: str
    process: subprocess.Popen[bytes]
    log: Path
    began: float
    """Value of ``time.monotonic()``."""


@dataclass(frozen=True, kw_only=True)
class SweepStatus:
    """Progress of a sweep, for the display."""

    done: int
    """Runs that need nothing more."""
    count: int
    """Runs of this call."""
    running: tuple[str, ...]
    """Labels of those at work."""
    seconds_left: float | None
    """None while nothing tells how long a training takes."""


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    count = torch.cuda.device_count()
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return named.split(",")[:count] if named else [str(number) for number in range(count)]


class Jobs:
    """Takes runs from where they are to their results."""

    def __init__(
        self,
        sweep: Sweep,
        *,
        threads: int,
        deadline: float | None,
        say: Callable[[str], None],
        gpus: Sequence[str] | None = None,
        per_gpu: int = 1,
        sharing: Mapping[str, str] | None = None,
        gauging: Sequence[str] | None = None,
        watch: Callable[[SweepStatus], None] = lambda _: None,
    ) -> None:
        """Prepare.

        Args:
            deadline: value of ``time.monotonic()`` at which to stop, None for no limit.
            gpus: as ``visible_gpus``, which is the default.
            per_gpu: trainings side by side on each GPU.
            sharing: variables in the environment of trainings on GPUs (``sharing.shared_gpus``).
            gauging: options of ``evaluate`` on the workers of a gauging; None for the threads.
        """
        self._watch, self._told = watch, float("-inf")
        self._taken: dict[bool, list[float]] = {True: [], False: []}  # times of gaugings, and of trainings
        self._sweep, self._deadline, self._say = sweep, deadline, say
        self._gauging = ("--threads", str(threads)) if gauging is None else gauging
        gpus = visible_gpus() if gpus is None else gpus
        self._places: dict[str, dict[str, str]] = {}
        for beside, gpu in itertools.product(range(per_gpu), gpus):  # every GPU has one before any has two
            place = f"GPU {gpu}, beside {beside}" if beside else f"GPU {gpu}"
            self._places[place] = {"CUDA_VISIBLE_DEVICES": gpu, "OMP_NUM_THREADS": "1", **(sharing or {})}
        self._score_threads = max(threads // max(len(self._places), 1), 1)
        self._to_train: deque[SweepRun] = deque()
        self._to_gauge: deque[SweepRun] = deque()
        self._live: list[_Job] = []
        self._failures: dict[str, str] = {}

    def work(self, runs: Sequence[SweepRun]) -> SweepOutcome:
        """Train and gauge, until all is done, the time is up or a signal asks to stop; then trainings have written checkpoints.

        However it ends, no process is left; a second SIGINT shortens the wait for their checkpoints.
        """
        for run in runs:
            self._sort(run)
        with StopSignals(self._say, interrupts=False) as signals:
            try:
                while signals.received is None and not self._late and (self._live or self._start()):
                    self._start()
                    self._collect()
                    self._tell(len(runs))
                    time.sleep(_POLL)
            finally:
                self._stop(lambda: signals.insisted)
        unfinished = [run.label for run in runs if self._is_left(run)]
        return SweepOutcome(failures=dict(self._failures), unfinished=unfinished, stopped=signals.received)

    def _tell(self, count: int) -> None:
        """Tell ``watch`` how far all is, now and then."""
        now = time.monotonic()
        if now - self._told < _WATCH_INTERVAL:
            return
        self._told = now
        running = [
            Running(gauges=job.place == "gauge", spent=now - job.began, left=told_left(job.log)) for job in self._live
        ]
        waiting = len(self._to_train) + len(self._to_gauge) + len(self._live)
        left = seconds_left(
            running,
            to_train=len(self._to_train),
            to_gauge=len(self._to_gauge),
            places=max(len(self._places), 1) if any(run.on_gpu for run in self._to_train) else 1,
            trained=self._taken[False],
            gauged=self._taken[True],
        )
        if left is not None and self._deadline is not None:
            left = min(left, max(self._deadline - now, 0.0))
        labels = tuple(job.run.label for job in self._live)
        self._watch(SweepStatus(done=count - waiting, count=count, running=labels, seconds_left=left))

    @property
    def _late(self) -> bool:
        return self._deadline is not None and time.monotonic() >= self._deadline

    @contextmanager
    def _failing(self, run: SweepRun) -> Iterator[None]:
        """Turn an error of one run into its failure; the others go on."""
        try:
            yield
        except RUN_ERRORS as error:
            self._failures[run.label] = what_failed(error)
            self._say(f"{run.label} failed: {self._failures[run.label]}")

    def _is_left(self, run: SweepRun) -> bool:
        """Return True if a later call goes on with a run that has not failed."""
        if run.label not in self._failures:
            with self._failing(run):
                return not (run.trained and run.gauged(self._sweep))
        return False

    def _sort(self, run: SweepRun) -> None:
        """Put a run where it goes on."""
        with self._failing(run):
            if not run.trained:
                self._to_train.append(run)
            elif not run.gauged(self._sweep):
                self._to_gauge.append(run)

    def _start(self) -> bool:
        """Start jobs in free places; returns True if any job is at work."""
        for run in list(self._to_train):
            taken = {job.place for job in self._live}
            free = [p for p in (self._places if run.on_gpu else ("the CPU",)) if p not in taken]
            if free:
                self._to_train.remove(run)
                with self._failing(run):
                    seconds = None if self._deadline is None else self._deadline - time.monotonic()
                    command = run.training_command(self._sweep, seconds=seconds, score_threads=self._score_threads)
                    how = "goes on" if run.directory else "is trained"
                    self._launch(run, command, free[0], run.log, f"{how} on {free[0]}; its log is {run.log}")
        while self._to_gauge and all(job.place != "gauge" for job in self._live):
            run = self._to_gauge.popleft()
            with self._failing(run):
                command = run.gauging_command(self._sweep, where=self._gauging)
                self._launch(run, command, "gauge", run.folder / "gauge.log", f"is gauged on {self._sweep.suite}")
        return bool(self._live)

    def _launch(self, run: SweepRun, command: Sequence[str], place: str, log: Path, how: str) -> None:
        """Start a process, which keeps a lock until its end: the next sweep finds it if this one is killed."""
        environment = {**os.environ, **self._places.get(place, ENVIRONMENT)}
        log.parent.mkdir(parents=True, exist_ok=True)
        for path in (log, own := log.with_suffix(".lock")):
            if path.is_symlink():
                raise SweepError(
                    f"'{path}' is a link, and a sweep writes to its own files alone; remove it and call again"
                )
        with log.open("ab") as output, own.open("a+b", buffering=0) as lock:
            if fcntl is not None:
                _take(lock, "gauged" if place == "gauge" else "trained")
            # A session of its own: Ctrl-C in the terminal is for the sweep, which hands it on.
            process = subprocess.Popen(
                list(command),
                stdin=parent_pipe(),
                stdout=output,
                stderr=output,
                env=environment,
                start_new_session=True,
                pass_fds=() if fcntl is None else (lock.fileno(),),
            )
            self._live.append(_Job(run=run, place=place, process=process, log=log, began=time.monotonic()))
            with suppress(OSError):  # a full disk
                lock.truncate(0)
                lock.write(f"{process.pid}{'' if place == 'gauge' else f' on {place}'}".encode())
        self._say(f"{run.label} {how}")

    def _collect(self) -> None:
        """Take ended jobs and sort their runs on."""
        for job in [j for j in self._live if j.process.poll() is not None]:
            self._live.remove(job)
            if job.process.returncode == 0:
                self._taken[job.place == "gauge"].append(time.monotonic() - job.began)
            with self._failing(job.run):
                self._take_in(job.run, job.process.returncode, job.log, gauged=job.place == "gauge")

    def _take_in(self, run: SweepRun, code: int, log: Path, *, gauged: bool) -> None:
        """Handle the end of a process."""
        if code in _STOPPED and not gauged and run.directory:
            how = signal.Signals(code - 128).name
            self._say(
                f"{run.label} was stopped by {how} from outside and has a checkpoint; a later call goes on with it"
            )
        elif code:
            raise SweepError(f"{run.damage(self._sweep) or _reason(code, log)} (see '{log}')")
        elif gauged and not run.gauged(self._sweep):
            raise SweepError(
                f"its checkpoint or the suite {self._sweep.suite} was changed while it was gauged; call again"
            )
        elif gauged or run.trained:
            self._say(f"{run.label} has been {'gauged' if gauged else 'trained'}")
            self._sort(run)

    def _stop(self, insisted: Callable[[], bool]) -> None:
        """Ask the jobs at work to stop, and wait: trainings write a checkpoint, a gauging has its episodes on disk. Where they take too
        long, or at a second signal (``insisted``), they are interrupted, and killed at last.
        """
        for number, patience, waits in (
            (signal.SIGTERM, _PATIENCE, lambda: not insisted()),
            (signal.SIGINT, _LAST_PATIENCE, lambda: True),
        ):
            for job in self._live:
                job.process.send_signal(number)
            until = time.monotonic() + patience
            while waits() and time.monotonic() < until and any(job.process.poll() is None for job in self._live):
                time.sleep(_POLL)
        for job in self._live:
            await_end(job.process, 0.0)
        self._live = []


def _take(lock: BinaryIO, doing: str) -> None:
    """Lock a file for this process and for those that inherit it."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.seek(0)
        noted = re.fullmatch(r"(\d+)( on [\w ,-]+)?", lock.read(200).decode(errors="replace"), re.ASCII)
        number, where = noted.groups("") if noted else ("", "")
        who = f"process {number} of an earlier call" if number else "another process"
        stop = f", or stop it with 'kill {number}'," if number else ""
        raise SweepError(
            f"it is still being {doing}{where} by {who}; wait until that has ended{stop} and call again"
        ) from error


def _reason(code: int, log: Path) -> str:
    """Return the reason of a process's failure: the signal that ended it, or the last sentence of its log."""
    if code < 0:
        return "ended by " + next((known.name for known in signal.Signals if known == -code), f"signal {-code}")
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return one_line(lines[-1].removeprefix("gaitgauge: ")) if lines else f"exit code {code}"
