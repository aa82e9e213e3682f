"""Write the last good state of a run of several processes when one of them is lost."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from ..processes import ProcessLostError
from .keepsake import Keepsake
from .resuming import TrainingDivergedError, write_learned
from .run_directory import read_run_json
from .state import RunState
from .stopping import TrainingOutcome


class Rescue:
    """Writes a checkpoint of the last complete iteration."""

    def __init__(self, run: RunState) -> None:
        """Keep nothing yet."""
        self._run, self.keepsake = run, Keepsake()

    def keep(self) -> None:
        """Copy the run's networks, optimizers and averages after an iteration, if another process may be lost."""
        run = self._run
        if run.processes.several:
            self.keepsake.keep(run.learned(), run.iteration, run.device)

    def write(self, error: ProcessLostError, begin: float) -> ProcessLostError:
        """Write the checkpoint; the first process that is left does it, and returns the error that says so, unless the lost process
        diverged and has reported that. ``begin`` is ``time.monotonic()`` of when this call of ``learn`` began. Raises SystemExit: another
        process has written the checkpoint or reported the reason.
        """
        run = self._run
        time.sleep(float(run.processes.rank))
        learned = self.keepsake.take()
        known = None if run.log_dir is None else read_run_json(run.log_dir).get("outcome")
        if learned is None or run.log_dir is None:
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
        if not (path.exists() and time.time() - path.stat().st_mtime < time.monotonic() - begin):
            try:
                self._write(path, learned)
            except TrainingDivergedError as diverged:
                run.note("diverged")
                sentence = f"{error}; {diverged}"
        if known == "diverged":
            raise SystemExit(2)
        return ProcessLostError(sentence)

    def _write(self, path: Path, learned: Mapping[str, Any]) -> None:
        run = self._run
        # The device's own stream may wait for the lost process forever; the environment is not touched by that.
        on_gpu = torch.device(run.device).type == "cuda"
        with torch.cuda.stream(torch.cuda.Stream(run.device)) if on_gpu else nullcontext():
            local = {"num_envs": run.env.num_envs, "log": run.logger.state_dict(), "world_size": 0}
            if hasattr(run.env, "progress_dict"):
                local["environment"] = run.env.progress_dict()
            write_learned(run, path, learned, local)

    def _record_loss(self, checkpoint: Path | None) -> None:
        reason, iteration = "lost a process", self._run.iteration
        self._run.record(TrainingOutcome(reason=reason, iteration=iteration, checkpoint=checkpoint, exit_code=2))
