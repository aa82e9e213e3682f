"""Gauging the student while it is being trained.

A scorer takes checkpoints and gives scores back, now or later; the runner logs them beside the reward and keeps the
best checkpoint.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Evaluate = Callable[[Path, int], Mapping[str, float]]
"""Takes a checkpoint and its iteration, returns scores by name."""


@dataclass(frozen=True, kw_only=True)
class ScoreReport:
    """What became of one submitted checkpoint."""

    path: Path
    iteration: int
    scores: Mapping[str, float]
    """Scores by name; empty if the gauging failed."""
    seconds: float
    """How long it took [s]."""
    failure: str = ""
    """Why there are no scores, in one sentence."""


class Scorer(ABC):
    """Gauges checkpoints under the name of one suite."""

    suite: str
    """Name in the log keys ``Gauge/<suite>/<score>``."""

    @abstractmethod
    def submit(self, path: Path, iteration: int) -> None:
        """Ask for the scores of a checkpoint, which stays where it is until they are back."""

    @abstractmethod
    def poll(self) -> list[ScoreReport]:
        """Reports that arrived since the last call, without waiting."""

    @property
    @abstractmethod
    def pending(self) -> int:
        """How many submitted checkpoints have not been reported."""

    def drain(self, seconds: float) -> list[ScoreReport]:
        """Wait for everything that is pending, at most ``seconds`` [s]."""
        deadline = time.monotonic() + seconds
        reports = self.poll()
        while self.pending and time.monotonic() < deadline:
            time.sleep(0.2)
            reports += self.poll()
        return reports

    def close(self) -> None:  # noqa: B027 (most scorers hold nothing)
        """Give up what is pending."""


class FunctionScorer(Scorer):
    """Calls a function in the training process, which waits for it: for a quick suite on the training device."""

    def __init__(self, evaluate: Evaluate, *, suite: str) -> None:
        """Score with ``evaluate``."""
        self.suite = suite
        self._evaluate = evaluate
        self._reports: list[ScoreReport] = []

    def submit(self, path: Path, iteration: int) -> None:
        """Score at once."""
        start = time.monotonic()
        scores = self._evaluate(path, iteration)
        self._reports.append(
            ScoreReport(path=path, iteration=iteration, scores=scores, seconds=time.monotonic() - start)
        )

    def poll(self) -> list[ScoreReport]:
        """See ``Scorer``."""
        reports, self._reports = self._reports, []
        return reports

    @property
    def pending(self) -> int:
        """See ``Scorer``."""
        return len(self._reports)


class ProcessScorer(Scorer):
    """Runs a command that prints JSON, one at a time, in a side process: for the full suite on the CPU while the GPU
    trains.
    """

    def __init__(
        self,
        command: Callable[[Path], Sequence[str]],
        *,
        suite: str,
        folder: Path,
        parse: Callable[[Any], Mapping[str, float]] | None = None,
        max_waiting: int = 4,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Prepare.

        Args:
            command: the command line for a checkpoint; it prints one JSON document to its standard output.
            suite: name in the log keys.
            folder: where ``model_<iteration>.json`` and ``.log`` (standard error) are kept.
            parse: takes the scores out of the document; None takes every number, nested names joined by dots.
            max_waiting: checkpoints that may wait for their turn; beyond, the oldest is reported as skipped.
            environment: added to the process's environment variables.
        """
        self.suite = suite
        self._command = command
        self._folder = folder
        self._parse = parse or flat_numbers
        self._max_waiting = max_waiting
        self._environment = {**os.environ, **(environment or {})}
        self._waiting: deque[tuple[Path, int]] = deque()
        self._running: tuple[Path, int, subprocess.Popen[bytes], float] | None = None
        self._reports: list[ScoreReport] = []

    def submit(self, path: Path, iteration: int) -> None:
        """See ``Scorer``."""
        self._waiting.append((path, iteration))
        if len(self._waiting) > self._max_waiting:
            skipped, skipped_iteration = self._waiting.popleft()
            failure = "skipped: gauging is slower than training; raise gauge_interval"
            self._reports.append(
                ScoreReport(path=skipped, iteration=skipped_iteration, scores={}, seconds=0.0, failure=failure)
            )
        self._start_next()

    def poll(self) -> list[ScoreReport]:
        """See ``Scorer``."""
        if self._running is not None:
            path, iteration, process, start = self._running
            code = process.poll()
            if code is not None:
                self._running = None
                self._reports.append(self._report(path, iteration, code, time.monotonic() - start))
        self._start_next()
        reports, self._reports = self._reports, []
        return reports

    @property
    def pending(self) -> int:
        """See ``Scorer``."""
        return len(self._waiting) + (self._running is not None) + len(self._reports)

    def close(self) -> None:
        """Stop the running process and forget the waiting ones."""
        self._waiting.clear()
        if self._running is not None:
            process = self._running[2]
            self._running = None
            process.terminate()
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _file(self, iteration: int, ending: str) -> Path:
        return self._folder / f"model_{iteration}.{ending}"

    def _start_next(self) -> None:
        if self._running is not None or not self._waiting:
            return
        path, iteration = self._waiting.popleft()
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._file(iteration, "json").open("wb") as out, self._file(iteration, "log").open("wb") as log:
            try:
                # A session of its own: Ctrl-C in the terminal is for the training, which decides what becomes of the
                # gauging.
                process = subprocess.Popen(
                    list(self._command(path)), stdout=out, stderr=log, env=self._environment, start_new_session=True
                )
            except OSError as error:
                failure = f"cannot start {self._command(path)[0]}: {error.strerror}"
                self._reports.append(
                    ScoreReport(path=path, iteration=iteration, scores={}, seconds=0.0, failure=failure)
                )
                return
        self._running = (path, iteration, process, time.monotonic())

    def _report(self, path: Path, iteration: int, code: int, seconds: float) -> ScoreReport:
        scores: Mapping[str, float] = {}
        failure = ""
        if code != 0:
            failure = f"the gauge ended with exit code {code}; see {self._file(iteration, 'log')}"
        else:
            try:
                scores = self._parse(json.loads(self._file(iteration, "json").read_text()))
            except (json.JSONDecodeError, KeyError, TypeError, ValueError, OSError) as error:
                failure = f"the gauge's output {self._file(iteration, 'json')} cannot be read: {error}"
        return ScoreReport(path=path, iteration=iteration, scores=scores, seconds=seconds, failure=failure)


def flat_numbers(document: Any, prefix: str = "") -> dict[str, float]:
    """All numbers of a JSON document by dotted name; lists are left out."""
    if isinstance(document, Mapping):
        numbers: dict[str, float] = {}
        for key, value in document.items():
            numbers |= flat_numbers(value, f"{prefix}.{key}" if prefix else str(key))
        return numbers
    if isinstance(document, int | float) and not isinstance(document, bool):
        return {prefix: float(document)}
    return {}
