"""``worst.html``: failures with their films, one self-contained page with what ``worst.json`` holds. It loads nothing from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ...gauge.report.pages import page_of, page_template
from .ranges import PARAMETERS
from .study import SCHEMA

_LARGEST_FILM = 4_000_000
"""Bytes of a film that the page takes in."""
_UNITS = {
    "command": "speeds of each of three commands, shares of the policy's limits",
    "push": "force forward and to the left, shares of the weight",
    "push_begin": "its beginning after the start [s]",
    "push_seconds": "its length [s]",
    "friction": "coefficient of the ground",
    "patch_friction": "coefficient of a patch wider than the robot",
    "patch_begin": "time at which the robot comes onto it [s]",
    "patch_seconds": "time on it [s]",
    "payload": "share of the robot's mass",
    "payload_along": "place forward and to the left, shares of the leg length",
    "payload_above": "place above the centre of mass, share of the leg length",
    "latency": "of every action [s]",
    "slope": "inclination of 3 m of ground, positive uphill [rad]",
    "step": "height of a step, positive upwards, share of the leg length",
    "step_count": "number of steps",
    "heading": "in which the robot comes to the steps [rad]",
}


def write_page(folder: Path) -> Path:
    """Write ``worst.html`` beside the ``worst.json`` that it shows, all or nothing.

    Raises:
        StoreError: the folder holds no search that has ended, or a damaged one, or one of another version.
    """
    return page_of(folder / "worst.json", "worst.html", partial(render, folder=folder), command="worst", schema=SCHEMA)


def render(results: Mapping[str, Any], folder: Path | None = None) -> str:
    """Return the page of some results, as HTML text. Whatever they contain is shown as text and never becomes markup.

    Args:
        folder: of the films; None for a page without films.
    """
    engines = [results["engine"], *(other["engine"] for other in results["others"])]
    failures = [
        dict(failure)
        | {"picture": _film(folder, failure["film"]), "shares": [_share(failure["again"][name]) for name in engines]}
        for failure in results["failures"]
    ]
    gallery = sorted((f for f in failures if f["rank"] is not None), key=lambda f: f["rank"])
    ranges: dict[str, dict[str, Any]] = {}
    for parameter in PARAMETERS:
        low, high = results["ranges"][parameter.range]
        ranges.setdefault(
            parameter.range,
            {"factor": parameter.factor, "what": _UNITS[parameter.range], "low": low, "high": high},
        )
    return page_template(__file__, "worst.html.j2").render(
        **dict(results)
        | {"failures": failures, "gallery": gallery, "engines": engines, "ranges": list(ranges.values())}
    )


def _film(folder: Path | None, name: str | None) -> str | None:
    """Return a film as base64; None where there is none, or a large one."""
    if folder is None or name is None:
        return None
    path = folder / "films" / Path(name).name
    if not path.is_file() or path.stat().st_size > _LARGEST_FILM:
        return None
    return base64.b64encode(path.read_bytes()).decode()


def _share(fell: list[bool]) -> str:
    return f"{sum(fell)} of {len(fell)}"
