"""Keep trained runs in a form small enough to carry home and to commit.

``runs/<entry>/seed-<n>/kept/`` holds ``run.json`` with the settings, ``curves.csv``, ``policy.gauge.pt`` and, where it was gauged,
``results.json``, a score card of that policy; no checkpoints, no episodes, no machine's name and no command. A sweep does not train such
a run again: it gauges it where that is left, goes on with the others, and reports on all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...files.parsing import one_line
from ...files.provenance import without_place
from ...files.writing import json_text, make_folder, write_atomically
from ...policy.base import PolicyError
from ...policy.contract import ContractError
from ...policy.importing import import_policy
from ...studies.policies import file_digest
from .curves import kept_curves_csv, learning_curves
from .file import Sweep, SweepError
from .runs import KEPT, KEPT_CURVES, KEPT_POLICY, RESULTS, RUN_ERRORS, SweepRun, read_card, what_failed


def check_keep(runs: Sequence[SweepRun], folder: Path) -> None:
    """Find out before a training whether its run can be kept in a folder.

    Raises:
        SweepError: the folder holds trainings with other settings.
    """
    for run in runs:
        _in(folder, run).claim(option="--keep", note=False)


def keep_runs(sweep: Sweep, runs: Sequence[SweepRun], folder: Path) -> tuple[list[str], dict[str, str]]:
    """Keep trained runs in another folder, of a sweep of the same trainings. Return labels of the runs that were kept now, without earlier
    ones; and reasons why runs could not be kept, by label.
    """
    kept, failures = [], {}
    for run in runs:
        try:
            if run.trained and _keep(sweep, run, _in(folder, run)):
                kept.append(run.label)
        except RUN_ERRORS as error:
            failures[run.label] = what_failed(error)
    return kept, failures


def _in(folder: Path, run: SweepRun) -> SweepRun:
    """Return a run's counterpart in the folder that it is kept in."""
    return replace(run, folder=folder / "runs" / run.entry.name / f"seed-{run.seed}")


def _keep(sweep: Sweep, run: SweepRun, target: SweepRun) -> bool:
    """Write the small form of a run, its description, which identifies it, last; False where it is there already."""
    target.claim(option="--keep")
    gauged, there, place = run.gauged(sweep), target.trained, target.folder / KEPT
    if there and (target.gauged(sweep) or not gauged):
        return False
    if there and (place / RESULTS).is_file():
        raise SweepError(
            f"'{one_line(place / RESULTS)}' is of another suite or checkpoint, and a kept run has results of one; give another --keep"
        )
    directory, results, policy = run.directory, run.results(sweep), run.policy(sweep)
    assert directory is not None
    make_folder(place, SweepError, option="--keep")
    write_atomically(place / KEPT_CURVES, kept_curves_csv(learning_curves(directory)), SweepError)
    if policy is not None:  # a run that was kept and gauged may have been left without
        try:
            import_policy(policy, place / KEPT_POLICY)
        except (PolicyError, ContractError) as error:
            raise SweepError(run.damage(sweep) or str(error)) from error
    if results is not None and gauged:
        card = read_card(results)
        if policy is not None:
            kept = replace(card.policy, path=KEPT_POLICY, file_sha256=file_digest(str(place / KEPT_POLICY)))
            card = replace(card, policy=kept)
        card = replace(card, provenance=card.provenance.without_place())
        write_atomically(place / RESULTS, json_text(card.to_data()), SweepError)
    done = run.description() | {"outcome": "finished", "kept_iteration": run.wanted_iteration(sweep)}
    write_atomically(place / "run.json", json_text(_for_everybody(done)), SweepError)
    return True


def _for_everybody(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of a run without machine, commands and folders, in its resumes too."""
    found = without_place(description)
    if found.get("begun_with"):
        found["begun_with"] = Path(found["begun_with"]).name
    if found.get("resumed"):
        found["resumed"] = [without_place(note) for note in found["resumed"]]
    return found
