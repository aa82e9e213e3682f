"""``training.html`` of a run: its curves, the last score and what fell in it, and the film. One page that loads nothing from anywhere."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...files.writing import write_atomically
from ...gauge.report import charts
from ...gauge.report.breakdown import command_label
from ...gauge.report.pages import page_template
from ...gauge.result import EnvironmentRow, read_result
from .checkpoint import CheckpointError
from .curves import FIGURES, logged_curves
from .filming import VIDEO_FOLDER
from .run_directory import read_run_json
from .scoring import GAUGE_FOLDER

PAGE = "training.html"
_ENDS = "Episode_Termination/"
_FILM = re.compile(r"model_(?P<iteration>\d{1,12})_(?P<terrain>.+)")


def write_page(run: Path, *, scores: str | None, scalars: Mapping[str, float]) -> Path:
    """Write the page of a run directory, and return its path.

    Args:
        scores: suite of its scores; None without any.
        scalars: those of the last iteration, by their keys in the log.

    Raises:
        CheckpointError: the page cannot be written.
    """
    path = run / PAGE
    write_atomically(path, _render(run, scores, scalars), CheckpointError)
    return path


def _render(run: Path, scores: str | None, scalars: Mapping[str, float]) -> str:
    """Return the page as HTML. Whatever names contain is shown as text and never becomes markup."""
    curves = logged_curves(run)
    folder = None if scores is None else _last_score(run / GAUGE_FOLDER)
    result = None if folder is None else read_result(folder / "results.json", CheckpointError)
    films = {film: _FILM.fullmatch(film.stem) for film in sorted((run / VIDEO_FOLDER).glob("*.mp4"))}
    shown = [(int(name["iteration"]), name["terrain"], film) for film, name in films.items() if name]
    last = max((iteration for iteration, *_ in shown), default=0)
    described = read_run_json(run)
    schedule = described.get("settings", {}).get("environment", {}).get("schedule", {})
    return page_template(__file__, "training.html.j2", terrain=charts.terrain_label).render(
        run=described,
        stretches=[each for each in schedule.get("stretches", []) if each["begin"] < 1.0],
        name=run.name,
        figures={n: charts.curves({n: [curves[n]]}) for n in FIGURES if any(curves.get(n, ((), ()))[1])},
        score=result,
        report=None if folder is None else f"{folder.relative_to(run).as_posix()}/report.html",
        rows=[] if result is None else [_row(row) for row in result.environments],
        ends={key.removeprefix(_ENDS): value for key, value in scalars.items() if key.startswith(_ENDS)},
        films=[
            (terrain, base64.b64encode(film.read_bytes()).decode())
            for iteration, terrain, film in shown
            if iteration == last
        ],
    )


def _last_score(gauge: Path) -> Path | None:
    """Return the folder of the last checkpoint with results."""
    found = [path.parent for path in gauge.glob("*/model_*/results.json")]
    return max(found, key=lambda folder: int(folder.name.removeprefix("model_")), default=None)


def _row(row: EnvironmentRow) -> dict[str, Any]:
    """Return an environment's line: its place, level, score, falls, and the command with the lowest quality."""
    commands: dict[str, list[float]] = {}
    for run in row.runs.values():
        for command, value in run.commands.items():
            commands.setdefault(command, []).append(value)
    worst = min(commands, key=lambda name: sum(commands[name]) / len(commands[name]), default="")
    return {
        "terrain": row.terrain,
        "friction": row.friction,
        "level": row.level,
        "score": row.score,
        "falls": row.falls,
        "worst": command_label(worst) if worst else "",
    }
