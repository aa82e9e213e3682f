"""``gaitgauge consistency``: live progress, then tables of where engines disagree."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.text import Text

from ..files.parsing import bare_name
from ..studies.consistency.page import FIELD_LABELS, TESTS, cause, difference_of_fields, verdict, write_page
from ..studies.consistency.request import StudyCost, StudyRequest, StudyStatus
from ..studies.consistency.study import prepare_study, study
from ..studies.naming import free_run_folder, joined_names
from .console import Terminal, make_table, print_json
from .policies import policy_files
from .progress import ProgressDisplay, duration
from .studies import resumable


def run_consistency(
    request: StudyRequest, backends: str | None, *, out: Path | None, resume: bool, json_output: bool
) -> None:
    """Make the study, show progress, print the tables and where the files are."""
    named = () if backends is None else tuple(backends.split(","))
    usual = Path("results") / f"{joined_names(request.policies)}-{bare_name(request.suite)}-consistency"
    request = replace(request, backends=named, policies=policy_files(request.policies))
    console = Terminal(stderr=True)
    prepared = prepare_study(request)  # all that can be wrong with the request is said before anything is written
    _print_skipped(console, prepared.skipped)
    folder = out or free_run_folder(usual, *prepared.runs)
    with resumable(console, "comparing", folder, "--resume") as display:
        own = ["gaitgauge", *sys.argv[1:]]
        results = study(
            prepared, folder, resume=resume, command=own, watch=partial(_show, display), told=partial(_tell, console)
        )
        page = write_page(folder)
    if json_output:
        _print_skipped(console, results["skipped"][len(prepared.skipped) :])  # those that failed while they played
        print_json(results)
        return
    console = Terminal()
    print_study(console, results)
    console.say(f"results  {folder / 'consistency.json'}\npage     {page}")


def _show(display: ProgressDisplay, status: StudyStatus) -> None:
    text = f"run {status.part} of {status.parts}, {status.variant}: {status.done} of {status.episodes} episodes"
    if status.seconds_left is None:
        text = f"measuring the speed of {status.variant}"
    display.update(status.share, text, {"policy": status.policy}, left=status.seconds_left)


def _tell(console: Terminal, cost: StudyCost) -> None:
    """Print what the study takes, and what more would."""
    console.say(f"{cost.runs} runs of {cost.episodes} episodes take about {duration(cost.seconds)}")
    if cost.more:
        more = "; ".join(f"{option} about {duration(seconds)}" for option, seconds in cost.more.items())
        console.say(f"in all it would take with {more}")


def _print_skipped(console: Terminal, skipped: Sequence[Mapping[str, str]]) -> None:
    for engine in skipped:
        console.say(f"{engine['backend']} is left out: {engine['reason']}")


def print_study(console: Terminal, results: Mapping[str, Any]) -> None:
    """Print tables of every layer, the gap last, and the engines that are missing from them."""
    for policy in results["policies"]:
        if len(results["policies"]) > 1:
            console.rule(policy["policy"])
        _print_models(console, policy["models"], results)
        _print_open_loop(console, policy["open_loop"])
        for label, pair in policy["pairs"].items():
            _print_pair(console, results["reference"], label, pair)
            _print_commands(console, results["reference"], label, pair["commands"])
        _print_attribution(console, policy["attribution"])
        _print_gaps(console, policy)
        for label, pair in policy["pairs"].items():
            console.say(Text.assemble((label, "bold"), f": {verdict(pair['overall'], results['margin'])}"))
        for label, health in policy["health"].items():
            words = {"diverged": "diverged", "overflowed": "dropped contacts"}
            troubles = [f"{health[key]} {word}" for key, word in words.items() if health[key]]
            if troubles:
                found = f": of {health['episodes']} episodes {' and '.join(troubles)}"
                console.say(Text.assemble((label, "red"), found))
    _print_skipped(console, results["skipped"])


def _print_models(console: Terminal, models: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    labels = results["compared"]
    title = f"models: the largest difference from {models['reference']}"
    table = make_table(title, "field", *labels, numbers=True)
    for key, row in models["fields"].items():
        cells: list[str | Text] = []
        for label in labels:
            found = row["variants"].get(label)
            if found is None:
                cells.append("not described")
            elif found["agrees"]:
                cells.append("same")
            else:
                cells.append(Text(difference_of_fields(found), "red"))
        table.add_row(FIELD_LABELS[key], *cells)
    if models["fields"]:
        console.print(table)
    if models["not_described"]:
        console.say(f"models not described by {', '.join(models['not_described'])}")


def _print_open_loop(console: Terminal, block: Mapping[str, Any]) -> None:
    columns = ("engine", "test", "bases apart", "joints apart", "energy", "1 cm apart after", "weight at rest")
    table = make_table("open loop: after the same joint targets", *columns, numbers=True)
    for label, tests in block["differences"].items():
        for test in TESTS:
            row = tests[test]
            end, apart = row["end"], row["apart"]["0.01"]
            support = row.get("support")
            table.add_row(
                label,
                test,
                _unit(end["position"], "m"),
                _unit(end["joints"], "rad"),
                _unit(end["energy"], "J"),
                "never" if apart is None else f"{apart:.2f} s",
                "" if support is None or support[1] is None else f"{100 * support[1]:.2f} %",
            )
    console.print(table)


def _print_pair(console: Terminal, reference: str, label: str, pair: Mapping[str, Any]) -> None:
    columns = ("terrain", reference, label, "gap", "floor", "excess", "difference", "95 % interval", "verdict")
    title = f"closed loop: quality (mean@50) of the same episodes, {label} against {reference}"
    table = make_table(title, *columns, "same fall", "same reach", numbers=True)
    for place, row in {**pair["terrains"], "overall": pair["overall"]}.items():
        outcomes = [row["outcomes"][k] for k in ("fell", "reached")]
        table.add_row(
            place,
            f"{row['reference_score']:.4f}",
            f"{row['compared_score']:.4f}",
            _small(row["gap"]["value"]),
            "" if row["floor"] is None else _small(row["floor"]["value"]),
            "" if row["excess"] is None else _signed(row["excess"]["value"]),
            _signed(row["difference"]["value"]),
            _range(row["difference"]["interval"]),
            row["verdict"],
            *("" if o is None else f"{100 * o['same']:.0f} %" for o in outcomes),
        )
    console.print(table)
    of_metric = ("metric", reference, label, "difference", "95 % interval", "effect size")
    table = make_table("metrics, overall", *of_metric, numbers=True)
    for name, row in pair["overall"]["metrics"].items():
        size = row["effect_size"]
        table.add_row(
            name,
            f"{row['reference']:.4f}",
            f"{row['compared']:.4f}",
            _signed(row["difference"]["value"]),
            _range(row["difference"]["interval"]),
            "" if size is None else f"{size:+.2f}",
        )
    console.print(table)


def _print_commands(console: Terminal, reference: str, label: str, rows: Sequence[Mapping[str, Any]]) -> None:
    if not rows:
        return
    table = make_table(
        "largest differences in one command", "terrain", "command", "metric", reference, label, numbers=True
    )
    for row in rows:
        values = (f"{row[key]:.4f}" for key in ("reference", "compared"))
        table.add_row(row["terrain"], row["command"], row["metric"], *values)
    console.print(table)


def _print_attribution(console: Terminal, rows: Sequence[Mapping[str, Any]]) -> None:
    if not rows:
        return
    engines = list(dict.fromkeys(label for row in rows for label in row.get("to", {})))
    columns = ("switched", "in", "score", "95 % interval", *(f"gap to {e}" for e in engines))
    table = make_table("attribution: one thing switched", *columns, numbers=True)
    for row in rows:
        if row["not_run"] is not None:
            table.add_row(row["title"], row["engine"], "not run")
            continue
        found = [row["to"].get(engine) for engine in engines]
        gaps = [to and f"{_small(to['gap_before'])} → {_small(to['gap_after'])}, {cause(to)}" for to in found]
        difference, interval = _signed(row["difference"]["value"]), _range(row["difference"]["interval"])
        table.add_row(row["title"], row["engine"], difference, interval, *gaps)
    console.print(table)
    for row in rows:
        if row["not_run"] is not None:
            console.say(f"{row['title']} in {row['engine']}: {row['not_run']}")


def _print_gaps(console: Terminal, policy: Mapping[str, Any]) -> None:
    title = "gap: mean |difference| of an episode's quality"
    table = make_table(title, "engines", "gap", "95 % interval", numbers=True)
    rows = [(" – ".join(row["pair"]), row["overall"]["gap"], "bold") for row in policy["gaps"]]
    for name, gap, style in (*rows, ("floor: the reference against itself", policy["floor"]["overall"]["gap"], "")):
        low, high = map(_small, gap["interval"])
        table.add_row(name, Text(_small(gap["value"]), style), f"{low} to {high}")
    console.print(table)


def _unit(value: float | None, unit: str) -> str:
    return "–" if value is None else f"{value:.2g} {unit}"


def _small(value: float) -> str:
    """Return a number with four decimals, or a smaller one with its power of ten."""
    return f"{value:.4f}" if value == 0.0 or abs(value) >= 1e-3 else f"{value:.1e}"


def _signed(value: float) -> str:
    return _small(value) if value <= 0.0 else f"+{_small(value)}"


def _range(interval: Sequence[float]) -> str:
    low, high = interval
    return f"{_signed(low)} to {_signed(high)}"
