"""Pages on logs, ``replay.html`` and others, each one file that loads nothing: traces, residuals, tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...gauge.report.pages import page_template
from ...robots.sets import joint_groups
from .log import Array, Log
from .residuals import BANDS, spectrum
from .rig import Motion

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 560.0, 190.0, 48.0, 8.0, 8.0, 30.0
COLOURS = ("recorded", "first", "second", "third", "fourth", "fifth")
_ZOOM = 1.5
_WINDOW = 0.5
UNITS = {"position": ("mrad", 1e3), "velocity": ("rad/s", 1.0), "torque": ("N·m", 1.0)}


def render_page(results: Mapping[str, Any], pictures: Sequence[Any]) -> str:
    """Return the page as HTML text. Whatever names contain is shown as text and never becomes markup."""
    template = page_template(__file__, "replay.html.j2", unit=_unit, scaled=_scaled, number=_number)
    return template.render(results=results, pictures=pictures, bands=BANDS, units=UNITS)


def render_identified(results: Mapping[str, Any]) -> str:
    """Return the page of an identification as HTML text."""
    return page_template(__file__, "identify.html.j2", number=_number).render(results=results)


def render_preflight(results: Mapping[str, Any], log: Log, pose: Array) -> str:
    """Return the page of a preflight as HTML text; ``pose`` is the policy's in the log's order of joints [rad], (J,)."""
    charts = {}
    for j, joint in enumerate(log.robot.joint_names):
        lines = {"recorded": log.position[:, j], "target": log.target[:, j], "pose": np.full(len(log.time), pose[j])}
        charts[joint] = _chart(log.time, lines, "position [rad]", "time [s]")
    wrong = sum(finding["verdict"] == "wrong" for finding in results["findings"])
    template = page_template(__file__, "preflight.html.j2", number=_number)
    return template.render(results=results, charts=charts, wrong=wrong)


def _unit(quantity: str) -> str:
    return UNITS[quantity][0]


def _scaled(value: float, quantity: str) -> str:
    return _number(value * UNITS[quantity][1])


def _number(value: float) -> str:
    return f"{value:.4g}".replace("-", "−")


def traces(log: Log, motions: Mapping[str, Motion], errors: Mapping[str, Mapping[str, Array]]) -> list[dict[str, Any]]:
    """Return for each group of joints the charts of its worst joint's motion, of its residuals in time, and of their spectrum."""
    found = []
    first = next(iter(errors.values()))["position"]
    for group, joints in joint_groups(log.robot).items():
        worst = max(joints, key=lambda j: float(np.nanmean(first[:, j] ** 2)))
        middle = _worst_time(log, first[:, worst])
        rows = (log.time >= middle - _ZOOM / 2) & (log.time <= middle + _ZOOM / 2)
        lines = {"recorded": log.position[rows, worst]} | {k: m.position[rows, worst] for k, m in motions.items()}
        motion = _chart(log.time[rows], lines, "position [rad]", "time [s]")
        sliding = {label: _sliding(log, e["position"][:, joints]) for label, e in errors.items()}
        times = np.array([(i + 0.5) * _WINDOW for i in range(len(next(iter(sliding.values()))))])
        in_time = _chart(
            times, {k: 1e3 * v for k, v in sliding.items()}, "RMS difference [mrad]", "time [s]", zero=True
        )
        spectra = {label: spectrum(log, e["position"][:, joints]) for label, e in errors.items()}
        frequency = next(iter(spectra.values()))[0]
        kept = (frequency > 0.0) & (frequency <= BANDS[-1][1])
        amplitude = {k: 1e3 * np.sqrt(p.mean(axis=1))[kept] for k, (_, p) in spectra.items()}
        over = _chart(frequency[kept], amplitude, "mrad/√Hz", "frequency [Hz]", logarithmic=True)
        found.append({"group": group, "joint": log.robot.joint_names[worst], "charts": (motion, in_time, over)})
    return found


def _worst_time(log: Log, error: Array) -> float:
    means = _sliding(log, error[:, None])
    means = np.nan_to_num(means)
    return float(np.clip((np.argmax(means) + 0.5) * _WINDOW, _ZOOM / 2, max(log.time[-1] - _ZOOM / 2, _ZOOM / 2)))


def _sliding(log: Log, error: Array) -> Array:
    """Return the RMS difference in each window, (W,)."""
    window = (log.time / _WINDOW).astype(np.int64)
    known = np.isfinite(error).all(axis=1)
    count = np.bincount(window[known], minlength=window.max() + 1)
    total = np.bincount(window[known], weights=(error[known] ** 2).mean(axis=1), minlength=window.max() + 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Array = np.sqrt(total / count)
    return found


def _chart(
    x: Array, lines: Mapping[str, Array], y_name: str, x_name: str, *, zero: bool = False, logarithmic: bool = False
) -> dict[str, Any]:
    """Return a line chart's geometry in SVG units: ``paths``, ticks with texts, names of the axes."""
    values = np.concatenate([v[np.isfinite(v)] for v in lines.values()])
    if logarithmic:
        low, high = math.log10(max(values.min(), values.max() * 1e-4)), math.log10(values.max())
        ticks_y = [10.0**e for e in range(math.ceil(low), math.floor(high) + 1)]
    else:
        low, high = (0.0 if zero else float(values.min())), float(values.max())
        ticks_y = _ticks(low, high)
    span = max(high - low, 1e-9)

    def place_x(value: float) -> float:
        return round(LEFT + (WIDTH - LEFT - RIGHT) * (value - x[0]) / (x[-1] - x[0]), 1)

    def place_y(value: float) -> float:
        level = math.log10(max(value, 1e-12)) if logarithmic else value
        return round(TOP + (HEIGHT - TOP - BOTTOM) * (1.0 - (min(max(level, low), high) - low) / span), 1)

    step = max(len(x) // 700, 1)
    paths = []
    for number, (label, line) in enumerate(lines.items()):
        colour = COLOURS[(number if "recorded" in lines else number + 1) % len(COLOURS)]
        points = [(place_x(a), place_y(b)) for a, b in zip(x[::step], line[::step], strict=True) if math.isfinite(b)]
        paths.append({"label": label, "class": colour, "points": points})
    return {
        "paths": paths,
        "size": (WIDTH, HEIGHT),
        "frame": (LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM),
        "x": [{"at": place_x(t), "text": _number(t)} for t in _ticks(float(x[0]), float(x[-1]))],
        "y": [{"at": place_y(t), "text": _number(t)} for t in ticks_y],
        "names": (x_name, y_name),
    }


def _ticks(low: float, high: float) -> list[float]:
    span = max(high - low, 1e-9)
    power = 10.0 ** math.floor(math.log10(span))
    step = next(m * power for m in (0.1, 0.2, 0.5, 1.0, 2.0) if span / (m * power) <= 6)
    return [step * i for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
