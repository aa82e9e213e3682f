"""``gaitgauge trial``: robots go through field trials; a table of how many came through, beside what others report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..studies.naming import joined_names
from ..studies.trials.page import measures, percent, reported
from ..studies.trials.request import TrialRequest
from ..studies.trials.trialling import run_trials
from .console import Terminal, make_table
from .policies import policy_files
from .studies import make_study


def run_trial(request: TrialRequest, *, out: Path | None, json_output: bool) -> None:
    """Run the trials, show progress, print the table and where the files are; exit code 1 where something was left out."""
    folder = out or Path("results") / f"trial-{joined_names(request.policies)}"
    request = replace(request, policies=policy_files(request.policies))
    files = ("trials.json", "trial.html")
    make_study(run_trials, request, folder, title="trying", show=print_trials, files=files, json_output=json_output)


def print_trials(console: Terminal, results: Mapping[str, Any]) -> None:
    """One line for each policy in each scenario."""
    columns = ("scenario", "policy", "through", "95 % interval", "fell", "missed", "medians", "reported")
    table = make_table("field trials", *columns)
    notes: dict[str, None] = {}
    for entry in results["scenarios"]:
        for i, result in enumerate(entry["results"]):
            table.add_row(
                "" if i else entry["name"],
                result["policy"],
                f"{result['successes']}/{result['trials']}",
                percent(result["interval"]),
                str(result["fell"] or ""),
                str(result["missed"] or ""),
                measures(result),
                "" if i else reported(entry["reported"]),
            )
            if result["note"]:
                notes[f"{result['policy']} in {entry['name']}: {result['note']}"] = None
    console.print(table)
    for note in notes:
        console.say(note)
