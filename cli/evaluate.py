"""``gaitgauge evaluate``: live progress, then tables."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from rich.text import Text

from ..gauge.coverage import notes, score_label, suite_label
from ..gauge.evaluate import Status, evaluate, identity, prepare
from ..gauge.report.page import FELL_AT_LIMIT, falls_at_limit, write_report
from ..gauge.report.references import comparable, references_for
from ..gauge.request import Request
from ..gauge.result import Result
from ..gauge.results import ALL
from ..gauge.suite import Suite
from ..gauge.suited import other_measure
from ..policy.contract import PolicyContract
from ..policy.foreign.adapters import AT_ONCE, doubt
from ..studies.naming import free_run_folder, run_folders
from .clip import FilmTime
from .console import Terminal, make_table, print_json
from .progress import ProgressDisplay
from .studies import resumable

SLOWER = (
    "the suite commands more than the policy was made for; 'gaitgauge play POLICY' stays within its limits, and a suite with "
    'commands.beyond = "clip", or for two legs gaitgauge-biped-1, plays it there'
)
"""Advice for a policy that falls where more is commanded than it was made for."""


def run_evaluation(request: Request, *, out: Path | None, resume: bool, clip: bool, json_output: bool) -> None:
    """Evaluate, show progress, film the robot, print the tables and where the files are."""
    prepared = prepare(request)  # all that can be wrong with the request is said before anything is written
    names: Any = {"suite": request.suite, "pipeline": request.pipeline, "parameters": request.parameters}
    usual = run_folders([request.policy], Path("results"), **names)[0]
    folder = out or free_run_folder(usual, ("", identity(prepared)))
    console = Terminal(stderr=True)
    # Ray prints its nodes' logs to standard output; that a worker was lost is one of the notices
    quiet = redirect_stdout(io.StringIO() if request.cluster else sys.stdout)
    with resumable(console, "gauging", folder, "--resume") as display, quiet:
        command = ["gaitgauge", *sys.argv[1:]]
        film = FilmTime(display.start) if clip else None
        result = evaluate(prepared, folder, resume=resume, command=command, watch=shower(display, film))
        report = write_report(folder)
        sentence = _film(display, film.seconds, folder, request, result) if film else None
        if clip and sentence is None:
            report = write_report(folder)  # with the film
    if sentence:
        console.say(sentence)
    if json_output:
        print_json(result.to_data())
        return
    console = Terminal()
    print_results(console, result)
    if sentence := other_measure(prepared.suite, prepared.robot):
        console.say(sentence)
    within = not result.commands.beyond
    if sentence := doubtful_assumptions(prepared.policy.contract, prepared.suite, folder, within=within):
        console.say(sentence)
    console.say(f"results  {folder / 'results.json'}\nepisodes {folder / 'episodes.csv'}\nreport   {report}")


def _film(display: ProgressDisplay, seconds: float, folder: Path, request: Request, result: Result) -> str | None:
    """Film the robot for the report, which takes about so long; return why there is no film."""
    from .clip import make_clip

    options = [request.policy, "--suite", request.suite] + ["--trust"] * request.trust
    options += ["--robot", request.robot] if request.robot else []
    options += ["--contract", request.contract] if request.contract else []
    display.update(1.0, "filming the robot", left=seconds)
    return make_clip(folder, result, options)


def doubtful_assumptions(contract: PolicyContract, suite: Suite, folder: Path, *, within: bool = True) -> str | None:
    """Return advice where the robot fell at once in most episodes; ``within``: all commands were within the policy's limits."""
    at_once = AT_ONCE + suite.settling.longest
    with (folder / "episodes.csv").open(encoding="utf-8", newline="") as file:
        whole = [row for row in csv.DictReader(file) if row["command"] == ALL]
    counts = [(int(row["falls"]), int(row["control_steps"])) for row in whole]
    fell = [falls > 0 and steps * contract.control_period <= falls * at_once for falls, steps in counts]
    if 2 * sum(fell) <= len(fell):
        return None
    advice = doubt(contract) if within else SLOWER
    return f"the robot fell at once in {sum(fell)} of {len(fell)} episodes: {advice}"


def shower(display: ProgressDisplay, film: FilmTime | None = None) -> Callable[[Status], None]:
    """Return the function that shows the progress of an evaluation; a film may be made afterwards."""

    def show(status: Status) -> None:
        left = status.seconds_left
        if left is not None and film is not None:
            left += film.seconds
        places = sorted({f"{e.terrain} L{e.level}" if e.level else e.terrain for e in status.active})
        running = ", ".join(places[:5]) + (f" and {len(places) - 5} more" if len(places) > 5 else "")
        text = f"{status.done} of about {status.expected} episodes"
        text += ", estimating time" * (status.seconds_left is None)
        display.update(1.0 - status.remaining_work, text, {"now:": running}, left=left)

    return show


def print_results(console: Terminal, result: Result) -> None:
    """Print tables of terrains and metrics, then the score."""
    title = f"{suite_label(result)}, {result.pipeline}, on {result.backend}"
    table = make_table(title, "terrain", "level", "mean", "mean@25", "mean@50", "95 % interval", numbers=True)
    for name, row in result.terrains.items():
        level = "" if row.level is None else f"{row.level:.2f}".rstrip("0").rstrip(".")
        scored = row.score is not None
        values = (f"{v:.4f}" if scored else "" for v in (row.mean, row.mean25, row.mean50))
        table.add_row(name, level, *values, _interval(row.interval) if scored else "")
    console.print(table)
    if result.metrics:
        columns = ("metric", "mean", "mean@25", "mean@50", "95 % interval")
        table = make_table("metrics, weighted by level", *columns, numbers=True)
        for name, metric in result.metrics.items():
            values = (f"{v:.4f}" for v in (metric.mean, metric.mean25, metric.mean50))
            table.add_row(name, *values, _interval(metric.interval))
        console.print(table)
        console.say("  ".join(f"{k} {v:.4f}" for k, v in result.groups.items()))
    print_score(console, result)
    for note in notes(result):
        console.say(note)
    health = result.health
    falls = "fall" if health.falls == 1 else "falls"
    counts = {falls: health.falls, "diverged": health.diverged, "overflowed": health.overflowed}
    troubles = [f"{count} {what}" for what, count in counts.items() if count]
    if health.self_contact:
        troubles.append(f"parts of the robot touch each other in {100 * health.self_contact:.1f} % of the samples")
    if troubles:
        episodes = "quality episode" if health.episodes == 1 else "quality episodes"
        console.say(f"in {health.episodes} {episodes}: {', '.join(troubles)}")
    if falls_at_limit(result.environments):
        console.say(FELL_AT_LIMIT)


def print_score(console: Terminal, result: Result) -> None:
    """Print the score, or the level, with its interval, scores of known policies, and which scores compare with it."""
    if result.score is not None:
        interval = result.score_interval
        note = f"95 % interval {_interval(interval)}" if interval else str(result.chance.note)
        console.say(Text.assemble((f"{score_label(result)} {result.score:.4f}", "bold"), f"  ({note})"))
    elif result.level is not None:
        interval = result.level_interval
        note = f"  (95 % interval {_interval(interval, 2)})" if interval else ""
        note += "" if result.complete else f"  {result.coverage.words}"
        console.say(Text.assemble((f"mean level {result.level:.2f}", "bold"), note))
    if result.score is None:
        return
    best = {r.kind: r for r in reversed(references_for(result))}  # the references come with the best first
    if best:
        beside = sorted(best.values(), key=lambda r: -r.score)
        console.say("for comparison: " + "; ".join(f"{r.policy}: {r.score:.4f}" for r in beside))
    console.say(comparable(result))


def _interval(found: Sequence[float] | None, digits: int = 4) -> str:
    return f"{found[0]:.{digits}f} to {found[1]:.{digits}f}" if found else "one seed"
