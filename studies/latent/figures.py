"""Figures of latents as SVG files that stand alone, and the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jinja2
import markupsafe
import numpy as np
from numpy.typing import NDArray

from ...gauge.report.pages import fixed, page_template
from .collecting import Notes

FIGURES = ("terrains", "commands", "experts")
SPACES = {
    "latent": "latent",
    "latent_mean": "latent, means of 1 s",
    "experts": "experts' weights",
    "experts_mean": "experts' weights, means of 1 s",
    "input": "network's input",
    "input_mean": "network's input, means of 1 s",
}
"""In what classes are told apart, in the order in which tables list it."""
LABELS = {"slope_fd": "slope up", "slope_bd": "slope down", "stairs_fd": "stairs up", "stairs_bd": "stairs down"}
LABELS |= {"obstacle": "obstacles"}
"""Terrains as a robot meets them that walks forward from where quality episodes start."""
_COLOURS = ("#0072b2", "#e69f00", "#d55e00", "#cc79a7", "#009e73", "#56b4e9", "#5c4033", "#9a9a00")
"""Okabe and Ito's, without yellow and black; readers who see colours differently can tell them apart. Others follow for more classes."""
_GOLDEN_ANGLE = 137.508
_SIDE, _LEFT, _TOP, _GAP = 300.0, 34.0, 46.0, 26.0
_MOST_POINTS = 1500
"""Points of a policy that are drawn; all of them are in the CSV file."""
_ROW, _CELL, _NAMES, _LINE = 22.0, 40.0, 96.0, 18.0

Points = Sequence[tuple[str, Notes, Mapping[str, NDArray[np.float64]]]]


def label(name: str) -> str:
    """A terrain's or a command's name for readers."""
    return LABELS.get(name, name.replace("_", " "))


def draw(name: str, results: Mapping[str, Any], points: Points) -> dict[str, Any] | None:
    """A figure's ``name``, a panel for each policy, and a ``legend`` of classes; None where no policy has what it shows."""
    if name == "experts":
        panels = [_weights_panel(e) for e in results["policies"] if e["experts"] is not None]
        legend: list[dict[str, Any]] = []
    else:
        entries = {e["label"]: e for e in results["policies"]}
        classes = [label(n) for n in results[name]]
        panels = [_scatter(name, entries[who], notes, places[name]) for who, notes, places in points if name in places]
        legend = [{"text": text, "colour": _colour(i)} for i, text in enumerate(classes)]
    for panel in panels:
        # the panel's template has escaped what is in it
        panel["drawn"] = markupsafe.Markup(_template("latent_panel.svg.j2").render(name=name, p=panel))
    return {"name": name, "panels": panels, "legend": legend} if panels else None


def render_figure(drawing: Mapping[str, Any]) -> str:
    """A figure as an SVG file that stands alone, its panels side by side."""
    x, places = _LEFT, []
    for panel in drawing["panels"]:
        places.append((x, panel))
        x += panel["width"] + _GAP + (_LEFT if drawing["legend"] else 0.0)
    at, y = _LEFT, _TOP + max(p["height"] for p in drawing["panels"]) + 44.0
    legend = []
    for item in drawing["legend"]:
        width = 28.0 + 7.0 * len(item["text"])
        if at + width > max(x, 360.0) and at > _LEFT:
            at, y = _LEFT, y + _LINE
        legend.append({**item, "x": round(at, 1), "y": y})
        at += width
    return _template("latent.svg.j2").render(
        name=drawing["name"],
        panels=places,
        legend=legend,
        top=_TOP,
        size=(round(max(x, 380.0), 1), round(y + _LINE if legend else y - 30.0, 1)),
    )


def render_page(results: Mapping[str, Any], drawings: Mapping[str, Mapping[str, Any]]) -> str:
    """The page, as HTML text. Whatever names contain is shown as text and never becomes markup."""
    return _template("latent.html.j2").render(results=results, figures=drawings, spaces=SPACES)


_fixed = partial(fixed, digits=2)


def _colour(index: int) -> str:
    if index < len(_COLOURS):
        return _COLOURS[index]
    hue = (index * _GOLDEN_ANGLE) % 360.0  # of neighbours far apart, and never the same again
    return f"hsl({hue:.1f}, 65%, {(38, 58)[index % 2]}%)"


def _template(name: str) -> jinja2.Template:
    return page_template(__file__, name, label=label, fixed=_fixed)


def _scatter(name: str, entry: Mapping[str, Any], notes: Notes, places: NDArray[np.float64]) -> dict[str, Any]:
    """Points on the first two principal axes, a colour for each class."""
    classes = notes.terrain if name == "terrains" else notes.command
    rows = np.flatnonzero(~np.isnan(places[:, 0]))
    # the same share of every class: an even walk through them, class by class
    rows = rows[np.argsort(classes[rows], kind="stable")]
    rows = rows[:: max(math.ceil(len(rows) / _MOST_POINTS), 1)]
    low, high = places[rows].min(axis=0), places[rows].max(axis=0)
    scale = 0.94 * _SIDE / max(float((high - low).max()), 1e-9)
    middle = (low + high) / 2
    spots = (places[rows] - middle) * (scale, -scale) + _SIDE / 2
    mine = [spots[classes[rows] == c] for c in range(int(classes.max()) + 1)]
    paths = ["".join(f"M{x:.0f} {y:.0f}h0" for x, y in some) for some in mine]
    found = entry[name].get("latent")
    words = f"silhouette {found['silhouette']:.2f}, probe {found['probe']:.2f}".replace("-", "−") if found else ""
    return {
        "title": entry["label"],
        "words": words,
        "width": _SIDE,
        "height": _SIDE,
        "box": (-22.0, -2.0, _SIDE + 24.0, _SIDE + 26.0),
        "axes": [f"PC {i + 1} ({100 * share:.0f} %)" for i, share in enumerate(entry[name]["explained"])],
        "paths": [{"colour": _colour(c), "path": path} for c, path in enumerate(paths)],
    }


def _weights_panel(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Mean weights of the experts: a row for each terrain and each command, a column for each expert."""
    experts = entry["experts"]
    rows = [(label(name), means) for pair in ("terrains", "commands") for name, means in experts[pair].items()]
    most = max(max(means) for _, means in rows)
    count = len(rows[0][1])
    width, height = _NAMES + _CELL * count, _ROW * (len(rows) + 1)
    return {
        "title": entry["label"],
        "words": f"{experts['at_once']:.1f} of {count} at once, {experts['in_all']:.1f} in all",
        "width": width,
        "height": height,
        "box": (0.0, 0.0, width, height + 4.0),
        "columns": [{"x": _NAMES + _CELL * (k + 0.5), "text": str(k + 1)} for k in range(count)],
        "rows": [
            {
                "y": _ROW * (i + 1) + (4.0 if i >= len(experts["terrains"]) else 0.0),
                "name": name,
                "cells": [
                    {"x": _NAMES + _CELL * k, "share": round(w / most, 3), "text": f"{w:.2f}".removeprefix("0")}
                    for k, w in enumerate(means)
                ],
            }
            for i, (name, means) in enumerate(rows)
        ],
        "cell": (_CELL, _ROW),
    }
