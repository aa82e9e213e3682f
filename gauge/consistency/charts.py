"""Geometry of the study's charts: from numbers to coordinates in an SVG view box; the template draws and computes nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

WIDTH, INSET = 260.0, 6.0
"""Of a strip: one line of an interval chart."""
CURVE_WIDTH, CURVE_HEIGHT = 300.0, 190.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 8.0, 10.0, 36.0
SMALLEST = 1e-9
"""Lower end of a logarithmic axis: below lies rounding."""


def common_scale(estimates: Sequence[Mapping[str, Any] | None], *, signed: bool) -> tuple[float, float]:
    """A range for interval charts that are to be compared: it holds all estimates, and zero.

    Args:
        estimates: with ``value`` and ``interval``.
        signed: whether zero lies in the middle.
    """
    numbers = [abs(v) for e in estimates if e is not None for v in (e["value"], *e["interval"])]
    top = _rounded_up(max(numbers, default=0.0) or 1e-6)
    return (-top if signed else 0.0, top)


def strip(
    estimate: Mapping[str, Any], scale: tuple[float, float], floor: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """One line of an interval chart: the interval's band, the mark of the value, and where known the same engine's floor."""
    low, high = (_x(v, scale) for v in estimate["interval"])
    return {
        "ticks": [_x(v, scale) for v in _ticks(scale)],
        "zero": _x(0.0, scale),
        "band": (low, round(max(high - low, 1.0), 2)),
        "mark": _x(estimate["value"], scale),
        "floor": None if floor is None else _x(floor["value"], scale),
    }


def strip_scale(scale: tuple[float, float]) -> list[dict[str, Any]]:
    """Labels above a column of strips."""
    return [{"x": _x(v, scale), "text": f"{v:.3g}".replace("-", "−")} for v in _ticks(scale)]


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


def _ticks(scale: tuple[float, float]) -> list[float]:
    low, high = scale
    return [low + (high - low) * i / 4 for i in range(5)]


def _x(value: float, scale: tuple[float, float]) -> float:
    low, high = scale
    return round(INSET + (WIDTH - 2 * INSET) * (value - low) / (high - low), 2)


def _rounded_up(value: float) -> float:
    """The next 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value * (1.0 - 1e-9))
