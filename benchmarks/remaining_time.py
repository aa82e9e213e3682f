"""Measure how well commands estimate their remaining time, as their users see it.

    python benchmarks/remaining_time.py evaluate jury --out timelines
    python benchmarks/remaining_time.py --replay timelines

A command runs with a terminal of its own, or with ``--pipe`` with a pipe; every remaining time that it shows is noted with the time
at which it is shown. With ``--runs 2`` it runs once more, when it remembers the time of its first run. Printed are, for each command,
the error of the remaining time at each tenth of the command's duration (shown over true, less one), and the longest time without
anything new on the terminal.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import pty
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

COMMANDS = {
    "evaluate": "evaluate pretrained --suite demo",
    "compare": "compare pretrained {standing} --suite demo --terrain flat",
    "consistency": "consistency pretrained",
    "jury": "jury pretrained",
    "trial": "trial pretrained --scenario all --repeats 10",
    "latent": "latent pretrained",
    "worst": "worst pretrained --minutes 2 --no-films",
    "replay": "replay {log} --robot go2",
    "sweep": "sweep {sweep}",
}
"""Command lines by name; ``{…}`` are files that ``--with NAME=FILE`` gives."""
_LEFT = re.compile(r"about (?:(\d+) h )?(?:(\d+) min ?)?(?:(\d+) s)? ?left")
_CODES = re.compile(rb"\x1b\[[0-9;?]*[A-Za-z]")


def record(
    arguments: Sequence[str], *, pipe: bool = False, environment: Mapping[str, str] | None = None
) -> dict[str, object]:
    """Run a command line of ``gaitgauge`` on a terminal, or into a ``pipe``; return its timeline.

    Args:
        environment: further variables of the command.

    Returns:
        ``seconds``: the command's duration; ``shown``: pairs of a time and the remaining time shown at it, both in seconds;
        ``silence``: the longest time without a change of the screen [s], ``silent_from``: its beginning; ``code``: exit code;
        ``last``: the last text.
    """
    ours, theirs = os.pipe() if pipe else pty.openpty()
    began = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "gaitgauge.cli.main", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=theirs,
        stderr=theirs,
        env={**os.environ, "COLUMNS": "200", "TERM": "xterm", **(environment or {})},
    )
    os.close(theirs)
    shown: list[tuple[float, float]] = []
    last, silence, before, since = began, 0.0, b"", 0.0
    while True:
        try:
            data = os.read(ours, 1 << 16)
        except OSError:  # the terminal's other end is closed
            break
        if not data:
            break
        now = time.monotonic()
        text = _CODES.sub(b"", data)
        if text.strip() and text != before:
            silence, since = max((silence, since), (now - last, last - began))
            last, before = now, text
        for found in _LEFT.finditer(text.decode(errors="replace")):
            hours, minutes, seconds = (int(part or 0) for part in found.groups())
            shown.append((round(now - began, 2), 3600.0 * hours + 60.0 * minutes + seconds))
    code = process.wait()
    now = time.monotonic()
    silence, since = max((silence, since), (now - last, last - began))
    return {
        "command": shlex.join(arguments),
        "seconds": round(now - began, 2),
        "silence": round(silence, 2),
        "silent_from": round(since, 2),
        "shown": [pair for i, pair in enumerate(shown) if i == 0 or pair[0] - shown[i - 1][0] > 0.2],
        "code": code,
        "last": " ".join(before.decode(errors="replace").split()).strip("─│╭╮╰╯ ")[-200:],
    }


def errors(timeline: dict[str, object]) -> list[float | None]:
    """Return the relative error of the remaining time at 1/10 … 9/10 of the duration; None where nothing was shown yet."""
    total, shown = float(timeline["seconds"]), timeline["shown"]  # type: ignore[arg-type]
    found: list[float | None] = []
    for tenth in range(1, 10):
        now = total * tenth / 10
        before = [(at, left) for at, left in shown if at <= now]  # type: ignore[attr-defined]
        if not before:
            found.append(None)
            continue
        at, left = before[-1]
        found.append((left - (now - at)) / (total - now) - 1.0)
    return found


def table(timelines: dict[str, dict[str, object]]) -> str:
    """Return the errors of several timelines, a line each."""
    heads = "".join(f"{tenth / 10:>7.1f}" for tenth in range(1, 10))
    lines = [f"{'command':<14}{'seconds':>8}{heads}{'worst':>8}{'silence':>9}"]
    for name, timeline in timelines.items():
        found = errors(timeline)
        cells = "".join(f"{'–':>7}" if e is None else f"{100 * e:>+6.0f}%" for e in found)
        worst = max((abs(e) for e in found if e is not None), default=float("nan"))
        quiet = f"{timeline['silence']:>7.1f} s from {timeline['silent_from']:.0f} s"
        if timeline["code"]:
            quiet += f"; failed: {timeline['last']}"
        lines.append(f"{name:<14}{timeline['seconds']:>8.1f}{cells}{100 * worst:>7.0f}%{quiet}")
    return "\n".join(lines)


def main() -> None:
    """Run or replay the commands that are named, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("commands", nargs="*", choices=[*COMMANDS, []], metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("--out", type=Path, help="folder of the timelines, one JSON file each")
    parser.add_argument("--replay", type=Path, help="folder of timelines to print in place of running anything")
    parser.add_argument(
        "--with", dest="files", action="append", default=[], metavar="NAME=FILE", help="a file for {NAME}"
    )
    parser.add_argument("--also", default="", help="further options of the commands")
    parser.add_argument(
        "--runs", type=int, default=1, help="of each command; each remembers the time of the one before"
    )
    parser.add_argument("--pipe", action="store_true", help="give commands a pipe in place of a terminal")
    options = parser.parse_args()
    timelines: dict[str, dict[str, object]] = {}
    if options.replay:
        timelines = {path.stem: json.loads(path.read_text()) for path in sorted(options.replay.glob("*.json"))}
    files = dict(pair.partition("=")[::2] for pair in options.files)
    memory = tempfile.TemporaryDirectory()
    kernels = Path(os.environ.get("WARP_CACHE_PATH") or Path.home() / ".cache" / "warp" / version("warp-lang"))
    for name, run in itertools.product(options.commands, range(1, options.runs + 1)):
        with tempfile.TemporaryDirectory() as folder:
            line = COMMANDS[name].format_map(files) + f" {options.also} --out {folder}/out"
            if run == 1:
                memory.cleanup()
                memory = tempfile.TemporaryDirectory()
            environment = {"XDG_CACHE_HOME": memory.name, "WARP_CACHE_PATH": str(kernels)}
            label = name if run == 1 else f"{name}-{run}"
            timelines[label] = record(shlex.split(line), pipe=options.pipe, environment=environment)
        if options.out:
            options.out.mkdir(parents=True, exist_ok=True)
            (options.out / f"{label}.json").write_text(json.dumps(timelines[label]) + "\n")
        print(table({label: timelines[label]}), flush=True)
    memory.cleanup()
    if len(timelines) > 1 or options.replay:
        print(table(timelines))


if __name__ == "__main__":
    main()
