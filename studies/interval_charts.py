"""Geometry of interval charts that are to be compared, a line each: coordinates in an SVG view box; templates draw and compute nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

WIDTH, INSET = 260.0, 6.0
"""Of a line."""
_LEAST = 1e-3
"""Smallest half width of a scale: tables have four decimals, and what they show as zero is drawn as zero."""


def common_scale(estimates: Sequence[Mapping[str, Any] | None], *, signed: bool) -> tuple[float, float]:
    """A range for interval charts that are to be compared: it holds all estimates, and zero.

    Args:
        estimates: with ``value`` and ``interval``.
        signed: whether zero lies in the middle.
    """
    numbers = [abs(v) for e in estimates if e is not None for v in (e["value"], *e["interval"])]
    top = _rounded_up(max(numbers, default=0.0))
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


def _ticks(scale: tuple[float, float]) -> list[float]:
    low, high = scale
    return [low + (high - low) * i / 4 for i in range(5)]


def _x(value: float, scale: tuple[float, float]) -> float:
    low, high = scale
    return round(INSET + (WIDTH - 2 * INSET) * (value - low) / (high - low), 2)


def _rounded_up(value: float) -> float:
    """Return the next 1, 2 or 5 times a power of ten, at least ``_LEAST``."""
    value = max(value, _LEAST)
    power = 10.0 ** math.floor(math.log10(value))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value * (1.0 - 1e-9))
