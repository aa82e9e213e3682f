"""Print what a search for failures found, and film it (``gaitgauge worst``)."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..studies.naming import joined_names
from ..studies.worst.request import WorstRequest, WorstStatus
from .console import Terminal, make_table
from .errors import UserError
from .picture import Quality, choose_renderer
from .policies import policy_files
from .progress import ProgressDisplay
from .studies import resumable, show_results

_FILMED = 0.15
"""Share of the budget that is left for films."""


def run_worst(
    request: WorstRequest, others: str | None, *, films: bool, out: Path | None, resume: bool, json_output: bool
) -> None:
    """Search, show progress, film the gallery, print the table and where the files are."""
    if others is not None:
        request = replace(request, others=tuple(name.strip() for name in others.split(",") if name.strip()))
    request = replace(request, policy=policy_files((request.policy,))[0])
    console = Terminal(stderr=True)
    quality = _quality(console) if films else None  # before MuJoCo is imported
    from ..studies.worst.page import write_page
    from ..studies.worst.prepared import free_search_folder, prepare_search
    from ..studies.worst.study import search_worst

    prepared = prepare_search(request)  # all that can be wrong with the request is said before anything is written
    folder = out or free_search_folder(Path("results") / f"worst-{joined_names([request.policy])}", prepared)
    for engine in prepared.skipped:
        console.say(f"{engine['engine']} does not play failures again: {engine['reason']}")
    with resumable(console, "searching", folder, "--resume") as display:
        display.closing = 0.0  # the budget holds all of it
        results = search_worst(
            prepared,
            folder,
            resume=resume,
            reserve=_FILMED if quality else 0.0,
            command=["gaitgauge", *sys.argv[1:]],
            watch=lambda status: _show(display, status),
        )
        if quality:
            from .scenario_films import film_failures

            results = film_failures(prepared, folder, quality, lambda share, text: display.update(share, text))
        page = write_page(folder)
    show_results(results, print_worst, folder / "worst.json", page, json_output=json_output)


def _quality(console: Terminal) -> Quality | None:
    try:
        return choose_renderer()
    except UserError as error:
        console.say(f"no films: {error}")
        return None


def _show(display: ProgressDisplay, status: WorstStatus) -> None:
    details = {"plays": str(status.played), "falls": str(status.fallen)}
    display.update(status.share, status.stage, details, left=status.seconds_left)


def print_worst(console: Terminal, results: Mapping[str, Any]) -> None:
    """Print the failures of the gallery, and the findings in sentences."""
    engines = [results["engine"], *(other["engine"] for other in results["others"])]
    table = make_table(
        "falls that differ in cause, those of the fewest conditions first", "", "conditions", "after", *engines
    )
    ranked = [failure for failure in results["failures"] if failure["rank"] is not None]
    for failure in sorted(ranked, key=lambda f: f["rank"]):
        shares = [f"{sum(failure['again'][name])}/{len(failure['again'][name])}" for name in engines]
        words = "; ".join(failure["words"]) or "nothing unusual"
        table.add_row(str(failure["rank"]), words, f"{failure['seconds']:.1f} s", *shares)
    if ranked:
        console.print(table)
    for sentence in results["sentences"]:
        console.say(sentence)
