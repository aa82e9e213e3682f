"""Geometry of the study's curves: from numbers to coordinates in an SVG view box; the template draws and computes nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

CURVE_WIDTH, CURVE_HEIGHT = 300.0, 190.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 8.0, 10.0, 36.0
SMALLEST = 1e-9
"""Lower end of a logarithmic axis: below lies rounding."""


def curves(
    series: Mapping[str, tuple[Sequence[float], Sequence[float | None]]], *, title: str, unit: str
) -> dict[str, Any]:
    """Magnitudes over time on a logarithmic axis.

    Args:
        series: times [s] and values by label; values that do not exist leave a gap.
    """
    known = [abs(v) for _, values in series.values() for v in values if v is not None and abs(v) > SMALLEST]
    low = math.floor(math.log10(min(known, default=SMALLEST)))
    high = max(math.ceil(math.log10(max(known, default=1.0))), low + 1)
    end = max((times[-1] for times, _ in series.values()), default=1.0)
    right, bottom = CURVE_WIDTH - _RIGHT, CURVE_HEIGHT - _BOTTOM

    def x_of(time: float) -> float:
        return round(_LEFT + (right - _LEFT) * time / end, 2)

    def y_of(value: float) -> float:
        share = (math.log10(max(abs(value), 10.0**low)) - low) / (high - low)
        return round(bottom - (bottom - _TOP) * share, 2)

    lines = []
    for label, (times, values) in series.items():
        runs: list[list[tuple[float, float]]] = [[]]
        for time, value in zip(times, values, strict=True):
            if value is None:
                runs.append([])
            else:
                runs[-1].append((x_of(time), y_of(value)))
        lines.append({"label": label, "runs": [r for r in runs if len(r) > 1]})
    step = max(1, math.ceil((high - low) / 5))
    return {
        "title": title,
        "unit": unit,
        "size": (CURVE_WIDTH, CURVE_HEIGHT),
        "frame": (_LEFT, right, _TOP, bottom),
        "x_ticks": [{"x": x_of(end * i / 4), "text": f"{end * i / 4:g}"} for i in range(5)],
        "y_ticks": [{"y": y_of(10.0**p), "power": p} for p in range(low, high + 1, step)],
        "lines": lines,
    }
