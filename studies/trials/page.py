"""``trial.html``: how many robots came through, and the way that each took. One page that loads nothing from anywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from ...gauge.report.pages import page_template
from .running import PATH_INTERVAL

_WIDTH = 720.0
_MARGIN = 34.0
_TALLEST = 320.0


def render_page(results: Mapping[str, Any]) -> str:
    """The page, as HTML text. Whatever names contain is shown as text and never becomes markup."""
    scenarios = [
        {**entry, "reported_text": reported(entry["reported"]), "views": [view(entry, r) for r in entry["results"]]}
        for entry in results["scenarios"]
        if entry["results"]
    ]
    return page_template(__file__, "trial.html.j2", percent=percent, measures=measures).render(
        scenarios=scenarios,
        policies=results["policies"],
        refused=results["refused"],
        backend=results["backend"],
        provenance=results["provenance"],
    )


def percent(interval: Sequence[float]) -> str:
    """An interval of shares for readers."""
    return f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f} %"


def reported(entries: Sequence[Mapping[str, Any]]) -> str:
    """What others report of the same trial, in words."""
    parts = []
    for e in entries:
        counts = None if e["successes"] is None or e["trials"] is None else f"{e['successes']}/{e['trials']}"
        parts.append(f"{e['who']}: {', '.join(p for p in (counts, e['text']) if p)}")
    return "; ".join(parts)


def measures(result: Mapping[str, Any]) -> str:
    """Medians that say something of these trials, in words."""
    m = result["medians"]
    words = []
    if m["progress"] is not None and result["successes"] < result["trials"]:
        words.append(f"{100 * m['progress']:.0f} % of the way")
    if m["reached"] is not None:
        words.append(f"there in {m['reached']:.1f} s at {m['mean_speed']:.2f} m/s")
    if m["progress"] is None:
        words.append(f"peak {m['peak_speed']:.2f} m/s")
    if m["speed_time"] is not None:
        words.append(f"fast after {m['speed_time']:.2f} s")
    if m["tracking_error"] is not None:
        words.append(f"error {m['tracking_error']:.2f} m/s")
    return ", ".join(words)


def view(entry: Mapping[str, Any], result: Mapping[str, Any]) -> dict[str, Any]:
    """Draw a policy's robots in a scenario: their speed over time where the speed decides, else their ways.

    Ways are seen from the side where the ground has a shape, else from above.

    Returns:
        ``kind`` (``speed``, ``side`` or ``above``), ``size``, ``ground`` and ``paths`` (points in SVG units, with ``outcome`` and
        ``title``), ``ticks`` along the lower edge, ``values`` along the left one, and ``wanted``: y of the speed that decides.
    """
    wanted = entry["success"]["speed"] if entry.get("success") else None
    kind = "above" if not entry["profile"] else "side"
    kind = kind if wanted is None else "speed"
    up = 2 if kind == "side" else 1
    paths = [[p for p in row["path"] if all(map(math.isfinite, p))] for row in result["rows"]]
    ways = [speeds(path) if kind == "speed" else [(p[0], p[up]) for p in path] for path in paths]
    ground = [] if kind == "speed" else [tuple(p) for p in entry["profile"]]
    points = [p for way in ways for p in way] + ground
    points += [(0.0, 0.0), (1.0, wanted)] if wanted is not None else []
    low_x, high_x = min(x for x, _ in points), max(x for x, _ in points)
    low, high = min(y for _, y in points), max(y for _, y in points)
    if kind == "above":
        low, high = min(low, -1.0), max(high, 1.0)
    across = (_WIDTH - 2 * _MARGIN) / max(high_x - low_x, 1e-6)
    down = _TALLEST / max(high - low, 1e-6)
    if kind != "speed":  # metres are equally long in both directions
        across = down = min(across, down)

    def place(x: float, y: float) -> tuple[float, float]:
        return round(_MARGIN + across * (x - low_x), 1), round(8.0 + down * (high - y), 1)

    bottom = round(8.0 + down * (high - low), 1)
    values = _round_values(low, high) if kind == "speed" else []
    return {
        "kind": kind,
        "size": (_WIDTH, bottom + 34.0),
        "bottom": bottom,
        "ground": [place(*p) for p in ground],
        "ticks": [{"x": place(t, low)[0], "text": _text(t)} for t in _round_values(low_x, high_x)],
        "values": [{"y": place(low_x, v)[1], "text": _text(v)} for v in values],
        "wanted": None if wanted is None else place(low_x, wanted)[1],
        "paths": [
            {
                "points": [place(*p) for p in way],
                "outcome": row["outcome"],
                "title": f"seed {row['seed']}: {row['outcome']} after {row['seconds']:.1f} s",
            }
            for way, row in zip(ways, result["rows"], strict=True)
            if way
        ],
    }


def speeds(path: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    """Return time [s] and horizontal speed [m/s] between the places of a path, which are ``PATH_INTERVAL`` apart."""
    moved = [math.hypot(b[0] - a[0], b[1] - a[1]) / PATH_INTERVAL for a, b in pairwise(path)]
    return [((i + 0.5) * PATH_INTERVAL, speed) for i, speed in enumerate(moved)]


def _round_values(low: float, high: float) -> list[float]:
    step = next(s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 50.0, 1e9) if (high - low) / s <= 12)
    return [step * i for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _text(value: float) -> str:
    return f"{value:g}".replace("-", "−")
