"""What is kept of runs that are trained, small enough to carry home and to commit.

``runs/<entry>/seed-<n>/kept/`` holds ``run.json`` with the settings, ``curves.csv``, ``policy.gauge.pt`` and, where it was gauged,
``results.json``, a score card of that policy; no checkpoints, no episodes, no machine's name and no command. A sweep does not train
such a run again: it gauges it where that is left, goes on with the others, and reports on all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...files.provenance import without_place
from ...files.writing import json_text, make_folder, write_atomically
from ...gauge.comparison import load_result
from ...gauge.policies import file_digest
from ...policy.importing import import_policy
from ..run_directory import read_run_json
from .curves import kept_curves_csv, learning_curves
from .file import Sweep, SweepError
from .runs import KEPT, KEPT_CURVES, KEPT_POLICY, RESULTS, SweepRun


def keep_runs(sweep: Sweep, runs: Sequence[SweepRun], folder: Path) -> list[str]:
    """Keep what is trained in another folder, beside what it holds already.

    Args:
        folder: another one, of a sweep of the same trainings.

    Returns:
        Labels of the runs that were kept now; what was kept before is left as it is.

    Raises:
        SweepError: the folder holds trainings with other settings, or cannot be written to.
        CheckpointError, ComparisonError, PolicyError: a file of a run is damaged.
    """
    kept = []
    for run in runs:
        if not run.trained:
            continue
        target = replace(run, folder=folder / "runs" / run.entry.name / f"seed-{run.seed}")
        target.claim()
        if not target.trained or (run.gauged(sweep) and not target.gauged(sweep)):
            _keep(sweep, run, target.folder / KEPT)
            kept.append(run.label)
    return kept


def _keep(sweep: Sweep, run: SweepRun, place: Path) -> None:
    """Write the small form of a run; its description, by which it is known, comes last."""
    directory, results, policy = run.directory, run.results(sweep), run.policy(sweep)
    assert directory is not None
    make_folder(place, SweepError)
    write_atomically(place / KEPT_CURVES, kept_curves_csv(learning_curves(directory)), SweepError)
    if policy is not None:  # a run that was kept and gauged may have been left without
        import_policy(policy, place / KEPT_POLICY)
    if results is not None and run.gauged(sweep):
        card = load_result(results)
        if policy is not None:
            of_policy = {"path": KEPT_POLICY, "file_sha256": file_digest(str(place / KEPT_POLICY))}
            card["policy"] = {**card["policy"], **of_policy}
        card["provenance"] = without_place(card["provenance"])
        write_atomically(place / RESULTS, json_text(card), SweepError)
    write_atomically(place / "run.json", json_text(without_place(read_run_json(directory))), SweepError)
