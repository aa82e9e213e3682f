"""Print what logs of real robots say: replays, identified parameters, a preflight (``gaitgauge replay`` and others)."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ..gauge.request import EvaluationOptions, Request
from ..studies.naming import joined_names
from ..studies.reality.identifying import identify_robot
from ..studies.reality.page import UNITS
from ..studies.reality.preflight import preflight
from ..studies.reality.replaying import label_of, replay
from ..studies.reality.request import IdentifyRequest, PreflightRequest, ReplayRequest
from ..studies.reality.scoring import score_sets
from .compare import show_comparison
from .console import Terminal, make_table, print_json
from .errors import UserError
from .studies import keep_others, own_folder, study_folder, study_in


def run_replay(request: ReplayRequest, *, out: Path | None, json_output: bool) -> None:
    """Replay logs, print a table for each and where the files are."""
    name, data = "replay", "replay.json"
    folder = study_folder(name, data, out=out, of=_names(request.logs))
    study_in(folder, name, name, replay, print_replay, request, data=data, json_output=json_output)


def run_identify(request: IdentifyRequest, *, out: Path | None, json_output: bool) -> None:
    """Identify a robot, print its constants, what the logs do not tell, and residuals beside nominal ones."""
    name, data = "identify", "identify.json"
    folder = study_folder(name, data, out=out, of=_names(request.logs))
    study_in(folder, name, name, identify_robot, print_identified, request, data=data, json_output=json_output)
    if not json_output:
        Terminal().say(f"set      {folder / request.name}.toml")


def run_preflight(request: PreflightRequest, *, out: Path | None, json_output: bool) -> bool:
    """Check a log against a policy, print a line for each check; return False where one is wrong."""
    folder = study_folder("preflight", "preflight.json", out=out, of=_names([request.log]))
    with own_folder(folder):
        keep_others(folder / "preflight.json")
        results = preflight(request, folder, command=["gaitgauge", *sys.argv[1:]])
    if json_output:
        print_json(results)
        return bool(results["passed"])
    console = Terminal()
    log = results["log"]
    console.say(f"{log['name']}: {log['defects']}; {log['held'] or 'held in an unknown way'}")
    table = make_table(f"preflight of {results['policy']} on {results['robot']}", "check", "", "")
    for finding in results["findings"]:
        style = {"wrong": "bold red", "not told": "dim"}.get(finding["verdict"])
        table.add_row(finding["check"], finding["verdict"], finding["sentence"], style=style)
    console.print(table)
    console.say(f"results  {folder / 'preflight.json'}")
    console.say(f"page     {folder / 'preflight.html'}")
    return bool(results["passed"])


def run_measured(
    policy: str, choices: EvaluationOptions, sets: Sequence[str], *, out: Path | None, json_output: bool
) -> None:
    """Evaluate under each set, print differences, where the files are, and which constants training never saw."""
    if choices.parameters is not None:
        raise UserError("--parameters is not for this command; name the parameter sets behind the policy")
    request = Request(policy=policy, **vars(choices))
    work = partial(score_sets, request, sets)
    show_comparison(work, f"measured-{joined_names([policy])}", out=out, json_output=json_output)


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


def print_identified(console: Terminal, results: Mapping[str, Any]) -> None:
    """Print the constants with their intervals, and each log's residuals as shares of the nominal set's."""
    table = make_table(
        f"{results['robot']}: identified from base set {results['base']}",
        "constant",
        "nominal",
        "identified",
        "98 % interval",
        "",
        numbers=True,
    )
    for entry in results["unknowns"]:
        low, high = entry["interval"]
        told = (
            (f"{entry['value']:.4g}", f"{low:.4g} to {high:.4g}", entry["unit"])
            if entry["known"]
            else ("not told", "", "")
        )
        table.add_row(entry["label"], f"{entry['nominal']:.4g}", *told)
    console.print(table)
    groups = list(results["logs"][0]["ratios"])
    table = make_table(
        "RMS difference, nominal = 1", "log", "delay [ms]", *groups, *(f"{g} torque" for g in groups), numbers=True
    )
    for log in results["logs"]:
        for words, entry in ((log["name"], log), ("  judged on it, fitted on the others", log.get("held_out"))):
            if entry is not None:
                cells = [entry["ratios"][g].get(q) for q in ("position", "torque") for g in groups]
                table.add_row(words, f"{1e3 * entry['delay']:.1f}", *("" if c is None else f"{c:.2f}" for c in cells))
    console.print(table)
    for note in results["notes"]:
        console.say(note)
