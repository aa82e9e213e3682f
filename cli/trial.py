"""Print field trials: how many robots came through, beside published figures (``gaitgauge trial``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..studies.trials.page import measures, percent, reported
from ..studies.trials.request import TrialRequest
from ..studies.trials.trialling import run_trials
from .console import Terminal, make_table
from .studies import make_study


def run_trial(request: TrialRequest, *, out: Path | None, json_output: bool) -> None:
    """Run the trials, show progress, print the table and where the files are; exit code 1 where something was left out."""
    names = ("trial", "trials.json", "trying")
    make_study(*names, run_trials, print_trials, request, out=out, json_output=json_output)


def print_trials(console: Terminal, results: Mapping[str, Any]) -> None:
    """Print a line for each policy in each scenario."""
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
