"""``jury.html``: one self-contained page with what ``jury.json`` holds. It loads nothing from anywhere."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...gauge.report.pages import page_of, page_template
from .. import interval_charts
from .study import SCHEMA
from .verdict import OFF, command_words


def write_page(folder: Path) -> Path:
    """Write ``jury.html`` beside the ``jury.json`` that it shows, all or nothing.

    Raises:
        StoreError: the folder holds no jury, or a damaged one, or one of another version.
    """
    return page_of(folder / "jury.json", "jury.html", render, command="jury", schema=SCHEMA)


def render(results: Mapping[str, Any]) -> str:
    """Return the page of some results, as HTML text. Whatever they contain is shown as text and never becomes markup."""
    suite = results["suite"]
    facts = [
        f"{suite['name']} {suite['version']}",
        f"part {results['part']}",
        f"robot {results['robot']}",
        f"{len(results['seeds'])} seeds",
        results["provenance"]["date"][:10],
    ]
    policies = [_policy(block) for block in results["policies"]]
    template = page_template(__file__, "jury.html.j2", words=command_words)
    return template.render(**dict(results) | {"facts": facts, "policies": policies})


def _policy(block: Mapping[str, Any]) -> dict[str, Any]:
    """Return one policy's part of the page."""
    scores = [e["score"] for e in block["engines"].values()]
    scale = interval_charts.common_scale([*scores, block["consensus"]], signed=False)
    differences = interval_charts.common_scale([a["difference"] for a in block["advantages"]], signed=True)
    return dict(block) | {
        "strips": {
            k: interval_charts.strip(e["score"], scale, block["consensus"]) for k, e in block["engines"].items()
        },
        "scale": interval_charts.strip_scale(scale),
        "advantages": [
            dict(a) | {"strip": interval_charts.strip(a["difference"], differences)} for a in block["advantages"]
        ],
        "difference_scale": interval_charts.strip_scale(differences),
        "speeds": [dict(row) | {"cells": [_cell(v) for v in row["shares"].values()]} for row in block["speeds"]],
    }


def _cell(share: float | None) -> dict[str, Any]:
    """Return a share of a commanded speed with its bar: width in percent of twice the commanded speed, and whether it is off."""
    if share is None:
        return {"text": "fell", "width": 0.0, "off": True}
    return {"text": f"{share:.2f}", "width": round(50.0 * min(max(share, 0.0), 2.0), 1), "off": abs(share - 1.0) > OFF}
