"""Print what a jury of engines says of policies (``gaitgauge jury``)."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer
from rich.text import Text

from ..studies.jury.page import write_page
from ..studies.jury.request import JuryCost, JuryRequest, JuryStatus
from ..studies.jury.study import jury, prepare_jury
from ..studies.jury.verdict import OFF, command_words
from ..studies.naming import free_run_folder, joined_names
from .console import Terminal, make_table
from .policies import policy_files
from .progress import ProgressDisplay, duration
from .studies import resumable, show_results


def run_jury(request: JuryRequest, engines: str | None, *, out: Path | None, resume: bool, json_output: bool) -> None:
    """Judge policies, show progress, print the tables and where the files are."""
    usual = Path("results") / f"{joined_names(request.policies)}-jury-{request.part}"
    names = () if engines is None else tuple(engines.split(","))
    request = replace(request, engines=names, policies=policy_files(request.policies))
    console = Terminal(stderr=True)
    prepared = prepare_jury(request)  # all that can be wrong with the request is said before anything is written
    folder = out or free_run_folder(usual, *prepared.runs)
    for engine in prepared.skipped:
        console.say(f"{engine['engine']} does not judge: {engine['reason']}")
    with resumable(console, "judging", folder, "--resume") as display:
        command = ["gaitgauge", *sys.argv[1:]]
        results = jury(
            prepared,
            folder,
            resume=resume,
            command=command,
            watch=lambda s: _show(display, s),
            told=lambda c: _tell(console, c),
        )
        page = write_page(folder)
    show_results(results, print_jury, folder / "jury.json", page, json_output=json_output)
    unable = {engine["engine"]: engine["reason"] for block in results["policies"] for engine in block["unable"]}
    for name, reason in unable.items():
        console.say(f"{name} did not play to the end: {reason}")
    if unable:
        raise typer.Exit(1)


def _tell(console: Terminal, cost: JuryCost) -> None:
    """Print what is played, and how long that takes."""
    engines = f"{cost.engines} engines play" if cost.engines > 1 else "one engine plays"
    policies = f" for each of {cost.policies} policies" * (cost.policies > 1)
    steps = f"{cost.episodes} episodes{policies}, at most {cost.world_steps:,} steps of one world in each engine"
    console.say(f"{engines} {steps}; that takes about {duration(cost.seconds)}")


def _show(display: ProgressDisplay, status: JuryStatus) -> None:
    text = f"engine {status.number} of {status.count}, {status.engine}"
    text += ": measuring its speed" * (status.seconds_left is None)
    display.update(status.share, text, {"policy": status.policy}, left=status.seconds_left)


def print_jury(console: Terminal, results: Mapping[str, Any]) -> None:
    """Print for each policy scores by engine, speeds by command, and the verdict."""
    for block in results["policies"]:
        label = block["policy"]["label"]
        table = make_table(
            f"{label}: scores by engine", "engine", "family", "score", "95 % interval", "falls", numbers=True
        )
        table.columns[1].justify = "left"
        for name, engine in block["engines"].items():
            low, high = engine["score"]["interval"]
            score = f"{engine['score']['value']:.4f}"
            falls = f"{engine['falls']}/{engine['segments']}" if engine["falls"] else ""
            table.add_row(name, engine["family"], score, f"{low:.4f} to {high:.4f}", falls)
        console.print(table)
        table = make_table(f"{label}: share of the commanded speed", "command", *block["engines"], numbers=True)
        for row in block["speeds"]:
            cells = [
                Text("fell", "red") if v is None else Text(f"{v:.2f}", "red" if abs(v - 1.0) > OFF else "")
                for v in row["shares"].values()
            ]
            table.add_row(command_words(row), *cells)
        console.print(table)
        if block["training"]["note"]:
            console.say(f"{label}: {block['training']['note']}")
        for sentence in block["sentences"]:
            console.say(sentence)
