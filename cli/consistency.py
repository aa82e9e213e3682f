"""``gaitgauge consistency``: live progress, then tables of where engines disagree."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ..gauge.consistency.page import FIELD_LABELS, TESTS, verdict, write_page
from ..gauge.consistency.study import Request, Status, prepare_study, study

_LOG_EVERY = 10.0
"""Time between two lines where there is no terminal [s]."""
_REFRESH = 0.5
"""Shortest time between two updates of the display [s]."""
_WIDE = 150
"""Columns of the tables where there is no terminal."""


def run_consistency(
    *,
    policies: Sequence[str],
    backends: str,
    threads: int | None,
    out: Path | None,
    resume: bool,
    json_output: bool,
    **choices: Any,
) -> None:
    """Make the study, show progress, print the tables and where the files are."""
    request = Request(
        policies=tuple(policies),
        backends=tuple(b.strip() for b in backends.split(",") if b.strip()),
        threads=threads or os.cpu_count() or 1,
        **choices,
    )
    console = Console(stderr=True)
    prepared = prepare_study(request)  # all that can be wrong with the request is said before anything is written
    for engine in prepared.skipped:
        console.print(f"{engine['backend']} is left out: {engine['reason']}", highlight=False, soft_wrap=True)
    names = "-".join(Path(p).name.partition(".")[0] for p in request.policies[:3])
    folder = out or Path("results") / f"{names}-{Path(request.suite).stem}-consistency"
    try:
        with _display(console) as watch:
            results = study(request, folder, resume=resume, command=["gaitgauge", *sys.argv[1:]], watch=watch)
    except KeyboardInterrupt:
        again = shlex.join(["gaitgauge", *[a for a in sys.argv[1:] if a != "--resume"], "--resume"])
        console.print(f"stopped; every finished episode is kept in {folder}. Go on with:\n  {again}", highlight=False)
        raise typer.Exit(130) from None
    page = write_page(folder)
    if json_output:
        print(json.dumps(results, indent=1))
        return
    # tables squeezed into the 80 columns that a pipe pretends to have cannot be read
    print_study(Console() if sys.stdout.isatty() else Console(width=_WIDE), results)
    print(f"results  {folder / 'consistency.json'}\npage     {page}")


class _display:  # noqa: N801  (reads as a verb where it is used)
    """Context manager that shows ``Status``: a live bar on a terminal, plain lines elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last = time.monotonic()
        self._live: Progress | Live | None = None
        self._run = ""

    def __enter__(self) -> Callable[[Status], None]:
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("[bold]{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[text]}"),
                TimeElapsedColumn(),
            )
            self._task = self._bar.add_task("comparing", total=1.0, text="")
            self._live = Live(self._bar, console=self._console, refresh_per_second=4)
            self._live.__enter__()
        return self._update

    def __exit__(self, *details: Any) -> None:
        if self._live is not None:
            self._live.__exit__(*details)

    def _update(self, status: Status) -> None:
        now = time.monotonic()
        if now - self._last < (_REFRESH if self._live else _LOG_EVERY):
            return
        self._last = now
        text = f"run {status.part} of {status.parts}, {status.variant}: {status.done} of {status.episodes} episodes"
        if self._live:
            share = (status.part - 1 + status.done / status.episodes) / status.parts
            self._bar.update(self._task, completed=share, text=text)
        else:
            self._console.print(f"{status.seconds:.0f} s: {status.policy}, {text}", highlight=False, soft_wrap=True)


def print_study(console: Console, results: Mapping[str, Any]) -> None:
    """Tables of every layer, the gap last."""
    for policy in results["policies"]:
        if len(results["policies"]) > 1:
            console.rule(policy["policy"])
        _print_models(console, policy["models"], results)
        _print_open_loop(console, policy["open_loop"])
        for label, pair in policy["pairs"].items():
            _print_pair(console, results["reference"], label, pair)
        _print_attribution(console, policy["attribution"])
        _print_gaps(console, policy)
        for label, pair in policy["pairs"].items():
            console.print(f"[bold]{label}[/bold]: {verdict(pair['overall'])}", highlight=False, soft_wrap=True)
        for label, health in policy["health"].items():
            troubles = [
                f"{health[k]} {word}"
                for k, word in (("diverged", "diverged"), ("overflowed", "dropped contacts"))
                if health[k]
            ]
            if troubles:
                console.print(
                    f"[red]{label}[/red]: of {health['episodes']} episodes {' and '.join(troubles)}", highlight=False
                )


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i == 0 else "right")
    return table


def _print_models(console: Console, models: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    labels = results["compared"]
    table = _table(f"models: largest relative difference from {models['reference']}", "field", *labels)
    for key, row in models["fields"].items():
        cells = []
        for label in labels:
            found = row["variants"].get(label)
            if found is None:
                cells.append("not described")
            elif found["agrees"]:
                cells.append("same")
            else:
                relative = found["relative"]
                cells.append(f"[red]{'–' if relative is None else f'{relative:.2g}'} ({found['entry']})[/red]")
        table.add_row(FIELD_LABELS[key].replace("[", r"\["), *cells)
    if models["fields"]:
        console.print(table)
    if models["not_described"]:
        console.print(f"models not described by {', '.join(models['not_described'])}", highlight=False)


def _print_open_loop(console: Console, block: Mapping[str, Any]) -> None:
    columns = ("engine", "test", "bases apart", "joints apart", "energy", "1 cm apart after", "weight at rest")
    table = _table("open loop: after the same joint targets", *columns)
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


def _print_pair(console: Console, reference: str, label: str, pair: Mapping[str, Any]) -> None:
    columns = ("terrain", reference, label, "gap", "floor", "difference", "95 % interval", "same fall", "same reach")
    table = _table(f"closed loop: quality (mean@50) of the same episodes, {label} against {reference}", *columns)
    for place, row in {**pair["terrains"], "overall": pair["overall"]}.items():
        low, high = row["difference"]["interval"]
        outcomes = [row["outcomes"][k] for k in ("fell", "reached")]
        table.add_row(
            place,
            f"{row['reference_score']:.4f}",
            f"{row['compared_score']:.4f}",
            _small(row["gap"]["value"]),
            "" if row["floor"] is None else _small(row["floor"]["value"]),
            _signed(row["difference"]["value"]),
            _range(low, high),
            *("" if o is None else f"{100 * o['same']:.0f} %" for o in outcomes),
        )
    console.print(table)
    table = _table("metrics, overall", "metric", reference, label, "difference", "95 % interval", "effect size")
    for name, row in pair["overall"]["metrics"].items():
        low, high = row["difference"]["interval"]
        size = row["effect_size"]
        table.add_row(
            name,
            f"{row['reference']:.4f}",
            f"{row['compared']:.4f}",
            _signed(row["difference"]["value"]),
            _range(low, high),
            "" if size is None else f"{size:+.2f}",
        )
    console.print(table)


def _print_attribution(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    if not rows:
        return
    engines = list(dict.fromkeys(label for row in rows for label in row.get("to", {})))
    table = _table(
        "attribution: one thing switched", "switched", "in", "score", "95 % interval", *(f"gap to {e}" for e in engines)
    )
    for row in rows:
        if row["not_run"] is not None:
            table.add_row(row["title"], row["engine"], "not run")
            continue
        low, high = row["difference"]["interval"]
        cells = []
        for engine in engines:
            to = row["to"].get(engine)
            cells.append("" if to is None else f"{_small(to['gap_before'])} → {_small(to['gap_after'])}")
        table.add_row(row["title"], row["engine"], _signed(row["difference"]["value"]), _range(low, high), *cells)
    console.print(table)
    for row in rows:
        if row["not_run"] is not None:
            console.print(f"{row['title']} in {row['engine']}: {row['not_run']}", highlight=False, soft_wrap=True)


def _print_gaps(console: Console, policy: Mapping[str, Any]) -> None:
    table = _table("gap: mean |difference| of an episode's quality", "engines", "gap", "95 % interval")
    for row in policy["gaps"]:
        low, high = row["overall"]["gap"]["interval"]
        table.add_row(
            " – ".join(row["pair"]),
            f"[bold]{_small(row['overall']['gap']['value'])}[/bold]",
            f"{_small(low)} to {_small(high)}",
        )
    floor = policy["floor"]["overall"]["gap"]
    low, high = floor["interval"]
    table.add_row("floor: the reference against itself", _small(floor["value"]), f"{_small(low)} to {_small(high)}")
    console.print(table)


def _unit(value: float | None, unit: str) -> str:
    return "–" if value is None else f"{value:.2g} {unit}"


def _small(value: float) -> str:
    """Four decimals, or the power of ten of what they would hide."""
    return f"{value:.4f}" if value == 0.0 or abs(value) >= 1e-3 else f"{value:.1e}"


def _signed(value: float) -> str:
    return _small(value) if value <= 0.0 else f"+{_small(value)}"


def _range(low: float, high: float) -> str:
    return f"{_signed(low)} to {_signed(high)}"
