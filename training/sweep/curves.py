"""Read figures of learning over environment steps from a run's log."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from ...files.parsing import one_line, read_text
from ...files.writing import csv_text
from ..run.curves import FIGURES, LOSS, Curve, logged_curves
from .file import SweepError
from .runs import KEPT_CURVES

_KEPT_HEAD = ("figure", "environment_steps_millions", "value")


def learning_curves(run: Path) -> dict[str, Curve]:
    """Curves of a run directory by their titles, losses by their keys in the log, those that it has, or of what was kept of it;
    long ones are thinned out, to their last point.

    Raises:
        SweepError: the kept curves are damaged.
    """
    if (kept := run / KEPT_CURVES).is_file():
        return _read_curves(kept)
    return logged_curves(run)


def curves_csv(curves: Mapping[tuple[str, int], Mapping[str, Curve]]) -> str:
    """Return a row for each point: entry, seed, figure, environment steps and value."""
    rows = [(*run, *row) for run, figures in curves.items() for row in _rows(figures)]
    return csv_text([("entry", "seed", *_KEPT_HEAD), *rows])


def kept_curves_csv(curves: Mapping[str, Curve]) -> str:
    """Return a row for each point of one run's curves: figure, environment steps and value."""
    return csv_text([_KEPT_HEAD, *_rows(curves)])


def _rows(curves: Mapping[str, Curve]) -> list[tuple[str, str, str]]:
    return [(name, f"{x:.6g}", f"{y:.6g}") for name, points in curves.items() for x, y in zip(*points, strict=True)]


def _read_curves(path: Path) -> dict[str, Curve]:
    """What ``kept_curves_csv`` wrote."""
    found: dict[str, Curve] = {}
    text = read_text(path, "learning curves", SweepError)
    try:
        rows = [tuple(row) for row in csv.reader(text.splitlines())]
        if rows[:1] != [_KEPT_HEAD]:
            raise ValueError
        for figure, *point in rows[1:]:
            steps, value = map(float, point)
            if not (figure in FIGURES or figure.startswith(LOSS)) or not math.isfinite(steps + value):
                raise ValueError
            for values, number in zip(found.setdefault(figure, ([], [])), (steps, value), strict=True):
                values.append(number)
    except (ValueError, csv.Error) as error:
        raise SweepError(
            f"the learning curves '{one_line(path)}' are damaged: each row has a figure ({', '.join(FIGURES)}, {LOSS}…) and two numbers; "
            "put the file back, or delete it and call again: the run is told without curves"
        ) from error
    return found


def by_figure(
    curves: Mapping[tuple[str, int], Mapping[str, Curve]], seeds: Mapping[str, Sequence[int]]
) -> dict[str, dict[str, list[Curve]]]:
    """For each figure that any run has, the curves of each entry's ``seeds``, in their order, one without points where there is
    none: a seed is drawn alike in every figure.
    """
    return {
        figure: {
            entry: [curves.get((entry, seed), {}).get(figure, ([], [])) for seed in own] for entry, own in seeds.items()
        }
        for figure in FIGURES
        if any(figure in own for own in curves.values())
    }
