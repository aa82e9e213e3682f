"""What a run's log says of its learning: figures over environment steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ...files.writing import csv_text

Curve = tuple[list[float], list[float]]
"""Environment steps [millions] and values."""

TAGS = {"Train/mean_reward": "mean reward", "Curriculum/mean_level": "mean terrain level in training"}
"""What is drawn, by its key in the log, beside the gauge's score."""
SCORE = "score in MuJoCo while training"
FIGURES = (SCORE, *TAGS.values())
"""Titles of the charts, in order."""
_MOST = 400
"""Points of a curve."""


def learning_curves(run: Path) -> dict[str, Curve]:
    """Curves of a run directory by their titles, those that its log has; long ones are thinned out."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    known = events.Tags()["scalars"]
    if "Perf/total_steps" not in known:
        return {}
    steps = {event.step: event.value / 1e6 for event in events.Scalars("Perf/total_steps")}
    titles = {tag: title for tag, title in TAGS.items() if tag in known}
    titles |= {tag: SCORE for tag in known if tag.startswith("Gauge/") and tag.endswith("/score")}
    found = {}
    for tag, title in titles.items():
        # a score stands at the number of iterations that were scored, all else at the index of the iteration
        offset = 1 if title == SCORE else 0
        # of an iteration that was done twice, before and after a resume, the later one counts
        values = {e.step - offset: e.value for e in events.Scalars(tag) if e.step - offset in steps}
        order = sorted(values)
        order = order[:: max(len(order) // _MOST, 1)]
        found[title] = ([steps[at] for at in order], [values[at] for at in order])
    return found


def curves_csv(curves: Mapping[tuple[str, int], Mapping[str, Curve]]) -> str:
    """A row for each point: entry, seed, figure, environment steps and value."""
    rows: list[Sequence[object]] = [("entry", "seed", "figure", "environment_steps_millions", "value")]
    for (entry, seed), figures in curves.items():
        for figure, points in figures.items():
            rows += [(entry, seed, figure, f"{x:.6g}", f"{y:.6g}") for x, y in zip(*points, strict=True)]
    return csv_text(rows)


def by_figure(
    curves: Mapping[tuple[str, int], Mapping[str, Curve]], entries: Sequence[str]
) -> dict[str, dict[str, list[Curve]]]:
    """For each figure that any run has, the curves of each entry's seeds."""
    return {
        figure: {
            entry: [own[figure] for (name, _), own in curves.items() if name == entry and figure in own]
            for entry in entries
        }
        for figure in FIGURES
        if any(figure in own for own in curves.values())
    }
