"""Print errors of simulators against reality, and their ranks of policies (``gaitgauge validate``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from ..studies.validate.validation import AVERAGE, example, read_measurements, validate
from .console import Terminal, make_table, print_json
from .errors import UserError


def run_validation(tables: Sequence[Path], *, example_name: str | None, ranks_only: bool, json_output: bool) -> None:
    """Validate simulators and print errors and ranks."""
    if example_name is not None:
        if tables:
            raise UserError("an example has tables of its own; leave out either the files or --example")
        parts = example(example_name)
    elif len(tables) < 2:
        raise UserError("give the measured table and at least one predicted one (REAL SIM...), or --example paper")
    else:
        real, *simulators = [read_measurements(path) for path in tables]
        parts = [validate(real, simulators, ranks_only=ranks_only)]
    if json_output:
        print_json(parts if example_name else parts[0])
        return
    console = Terminal()
    for part in parts:
        print_validation(console, part)


def print_validation(console: Terminal, found: Mapping[str, Any]) -> None:
    """Print errors by command, metric and group of every simulator, then ranks."""
    simulators = found["simulators"]
    for name, entry in simulators.items():
        if "errors" not in entry:
            continue
        errors = entry["errors"]
        metrics, groups = list(errors["bias"]), list(errors["groups"][AVERAGE])
        title = f"{name}: absolute error against {found['real']}"
        table = make_table(title, "command", *metrics, *groups, numbers=True)
        for command in errors["metrics"]:
            of = [errors["metrics"][command][m] for m in metrics] + [errors["groups"][command][g] for g in groups]
            merged = found["motions"].get(command, [])
            label = f"{command} ({', '.join(merged)})" if len(merged) > 1 else command
            table.add_row(label, *(f"{v:.4f}" for v in of), style="bold" if command == AVERAGE else None)
        table.add_row("signed, average", *(f"{errors['bias'][m]:+.4f}" for m in metrics), *("" for _ in groups))
        console.print(table)
    ranked = {name: entry["ranks"] for name, entry in simulators.items() if "ranks" in entry}
    if ranked:
        title = f"ranks of {len(found['policies'])} policies against {found['real']}: Kendall's τ, mean maximum rank violation"
        columns = [f"{name} {what}" for name in ranked for what in ("τ", "MMRV")]
        table = make_table(title, "motion, metric", *columns, numbers=True)
        for rows in zip(*ranked.values(), strict=True):
            pairs = [("–" if r["tau"] is None else f"{r['tau']:+.3f}", f"{r['violation']:.4f}") for r in rows]
            average = rows[0]["motion"] == AVERAGE
            label = AVERAGE if average else f"{rows[0]['motion']}, {rows[0]['metric']}"
            table.add_row(label, *chain(*pairs), style="bold" if average else None)
        console.print(table)
