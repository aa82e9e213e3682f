"""Film the robot for a report: ``gaitgauge play`` runs in a process of its own, because MuJoCo chooses its renderer on import."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from ..gauge.report.page import CLIP
from ..gauge.result import Result
from .errors import UserError
from .picture import PLAIN, find_renderer

SECONDS = 6.0
"""Length of the film [s]."""
_LONGEST = 300.0
"""Longest time to make it [s]."""
_PLAIN, _RICH, _NONE = 4.0, 2.0, 0.5
"""Time in which a CPU draws a film, and a GPU, and until it is clear that nothing draws [s]."""
_SHOWIEST = ("stairs_fd", "obstacle", "wave", "slope_fd", "stairs_bd", "slope_bd")
"""Terrains in the order of preference."""
_PACKAGE = __name__.partition(".")[0]


class FilmTime:
    """Estimate the time of a film; a process beside the evaluation finds out how this machine draws.

    Its command starts as slowly as the one that films: ``start`` [s].
    """

    def __init__(self, start: float) -> None:
        self._start = start
        self.seconds = start + _PLAIN
        threading.Thread(target=self._find, daemon=True).start()

    def _find(self) -> None:
        try:
            drawing = _PLAIN if find_renderer()[1] is PLAIN else _RICH
        except UserError:
            drawing = _NONE
        self.seconds = self._start + drawing


def make_clip(folder: Path, result: Result, options: Sequence[str]) -> str | None:
    """Write the film beside the results, unless it is there.

    Args:
        result: the robot is shown where it was judged, at the level that it reached.

    Returns:
        None, or why there is no film, in one sentence.
    """
    clip = folder / CLIP
    if clip.is_file():
        return None
    command = [sys.executable, "-m", f"{_PACKAGE}.cli.main", "play", *options, *place(result)]
    command += ["--seconds", f"{SECONDS:g}", "--gif", str(clip)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST, check=False)
    except subprocess.TimeoutExpired:
        return f"no clip of the robot: it took longer than {_LONGEST:g} s"
    if done.returncode == 0:
        return None
    said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return f"no clip of the robot: {said[-1].removeprefix('gaitgauge: ')}"


def place(result: Result) -> list[str]:
    """Return where the robot is shown, as options of ``gaitgauge play``: on the showiest terrain, at the friction in the middle."""
    rows = result.environments
    played = [row.terrain for row in rows]
    terrain = next((name for name in _SHOWIEST if name in played), played[0])
    mine = sorted((row for row in rows if row.terrain == terrain), key=lambda row: (abs(row.payload), row.friction))
    unloaded = [row for row in mine if row.payload == mine[0].payload]
    row = unloaded[len(unloaded) // 2]
    level = [] if row.level is None else ["--level", str(max(1, round(row.level)))]
    return ["--terrain", terrain, *level, "--friction", f"{row.friction:g}"]
