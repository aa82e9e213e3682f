"""``trial.html``: how many robots came through, and the way that each took. One page that loads nothing from anywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ...gauge.report.pages import page_template

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
    """The ways of a policy's robots in a scenario: from the side where the ground has a shape, else from above.

    Returns:
        ``size``, ``ground`` and ``paths`` (points in SVG units, with ``outcome``, ``end`` and ``title``), ``ticks`` of x, and
        ``side``.
    """
    side = bool(entry["profile"])
    up = 2 if side else 1
    ways = [[(p[0], p[up]) for p in row["path"] if all(map(math.isfinite, p))] for row in result["rows"]]
    points = [p for way in ways for p in way] + [tuple(p) for p in entry["profile"]]
    low_x, high_x = min(x for x, _ in points), max(x for x, _ in points)
    low, high = min(y for _, y in points), max(y for _, y in points)
    if not side:
        low, high = min(low, -1.0), max(high, 1.0)
    scale = min((_WIDTH - 2 * _MARGIN) / max(high_x - low_x, 1e-6), _TALLEST / max(high - low, 1e-6))

    def place(x: float, y: float) -> tuple[float, float]:
        return round(_MARGIN + scale * (x - low_x), 1), round(8.0 + scale * (high - y), 1)

    step = next(s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 50.0, 1e9) if (high_x - low_x) / s <= 12)
    bottom = round(8.0 + scale * (high - low), 1)
    ticks = [step * i for i in range(math.ceil(low_x / step), math.floor(high_x / step) + 1)]
    return {
        "side": side,
        "size": (_WIDTH, bottom + 34.0),
        "bottom": bottom,
        "ground": [place(*p) for p in entry["profile"]],
        "ticks": [{"x": place(t, low)[0], "text": f"{t:g}".replace("-", "−")} for t in ticks],
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
