"""Scores and videos of a run's checkpoints: made in side processes, logged when they arrive, while the run goes on."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from .checkpoint import copy_checkpoint
from .filming import Filmer
from .run_directory import update_run_json
from .scoring import Scorer, ScoreReport
from .state import RunState

Side = TypeVar("Side", Scorer, Filmer)


class Beside(Generic[Side]):
    """A run and its side process, if it has one; without one, all methods do nothing."""

    def __init__(self, run: RunState, side: Side | None) -> None:
        """Begin with nothing asked for."""
        self._run = run
        self._side: Side | None = side

    @property
    def made(self) -> bool:
        """True where the run has the side process."""
        return self._side is not None

    @property
    def pending(self) -> bool:
        """True while a result is to come."""
        return self._side is not None and self._side.pending > 0

    def close(self) -> None:
        """Give up pending results."""
        if self._side is not None:
            self._side.close()


class Scores(Beside[Scorer]):
    """Scores of checkpoints, and the checkpoint with the best one."""

    _submitted = -1

    def begin(self) -> None:
        """Ask for no score of the present iteration: an earlier call of ``learn`` has done that."""
        self._submitted = self._run.iteration

    def submit(self, checkpoint: Path | None) -> None:
        """Ask the first process for the scores of a checkpoint, once for each iteration."""
        run = self._run
        if self._side is None or checkpoint is None or self._submitted == run.iteration or run.processes.rank:
            return
        self._submitted = run.iteration
        self._side.submit(checkpoint, run.iteration)

    def take(self, seconds: float = 0.0, stop: Callable[[], bool] = lambda: False) -> None:
        """Log scores at their checkpoints' iterations, after a wait of at most ``seconds`` [s], and keep the best checkpoint."""
        if self._side is None:
            return
        for report in self._side.drain(seconds, stop):
            if report.failure:
                self._run.message(f"No gauge score for iteration {report.iteration}: {report.failure}.")
            else:
                self._log(report, self._side.suite)

    def _log(self, report: ScoreReport, suite: str) -> None:
        run, wanted = self._run, self._run.configuration.run.gauge_score
        scalars = {f"Gauge/{suite}/{name}": value for name, value in report.scores.items()}
        run.logger.write(scalars, report.iteration)
        run.logger.scalars |= scalars
        score = report.scores.get(wanted)
        if score is None:
            names = ", ".join(report.scores) or "nothing"
            run.message(f"The gauge reports no {wanted!r} (training.run.gauge_score) but {names}.")
        elif math.isfinite(score) and (run.best_score is None or score > run.best_score):
            run.best_score, run.best_iteration = score, report.iteration
            if report.path.exists():
                copy_checkpoint(report.path, report.path.with_name("best.pt"))
            if run.log_dir is not None:
                update_run_json(run.log_dir, {"best_score": score, "best_iteration": report.iteration})
            run.message(f"Best gauge score so far: {score:.4f} at iteration {report.iteration}.")
        elif math.isfinite(score):
            run.message(
                f"Gauge score {score:.4f} at iteration {report.iteration}, best {run.best_score:.4f} at iteration {run.best_iteration}."
            )


class Videos(Beside[Filmer]):
    """Videos of checkpoints."""

    def submit(self, checkpoint: Path | None) -> None:
        """Ask for videos of a checkpoint, where checkpoints are filmed while the run goes on."""
        if self._side is not None and checkpoint is not None and self._side.every:
            self._side.submit(checkpoint, self._run.iteration)

    def finish(self, checkpoint: Path | None, seconds: float) -> None:
        """Ask for videos of the last checkpoint, where that is filmed; say so if there are no ``seconds`` to wait for them [s]."""
        if self._side is None or checkpoint is None or not self._side.last:
            return
        if seconds > 0.0:
            self._side.submit(checkpoint, self._run.iteration)
        else:
            self._run.message(
                "No film: the time limit leaves none for it; 'gaitgauge play latest --out film.mp4' makes one."
            )

    def take(self, seconds: float = 0.0, stop: Callable[[], bool] = lambda: False) -> None:
        """Log finished videos, after a wait of at most ``seconds`` [s]."""
        if self._side is None:
            return
        videos, sentence = self._side.take(seconds, stop)
        for video, iteration in videos:
            self._run.logger.send(video, iteration)
            self._run.message(f"Film: {video}")
        if sentence:
            self._run.message(sentence)
