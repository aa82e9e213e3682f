"""``gaitgauge trial``: robots go through field trials; a table of how many came through, beside what others report."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from ..backends.registry import choose_device
from ..gauge.trials.page import measures, percent, reported
from ..gauge.trials.trialling import ALL, TrialRequest, run_trials
from .console import Terminal, make_table
from .errors import UserError
from .policies import policy_file
from .progress import ProgressDisplay


def run_trial(
    *,
    policies: Sequence[str],
    scenarios: Sequence[str],
    backend: str,
    device: str | None,
    threads: int | None,
    out: Path | None,
    json_output: bool,
    **choices: Any,
) -> None:
    """Run the trials, show progress, print the table and where the files are; exit code 1 where something was left out."""
    request = TrialRequest(
        policies=tuple(str(policy_file(p)) if Path(p).is_dir() else p for p in policies),
        scenarios=tuple(scenarios) or (ALL,),
        backend=backend,
        device=choose_device(backend, device),
        threads=threads or os.cpu_count() or 1,
        **choices,
    )
    names = "-".join(Path(p).name.partition(".")[0] for p in policies[:3])
    folder = out or Path("results") / f"trial-{names}"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"'{folder}' is a file; give another folder with --out")
    errors = Terminal(stderr=True)
    with ProgressDisplay(errors, "trying") as display:
        results = run_trials(
            request,
            folder,
            command=["gaitgauge", *sys.argv[1:]],
            watch=lambda turn, turns, name: display.update((turn - 1) / turns, f"{turn} of {turns}: {name}"),
        )
    if json_output:
        print(json.dumps(results, indent=1))
    else:
        console = Terminal()
        print_trials(console, results)
        console.say(f"results  {folder / 'trials.json'}\npage     {folder / 'trial.html'}")
    for refused in results["refused"]:
        errors.say(f"{refused['what']} was left out: {refused['reason']}")
    if results["refused"]:
        raise typer.Exit(1)


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
