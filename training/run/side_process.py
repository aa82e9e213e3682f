"""Commands beside a training, one at a time: it goes on while they run."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ...files.parsing import one_line

PROGRAM = (sys.executable, "-m", f"{__name__.partition('.')[0]}.cli.main")
"""This package's command line."""
CHILD_PROGRAM = (*PROGRAM[:2], f"{__package__}.child", PROGRAM[-1])
"""The same command line with ``parent_pipe()`` as standard input: it is asked to stop when this process is gone."""
ENVIRONMENT: Mapping[str, str] = {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
"""A side process has no business on the GPU that trains."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One command."""

    command: Sequence[str]
    checkpoint: Path
    """Checkpoint that the command is about."""
    iteration: int
    output: Path
    """File of its standard output."""

    @property
    def log(self) -> Path:
        """Return file of its standard error."""
        return self.output.with_suffix(".log")


@dataclass(frozen=True, kw_only=True)
class Finished:
    """Result of a job."""

    job: Job
    failure: str
    """Reason of a failure, in one sentence; empty for success."""


class SideProcess:
    """Runs jobs in the order of their submission; of those that wait, all but the last checkpoint's are given up."""

    def __init__(self) -> None:
        self._waiting: deque[Job] = deque()
        self._running: tuple[Job, subprocess.Popen[bytes]] | None = None
        self._finished: list[Finished] = []

    def submit(self, job: Job) -> None:
        """Run a job when its turn comes."""
        while self._waiting and self._waiting[0].checkpoint != job.checkpoint:
            self._finished.append(Finished(job=self._waiting.popleft(), failure="skipped"))
        self._waiting.append(job)
        self._start_next()

    def poll(self) -> list[Finished]:
        """Return jobs that ended since the last call, without waiting."""
        if self._running is not None:
            job, process = self._running
            if (code := process.poll()) is not None:
                self._running = None
                failure = f"exit code {code}; see {job.log}" if code else ""
                self._finished.append(Finished(job=job, failure=failure))
        self._start_next()
        finished, self._finished = self._finished, []
        return finished

    def drain(self, seconds: float, stop: Callable[[], bool] = lambda: False) -> list[Finished]:
        """Wait for everything that is pending, at most ``seconds`` [s], until ``stop`` says so."""
        deadline = time.monotonic() + seconds
        finished = self.poll()
        while self.pending and time.monotonic() < deadline and not stop():
            time.sleep(0.2)
            finished += self.poll()
        return finished

    @property
    def pending(self) -> int:
        """Number of submitted jobs that ``poll`` has not returned."""
        return len(self._waiting) + (self._running is not None) + len(self._finished)

    def close(self) -> None:
        """Stop the running job and forget the waiting ones."""
        self._waiting.clear()
        if self._running is not None:
            process = self._running[1]
            self._running = None
            process.terminate()
            await_end(process, 10.0)

    def _start_next(self) -> None:
        if self._running is not None or not self._waiting:
            return
        job = self._waiting.popleft()
        try:
            job.output.parent.mkdir(parents=True, exist_ok=True)
            with job.output.open("wb") as out, job.log.open("wb") as log:
                # A session of its own: Ctrl-C in the terminal is for the training, which decides on the rest.
                process = subprocess.Popen(
                    list(job.command),
                    stdin=parent_pipe(),
                    stdout=out,
                    stderr=log,
                    env={**os.environ, **ENVIRONMENT},
                    start_new_session=True,
                )
        except OSError as error:
            where = "" if error.filename in (None, job.command[0]) else f"'{one_line(error.filename)}': "
            failure = f"cannot start {job.command[0]}: {where}{error.strerror}"
            self._finished.append(Finished(job=job, failure=failure))
            return
        self._running = (job, process)


@cache
def parent_pipe() -> int:
    """Return the standard input of ``CHILD_PROGRAM``: a pipe in which nothing is written, open as long as this process lives."""
    child_end, _ = os.pipe()
    return child_end


def await_end(process: subprocess.Popen[bytes], seconds: float) -> None:
    """Wait for a process that was asked to end, at most so long [s]; then it is killed."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
