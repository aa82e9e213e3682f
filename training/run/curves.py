"""Read the curves of a run's log: figures over environment steps."""

from __future__ import annotations

import math
from pathlib import Path

Curve = tuple[list[float], list[float]]
"""Environment steps [millions] and values."""

TAGS = {"Train/mean_reward": "mean reward", "Curriculum/mean_level": "mean terrain level in training"}
"""Curves beside the gauge's score, by key of the log."""
SCORE = "score in MuJoCo while training"
FIGURES = (SCORE, *TAGS.values())
"""Titles of the charts, in order."""
LOSS = "Loss/"
"""Keys in the log that begin so are kept under their own names, and not drawn."""
_MOST, _MOST_OF_A_LOSS = 400, 100
"""Largest number of points of a curve."""


def logged_curves(run: Path) -> dict[str, Curve]:
    """Return curves of a run directory's log by their titles, losses by their keys, those that it has; long ones are thinned out, to their
    last point.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    known = events.Tags()["scalars"]
    if "Perf/total_steps" not in known:
        return {}
    steps = {event.step: event.value / 1e6 for event in events.Scalars("Perf/total_steps")}
    titles = {tag: title for tag, title in TAGS.items() if tag in known}
    titles |= {tag: SCORE for tag in known if tag.startswith("Gauge/") and tag.endswith("/score")}
    titles |= {tag: tag for tag in known if tag.startswith(LOSS)}
    found = {}
    for tag, title in titles.items():
        # a score stands at the number of iterations that were scored, all else at the index of the iteration
        offset = 1 if title == SCORE else 0
        # of an iteration that was done twice, before and after a resume, the later one counts
        values = {e.step - offset: e.value for e in events.Scalars(tag) if e.step - offset in steps}
        order = sorted(values)
        most = _MOST_OF_A_LOSS if title == tag else _MOST
        order = order[:: -max(math.ceil(len(order) / most), 1)][::-1]
        found[title] = ([steps[at] for at in order], [values[at] for at in order])
    return found
