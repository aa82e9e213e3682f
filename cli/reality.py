"""Print what logs of real robots say: replays, identified parameters, a preflight (``gaitgauge replay`` and others)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..studies.reality.page import UNITS
from ..studies.reality.replaying import label_of, replay
from ..studies.reality.request import ReplayRequest
from .console import Terminal, make_table, print_json
from .progress import ProgressDisplay
from .studies import own_folder


def run_replay(request: ReplayRequest, *, out: Path | None, json_output: bool) -> None:
    """Replay logs, print a table for each and where the files are."""
    folder = out or Path("results") / f"replay-{_names(request.logs)}"
    _make("replay", replay, print_replay, request, folder, json_output)


def _make(
    name: str,
    study: Callable[..., Mapping[str, Any]],
    show: Callable[[Terminal, Mapping[str, Any]], None],
    request: Any,
    folder: Path,
    json_output: bool,
) -> None:
    errors = Terminal(stderr=True)
    with own_folder(folder), ProgressDisplay(errors, name) as display:
        results = study(
            request,
            folder,
            command=["gaitgauge", *sys.argv[1:]],
            watch=lambda turn, turns, what: display.update((turn - 1) / turns, f"{turn} of {turns}: {what}"),
        )
    if json_output:
        print_json(results)
        return
    console = Terminal()
    show(console, results)
    console.say(f"results  {folder / name}.json\npage     {folder / name}.html")


def _names(logs: Sequence[Path]) -> str:
    return "-".join(path.stem for path in logs[:2])[:80]


def print_replay(console: Terminal, results: Mapping[str, Any]) -> None:
    """Print a table for each log and quantity: RMS differences with intervals, and ratios to the first row."""
    for log in results["logs"]:
        console.say(f"{log['name']}: {log['defects']}; {log['held']}")
        for note in log["notes"]:
            console.say(f"  {note}")
        groups = list(log["variants"][0]["groups"])
        for quantity, (unit, scale) in UNITS.items():
            if quantity not in log["variants"][0]["groups"][groups[0]]:
                continue
            columns = [part for group in groups for part in (group, "ratio")]
            table = make_table(f"RMS difference of {quantity} [{unit}]", "parameters", *columns, numbers=True)
            for entry in log["variants"]:
                cells = []
                for group in groups:
                    found = entry["groups"][group][quantity]
                    low, high = (scale * v for v in found["interval"])
                    ratio = found.get("ratio")
                    cells += [
                        f"{scale * found['rms']:.3g} [{low:.3g}, {high:.3g}]",
                        "" if ratio is None else f"{ratio['value']:.2f}",
                    ]
                table.add_row(label_of(entry), *cells)
            floors = [log["floor"]["groups"][group].get(quantity) for group in groups]
            if None not in floors:
                table.add_row(
                    f"floor: {log['floor']['of']}", *(part for f in floors for part in (f"{scale * f:.2g}", ""))
                )
            console.print(table)
