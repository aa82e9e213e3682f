"""The gauge's command line as the scorer of a training run: checkpoints are scored in a side process on the CPU."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..gauge.suite import load_suite
from .scoring import ProcessScorer

GAUGE_FOLDER = "gauge"
"""Folder of a run directory that holds what the gauge left behind, by suite and checkpoint."""


def default_score_threads() -> int:
    """CPU threads for the side process: half of the machine, since training needs the others."""
    return max(1, (os.cpu_count() or 2) // 2)


def gauge_scorer(run: Path, *, suite: str, threads: int | None = None) -> ProcessScorer:
    """A scorer that runs ``gaitgauge evaluate`` with a suite on the CPU engine.

    Args:
        run: run directory; results go to ``gauge/<suite>/<checkpoint>/`` in it.
        suite: name or ``.toml`` file of the suite.
        threads: CPU threads of the side process, None for half of the machine.

    Raises:
        SuiteError: no such suite.
    """
    name = load_suite(suite).name
    folder = run / GAUGE_FOLDER / name

    def command(checkpoint: Path) -> list[str]:
        out = folder / checkpoint.stem
        # A resumed run may come by the same iteration again, with other weights.
        shutil.rmtree(out, ignore_errors=True)
        options = ["--suite", suite, "--json", "--threads", str(threads or default_score_threads()), "--out", str(out)]
        return [sys.executable, "-m", f"{_PACKAGE}.cli.main", "evaluate", str(checkpoint), *options]

    # The side process has no business on the GPU that trains.
    hidden = {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    return ProcessScorer(command, suite=name, folder=folder, parse=scores_of, max_waiting=1, environment=hidden)


_PACKAGE = __name__.partition(".")[0]


def scores_of(results: Any) -> Mapping[str, float]:
    """What is worth a curve in a ``results.json``: the score, each terrain's level and score, the groups of metrics.

    Raises:
        ValueError: the results hold no score.
    """
    if results.get("score") is None:
        raise ValueError("there is no score in it")
    scores = {"score": float(results["score"])}
    for terrain, row in results["terrains"].items():
        if row.get("level") is not None:
            scores[f"level/{terrain}"] = float(row["level"])
        if "mean" in row:
            scores[f"terrain/{terrain}"] = float(row["mean"])
    return scores | {f"group/{name}": float(value) for name, value in results["groups"].items()}
