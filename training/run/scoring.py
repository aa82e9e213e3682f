"""Gauging the student while it is being trained: the gauge's command line in a side process on the CPU."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ...files.choices import cores
from ...files.parsing import read_results
from ...gauge.result import Result
from ...gauge.suite import load_suite
from .side_process import CHILD_PROGRAM, Finished, Job, SideProcess

GAUGE_FOLDER = "gauge"
"""Folder of a run directory that holds what the gauge left behind, by suite and checkpoint."""


@dataclass(frozen=True, kw_only=True)
class ScoreReport:
    """The scores of one submitted checkpoint, or the reason why there are none."""

    path: Path
    iteration: int
    scores: Mapping[str, float]
    """Scores by name; empty if the gauging failed."""
    failure: str = ""
    """Why there are no scores, in one sentence."""


class Scorer:
    """Takes checkpoints, gives scores back later."""

    def __init__(self, run: Path, *, suite: str, threads: int | None = None) -> None:
        """Prepare.

        Args:
            run: run directory; results go to ``gauge/<suite>/<checkpoint>/`` in it.
            suite: name or ``.toml`` file of the suite.
            threads: CPU threads of the side process, None for half of the machine, since training needs the others.

        Raises:
            SuiteError: no such suite.
        """
        self.suite = load_suite(suite).name
        """Name in the log keys ``Gauge/<suite>/<score>``."""
        self._asked = suite
        self._threads = threads or max(1, cores() // 2)
        self._folder = run / GAUGE_FOLDER / self.suite
        self._side = SideProcess()

    def submit(self, path: Path, iteration: int) -> None:
        """Ask for the scores of a checkpoint, which stays where it is until they are back."""
        out = self._folder / path.stem
        # A resumed run may come by the same iteration again, with other weights.
        shutil.rmtree(out, ignore_errors=True)
        options = ["--suite", self._asked, "--json", "--no-clip", "--threads", str(self._threads), "--out", str(out)]
        command, output = [*CHILD_PROGRAM, "evaluate", str(path), *options], self._folder / f"{path.stem}.json"
        self._side.submit(Job(command=command, checkpoint=path, iteration=iteration, output=output))

    @property
    def pending(self) -> int:
        """Number of submitted checkpoints that have not been reported."""
        return self._side.pending

    def drain(self, seconds: float, stop: Callable[[], bool] = lambda: False) -> list[ScoreReport]:
        """Reports that arrived since the last call, after waiting for all that is pending, at most ``seconds`` [s], until ``stop``
        says so.
        """
        return [_report(finished) for finished in self._side.drain(seconds, stop)]

    def close(self) -> None:
        """Give up what is pending."""
        self._side.close()


def _report(finished: Finished) -> ScoreReport:
    job, failure = finished.job, finished.failure
    scores: Mapping[str, float] = {}
    if failure == "skipped":
        failure = "skipped: gauging is slower than training; raise gauge_interval"
    elif not failure:
        try:
            scores = scores_of(Result.from_data(read_results(job.output, "results", ValueError), "it", ValueError))
        except ValueError as error:
            failure = f"the gauge's output {job.output} cannot be read: {error}"
    return ScoreReport(path=job.checkpoint, iteration=job.iteration, scores=scores, failure=failure)


def scores_of(result: Result) -> Mapping[str, float]:
    """Return what is worth a curve in a result: the score, each terrain's level and score, the groups of metrics.

    Raises:
        ValueError: the result holds no score.
    """
    if result.score is None:
        raise ValueError("there is no score in it")
    scores = {"score": result.score}
    for terrain, row in result.terrains.items():
        if row.level is not None:
            scores[f"level/{terrain}"] = row.level
        if row.mean is not None:
            scores[f"terrain/{terrain}"] = row.mean
    return scores | {f"group/{name}": value for name, value in result.groups.items()}
