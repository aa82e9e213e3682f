"""Write the last good state of a run of several processes when one of them is lost.

A process that shares gradients over a GPU hangs in a call of the driver then, which no signal interrupts: torchrun asks it to stop, and
kills it 30 s later. A thread of its own therefore hears the signal too, and writes what was copied after the last complete iteration.
It asks nothing of the GPU, which does not answer any more.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from ..processes import ProcessLostError
from .checkpoint import CheckpointError
from .keepsake import Keepsake
from .resuming import TrainingDivergedError, write_learned
from .run_directory import read_run_json
from .state import RunState
from .stopping import STOP_SIGNALS, TrainingOutcome

PATIENCE = 300.0
"""Longest time without a step of an update [s]; compiling may take another process a minute longer."""
PATIENCE_AFTER_SIGNAL = 10.0
"""Longest time without a step [s] once this process was asked to stop: torchrun asks all others when one is lost."""


class Rescue:
    """Writes a checkpoint of the last complete iteration."""

    def __init__(self, run: RunState) -> None:
        """Keep nothing yet."""
        self._run, self.keepsake = run, Keepsake()
        self._local: dict[str, Any] = {}
        self._begin = 0.0
        self._alive: float | None = None
        self._writing = threading.Lock()

    def keep(self) -> None:
        """Copy the run's networks, optimizers and averages, and how far it is, after an iteration, if another process may be lost."""
        run = self._run
        if run.processes.several:
            kept: dict[str, Any] = {"learned": run.learned(), "progress": getattr(run.env, "progress", torch.ones(()))}
            if hasattr(run.env, "progress_dict"):
                kept["environment"] = run.env.progress_dict()
            self._local = {"num_envs": run.env.num_envs, "log": run.logger.state_dict(), "world_size": 0}
            self.keepsake.keep(kept, run.iteration, run.device)

    @contextmanager
    def on_watch(self, begin: float) -> Iterator[None]:
        """Watch over the updates of a call of ``learn`` that began at a ``time.monotonic()``; inside of ``StopSignals``."""
        self._begin = begin
        if not self._run.processes.several or threading.current_thread() is not threading.main_thread():
            yield
            return
        told, telling = os.pipe()
        os.set_blocking(telling, False)
        before = signal.set_wakeup_fd(telling, warn_on_full_buffer=False)
        watching = threading.Thread(target=self._watch, args=(told,), daemon=True)
        watching.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)
            os.close(telling)
            watching.join()
            os.close(told)

    def watched(self, update: Callable[[Callable[[], None]], dict[str, float]]) -> dict[str, float]:
        """Return what an update returns, which calls what it is given after every step."""
        self.keepsake.settle()
        self._step()
        try:
            return update(self._step)
        finally:
            self._alive = None

    def _step(self) -> None:
        self._alive = time.monotonic()

    def _watch(self, told: int) -> None:
        asked: float | None = None
        while True:
            if select.select([told], [], [], 0.2)[0]:
                if not (numbers := os.read(told, 64)):
                    return
                if asked is None and any(number in STOP_SIGNALS for number in numbers):
                    asked = time.monotonic()
            # Before the first iteration is complete a step may compile for long, and there is nothing to save.
            limit = PATIENCE if asked is None or self.keepsake.iteration < 0 else PATIENCE_AFTER_SIGNAL
            alive = self._alive
            if alive is not None and time.monotonic() - max(alive, asked or alive) > limit:
                self._end(ProcessLostError(f"another process did not answer for {limit:g} s"))
                return

    def _end(self, error: ProcessLostError) -> None:
        """End this process, which hangs, with a checkpoint and a sentence, unless it is about to do that itself."""
        if not self._writing.acquire(blocking=False):
            return
        try:
            sys.stderr.write(f"gaitgauge: {self._saved(error)}\n")
        except (CheckpointError, OSError) as failure:
            sys.stderr.write(f"gaitgauge: {error}; {failure}\n")
        except SystemExit:
            pass
        sys.stderr.flush()
        os._exit(2)

    def write(self, error: ProcessLostError) -> ProcessLostError:
        """Write the checkpoint; the first process that is left does it, and returns the error that says so, unless the lost process
        diverged and has reported that. Raises SystemExit: another process has written the checkpoint or reported the reason.
        """
        with self._writing:  # forever, if the thread is at it: it ends this process
            return self._saved(error)

    def _saved(self, error: ProcessLostError) -> ProcessLostError:
        run = self._run
        run.logger.flush()
        time.sleep(float(run.processes.rank))
        kept = self.keepsake.take()
        known = None if run.log_dir is None else read_run_json(run.log_dir).get("outcome")
        if kept is None or run.log_dir is None:
            if known == "running":
                self._record_loss(None)
            return ProcessLostError(f"{error}; no iteration was complete, so there is no new checkpoint")
        run.iteration = self.keepsake.iteration
        path = run.log_dir / f"model_{run.iteration}.pt"
        sentence = f"{error}; iteration {run.iteration} is in '{path}', go on with --resume {run.log_dir}"
        if known not in ("running", "failed", "diverged"):
            raise SystemExit(2)  # another one has done it
        if known != "diverged":
            self._record_loss(path)
        if not (path.exists() and time.time() - path.stat().st_mtime < time.monotonic() - self._begin):
            try:
                local = {name: value for name, value in kept.items() if name != "learned"}
                write_learned(run, path, kept["learned"], self._local | local)
            except TrainingDivergedError as diverged:
                run.note("diverged")
                sentence = f"{error}; {diverged}"
        if known == "diverged":
            raise SystemExit(2)
        return ProcessLostError(sentence)

    def _record_loss(self, checkpoint: Path | None) -> None:
        reason, iteration = "lost a process", self._run.iteration
        self._run.record(TrainingOutcome(reason=reason, iteration=iteration, checkpoint=checkpoint, exit_code=2))
