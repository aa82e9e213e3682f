"""Prints what the fuzzed parsers came to where their number of cases was asked for."""

import os

import pytest


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """A table of all parsers, from the processes of all."""
    if "GAITGAUGE_FUZZ_CASES" not in os.environ:
        return
    reports = [r for kind in ("passed", "failed") for r in terminalreporter.stats.get(kind, [])]
    rows = sorted((v for r in reports for k, v in r.user_properties if k == "fuzzed"), key=lambda row: row["parser"])
    lines = ["| parser | cases | tracebacks | slowest case [s] | most memory of a case [MB] | files touched outside |"]
    lines += ["| --- | --- | --- | --- | --- | --- |"]
    total = {"parser": "all"} | {k: sum(r[k] for r in rows) for k in ("cases", "tracebacks", "outside")}
    total |= {k: max((r[k] for r in rows), default=0) for k in ("slowest", "memory")}
    for row in [*rows, total]:
        cells = (row["parser"], row["cases"], row["tracebacks"], f"{row['slowest']:.2f}", f"{row['memory'] / 1e6:.0f}")
        lines.append("| " + " | ".join(map(str, (*cells, row["outside"]))) + " |")
    terminalreporter.write_line("")
    for line in lines:
        terminalreporter.write_line(line)
