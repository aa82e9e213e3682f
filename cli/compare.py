"""``gaitgauge compare``: evaluates what has to be, then one sentence for each pair and a table of differences."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.text import Text

from ..gauge.request import EvaluationOptions, Request
from ..studies.compare.comparison import format_p
from ..studies.compare.contestants import compare_all, is_result
from ..studies.naming import joined_names
from .console import Terminal, make_table, print_json
from .evaluate import shower
from .policies import policy_files
from .studies import resumable


def run_comparison(
    contestants: Sequence[str], choices: EvaluationOptions, *, out: Path | None, json_output: bool
) -> None:
    """Compare, show progress, print which differences are real and where the files are."""
    files = [each if is_result(each) else policy_files([each])[0] for each in contestants]
    request = Request(policy=files[0], **vars(choices))
    work = partial(compare_all, files, request)
    show_comparison(work, f"compare-{joined_names(contestants)}", out=out, json_output=json_output)


def show_comparison(
    work: Callable[..., tuple[dict[str, Any], dict[str, Path]]], name: str, *, out: Path | None, json_output: bool
) -> None:
    """Do the work of a comparison, show progress, print which differences are real and where the files are."""
    console = Terminal(stderr=True)
    with resumable(console, "gauging") as display:
        found, paths = work(
            folder=out or Path("results") / name,
            overwrite=out is not None,
            runs=out or Path("results"),
            command=["gaitgauge", *sys.argv[1:]],
            watch=shower(display),
            say=console.say,
        )
    if json_output:
        print_json(found)
        return
    output = Terminal()
    print_comparison(output, found)
    for kind, path in paths.items():
        output.say(f"{kind:5}{path}")


def print_comparison(console: Terminal, found: Mapping[str, Any]) -> None:
    """Print a table of differences for each pair, then the real ones in sentences."""
    for first, second in dict.fromkeys((d["first"], d["second"]) for d in found["differences"]):
        columns = ("", "of", first, second, "difference", "95 % interval", "corrected p")
        table = make_table(f"{second} against {first}: mean@50", *columns, numbers=True)
        table.columns[1].justify = "left"
        before = None
        for d in (d for d in found["differences"] if (d["first"], d["second"]) == (first, second)):
            low_high = "one seed" if d["interval"] is None else "{:+.4f} to {:+.4f}".format(*d["interval"])
            table.add_row(
                "" if d["kind"] == before else d["kind"],
                d["name"],
                *(f"{v:.4f}" for v in d["values"]),
                f"{d['difference']:+.4f}",
                low_high,
                format_p(d["corrected"]).removeprefix("= "),
                style="bold" if d["real"] else None,
            )
            before = d["kind"]
        console.print(table)
    for sentence in found["sentences"]:
        console.say(Text(sentence))
