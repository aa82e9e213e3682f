"""Geometry of the report's charts: pure functions from the rows of a result to coordinates in an SVG view box.

The templates draw these numbers and compute nothing themselves. Coordinates are SVG user units, x to the
right, y downwards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from decimal import Decimal
from functools import partial
from operator import attrgetter
from typing import Any

from ..result import EnvironmentRow, TerrainScore

TERRAIN_LABELS = {
    "slope_fd": "slope, forward",
    "slope_bd": "slope, backward",
    "stairs_fd": "stairs, forward",
    "stairs_bd": "stairs, backward",
}
LEVELS = 10
"""Least upper end of the level axis."""

STRIP_WIDTH = 200.0
_STRIP_INSET = 5.0
_RADAR_WIDTH, _RADAR_HEIGHT, _RADAR_RADIUS = 500.0, 410.0, 150.0
_PANEL_WIDTH, _PANEL_HEIGHT = 190.0, 156.0
_PANEL_LEFT, _PANEL_RIGHT, _PANEL_TOP, _PANEL_BOTTOM = 34.0, 6.0, 8.0, 38.0
_CELL = 17.0
_WIDE = 25.0
"""Width of a cell that holds a number."""
_LEGEND = 130.0
"""Least width of a map, that of its axes' names."""
_CURVE_WIDTH, _CURVE_HEIGHT, _CURVE_LEFT, _CURVE_RIGHT = 480.0, 260.0, 46.0, 10.0
_HEAT_LEFT, _HEAT_TOP, _HEAT_BOTTOM = 34.0, 4.0, 34.0


def terrain_label(name: str) -> str:
    """Return a terrain's name for readers."""
    return TERRAIN_LABELS.get(name, name.replace("_", " "))


def number(value: float) -> str:
    """Return a number as short as it goes, to three decimals, with a true minus sign."""
    return f"{round(value, 3) + 0.0:g}".replace("-", "−")


def strip(
    marks: Mapping[str, float | None], interval: Sequence[float] | None, others: Sequence[float] = ()
) -> dict[str, Any]:
    """Return one line of a score chart: marks for the statistics and a band for the interval.

    Args:
        marks: ``mean50`` and, where known, ``mean`` and ``mean25``, all in [0, 1].
        others: scores in [0, 1] that the line is compared with.

    Returns:
        ``ticks``: x of 0, 0.25 … 1; ``band``: (x, width) or None; ``marks``: x by statistic; ``others``: their x.
    """
    band = None
    if interval is not None:
        low, high = (_strip_x(v) for v in interval)
        band = (low, round(max(high - low, 1.0), 2))
    places = {statistic: _strip_x(value) for statistic, value in marks.items() if value is not None}
    return {
        "ticks": [_strip_x(i / 4) for i in range(5)],
        "band": band,
        "marks": places,
        "others": [_strip_x(v) for v in others],
    }


def _strip_x(value: float) -> float:
    return _linear(value, (0.0, 1.0), (_STRIP_INSET, STRIP_WIDTH - _STRIP_INSET))


def radar(terrains: Mapping[str, TerrainScore], statistics: Mapping[str, str]) -> dict[str, Any] | None:
    """Place scores of the terrains on spokes, the first upwards and the others clockwise; None for fewer than three terrains.

    Args:
        terrains: terrain by name, with one value in [0, 1] for each statistic.
        statistics: label of each statistic, in the order in which they are drawn.
    """
    if len(terrains) < 3:
        return None
    centre = (_RADAR_WIDTH / 2, _RADAR_HEIGHT / 2)
    angles = [2.0 * math.pi * i / len(terrains) for i in range(len(terrains))]

    def at(angle: float, value: float) -> tuple[float, float]:
        radius = _RADAR_RADIUS * value
        return round(centre[0] + radius * math.sin(angle), 2), round(centre[1] - radius * math.cos(angle), 2)

    spokes = []
    for angle, (name, row) in zip(angles, terrains.items(), strict=True):
        x, y = at(angle, 1.0)
        label_x, label_y = at(angle, 1.0 + 16.0 / _RADAR_RADIUS)
        side = math.sin(angle)
        anchor = "middle" if abs(side) < 0.2 else "start" if side > 0 else "end"
        lift = -14.0 if math.cos(angle) > 0.9 else 8.0 if math.cos(angle) < -0.9 else 0.0
        label = {"x": label_x, "y": round(label_y + lift, 2), "anchor": anchor, "text": terrain_label(name)}
        spokes.append({"x": x, "y": y, "label": label, "value": row.mean50})
    rings = [
        {"value": v, "points": [at(a, v) for a in angles], "label": (round(centre[0] + 4, 2), at(0.0, v)[1])}
        for v in (0.2, 0.4, 0.6, 0.8, 1.0)
    ]
    shapes = [
        {
            "statistic": s,
            "label": label,
            "points": [at(a, getattr(t, s)) for a, t in zip(angles, terrains.values(), strict=True)],
        }
        for s, label in statistics.items()
    ]
    size = (_RADAR_WIDTH, _RADAR_HEIGHT)
    return {"size": size, "centre": centre, "spokes": spokes, "rings": rings, "shapes": shapes}


def sweep(rows: Sequence[EnvironmentRow], *, axis: str, quantity: str) -> list[dict[str, Any]]:
    """Return small multiples, one for each terrain: a quantity over friction or payload where only that one varies.

    Args:
        axis: ``friction`` or ``payload``.
        quantity: ``level`` or ``score``; environments without it are left out.

    Returns:
        Panels with ``terrain``, ``size``, ``frame``, ``x_ticks``, ``y_ticks``, ``points`` and ``fixed``: the value of
        the axis that does not vary. A terrain with fewer than two values along the axis, or whose axes are crossed, has
        none.
    """
    other = "payload" if axis == "friction" else "friction"
    series: list[tuple[str, float, list[EnvironmentRow]]] = []
    for terrain, group in _by_terrain(rows, quantity).items():
        lines = [[r for r in group if getattr(r, other) == v] for v in sorted({getattr(r, other) for r in group})]
        lines = [sorted(line, key=attrgetter(axis)) for line in lines if len(line) > 1]
        if len(lines) == 1:
            series.append((terrain, getattr(lines[0][0], other), lines[0]))
    if not series:
        return []
    everything = [r for _, _, line in series for r in line]
    values = sorted({getattr(r, axis) for r in everything})
    top = _top(everything, quantity)
    left, right = _PANEL_LEFT, _PANEL_WIDTH - _PANEL_RIGHT
    upper, lower = _PANEL_TOP, _PANEL_HEIGHT - _PANEL_BOTTOM

    x_of = partial(_linear, domain=(values[0], values[-1]), span=(left + 8.0, right - 8.0))
    y_of = partial(_linear, domain=(0.0, top), span=(lower, upper))
    steps = [top * i / 4 for i in range(5)] if quantity == "score" else [0.0, top / 2, top]
    return [
        {
            "terrain": terrain_label(terrain),
            "axis": axis,
            "quantity": quantity,
            "fixed": fixed,
            "size": (_PANEL_WIDTH, _PANEL_HEIGHT),
            "frame": (left, right, upper, lower),
            "x_ticks": [{"x": x_of(v), "label": number(v)} for v in _thin(values)],
            "y_ticks": [{"y": y_of(v), "label": number(v)} for v in steps],
            "points": [_point(r, axis, quantity, x_of, y_of) for r in line],
        }
        for terrain, fixed, line in series
    ]


def _point(row: EnvironmentRow, axis: str, quantity: str, x_of: Any, y_of: Any) -> dict[str, Any]:
    interval = row.interval if quantity == "score" else None
    along, value = getattr(row, axis), getattr(row, quantity)
    unit = " kg" if axis == "payload" else ""
    shown = f"{value:.4f}" if quantity == "score" else number(value)
    return {
        "x": x_of(along),
        "y": y_of(value),
        "whisker": None if interval is None else [y_of(v) for v in interval],
        "failed": row.level == 0 if quantity == "level" else bool(row.falls or row.diverged),
        "title": f"{axis} {number(along)}{unit}: {quantity} {shown}",
    }


def heat(rows: Sequence[EnvironmentRow], *, quantity: str) -> list[dict[str, Any]]:
    """Return a map of each terrain with crossed frictions and payloads, friction to the right, payload upwards.

    Environments without ``quantity`` (``level`` or ``score``) are left out.
    """
    maps = []
    for terrain, group in _by_terrain(rows, quantity).items():
        frictions, payloads = sorted({r.friction for r in group}), sorted({r.payload for r in group})
        if min(len(frictions), len(payloads)) < 2 or len(group) < len(frictions) + len(payloads):
            continue
        top = _top(rows, quantity)
        bottom = _HEAT_TOP + _CELL * len(payloads)
        cells = [
            {
                "x": round(_HEAT_LEFT + _WIDE * frictions.index(r.friction), 2),
                "y": round(bottom - _CELL * (payloads.index(r.payload) + 1), 2),
                "share": round(value / top, 3),
                "text": f"{value:.2f}".removeprefix("0") if quantity == "score" else number(value),
                "title": f"friction {number(r.friction)}, payload {number(r.payload)} kg: {number(value)}",
            }
            for r, value in ((r, getattr(r, quantity)) for r in group)
        ]
        maps.append(
            {
                "terrain": terrain_label(terrain),
                "quantity": quantity,
                "size": (_HEAT_LEFT + max(_WIDE * len(frictions), _LEGEND) + 8.0, bottom + _HEAT_BOTTOM),
                "cell": (_WIDE, _CELL),
                "cells": cells,
                "x_ticks": [
                    {"x": round(_HEAT_LEFT + _WIDE * (frictions.index(v) + 0.5), 2), "label": number(v)}
                    for v in _thin(frictions)
                ],
                "y_ticks": [
                    {"y": round(bottom - _CELL * (i + 0.5), 2), "label": number(v)} for i, v in enumerate(payloads)
                ],
                "bottom": bottom,
            }
        )
    return maps


def searches(rows: Sequence[EnvironmentRow]) -> list[dict[str, Any]]:
    """Return the outcomes of the level searches, one chart for each terrain: an environment to the row, a level to the column."""
    charts = []
    top = int(_top(rows, "level"))
    several = len({r.payload for r in rows}) > 1
    left = 72.0 if several else 30.0
    for terrain in dict.fromkeys(r.terrain for r in rows if r.search):
        group = [r for r in rows if r.terrain == terrain and r.search]
        group.sort(key=attrgetter("payload", "friction"))
        lines: list[dict[str, Any]] = []
        for i, row in enumerate(group):
            y = _HEAT_TOP + _CELL * i
            outcomes = row.search or {}
            label = number(row.friction) + (f", {number(row.payload)} kg" if several else "")
            lines.append(
                {
                    "label": label,
                    "y": y,
                    "passed": [left + _CELL * (k - 1) for k, v in sorted(outcomes.items()) if v],
                    "failed": [left + _CELL * (k - 1) for k, v in sorted(outcomes.items()) if not v],
                    "open": [left + _CELL * (k - 1) for k in range(1, top + 1) if k not in outcomes],
                    "reached": left + _CELL * (row.level - 1) if row.level else None,
                }
            )
        bottom = _HEAT_TOP + _CELL * len(group)
        charts.append(
            {
                "terrain": terrain_label(terrain),
                "size": (left + _CELL * top + 6.0, bottom + _HEAT_BOTTOM),
                "cell": _CELL,
                "left": left,
                "bottom": bottom,
                "lines": lines,
                "x_ticks": [{"x": round(left + _CELL * (k - 0.5), 2), "label": str(k)} for k in range(1, top + 1)],
                "axis": "friction μ, payload" if several else "friction μ",
            }
        )
    return charts


def curves(series: Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]]) -> dict[str, Any]:
    """Draw quantities over something that grows, several lines for each label, on axes that begin at zero or below.

    Args:
        series: by label, for each line the x and y of its points; values that are not finite are left out.

    Returns:
        ``size``, ``frame``, ``x_ticks``, ``y_ticks`` and ``lines``, each with its ``label``, the label's ``turn``, its ``place`` among
        the label's lines, and ``points``.
    """
    lines = [
        (label, turn, place, [(x, y) for x, y in zip(*line, strict=True) if math.isfinite(x) and math.isfinite(y)])
        for turn, (label, own) in enumerate(series.items())
        for place, line in enumerate(own)
    ]
    points = [point for *_, line in lines for point in line] or [(1.0, 1.0)]
    end = max(x for x, _ in points) or 1.0
    low, high = min(0.0, *(y for _, y in points)), max(0.0, *(y for _, y in points))
    high = high if high > low else low + 1.0
    left, right = _CURVE_LEFT, _CURVE_WIDTH - _CURVE_RIGHT
    upper, lower = _PANEL_TOP, _CURVE_HEIGHT - _PANEL_BOTTOM
    x_of = partial(_linear, domain=(0.0, end), span=(left, right))
    y_of = partial(_linear, domain=(low, high), span=(lower, upper))
    return {
        "size": (_CURVE_WIDTH, _CURVE_HEIGHT),
        "frame": (left, right, upper, lower),
        "x_ticks": [{"x": x_of(v), "label": _tick(v)} for v in _round_values(0.0, end)],
        "y_ticks": [{"y": y_of(v), "label": _tick(v)} for v in _round_values(low, high)],
        "lines": [
            {"label": label, "turn": turn, "place": place, "points": [(x_of(x), y_of(y)) for x, y in line]}
            for label, turn, place, line in lines
        ],
    }


def _round_values(low: float, high: float) -> list[float]:
    """Return four to eleven multiples of 1, 2 or 5 times a power of ten within a range."""
    power = 10.0 ** math.floor(math.log10((high - low) / 4.0))
    step = max(m * power for m in (1.0, 2.0, 5.0) if m * power <= (high - low) / 4.0 * (1.0 + 1e-9))
    return [float(f"{i * step:.6g}") for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _tick(value: float) -> str:
    """Return a round value with all of its decimals and a true minus sign."""
    return f"{Decimal(f'{value:.6g}'):f}".replace("-", "−")


def _by_terrain(rows: Sequence[EnvironmentRow], quantity: str) -> dict[str, list[EnvironmentRow]]:
    found: dict[str, list[EnvironmentRow]] = {}
    for row in rows:
        if getattr(row, quantity) is not None:
            found.setdefault(row.terrain, []).append(row)
    return found


def _top(rows: Sequence[EnvironmentRow], quantity: str) -> float:
    """Return the upper end of the axis of a quantity."""
    return 1.0 if quantity == "score" else float(max([LEVELS, *(r.level for r in rows if r.level is not None)]))


def _thin(values: Sequence[float]) -> Sequence[float]:
    """Return every n-th value, so that at most six labels stand beside each other; the first always."""
    return values[:: math.ceil(len(values) / 6)]


def _linear(value: float, domain: tuple[float, float], span: tuple[float, float]) -> float:
    return round(span[0] + (value - domain[0]) / (domain[1] - domain[0]) * (span[1] - span[0]), 2)
