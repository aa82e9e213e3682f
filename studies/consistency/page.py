"""``consistency.html``: one self-contained page with what ``consistency.json`` holds. It loads nothing from anywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

from ...gauge.metrics import metric_label
from ...gauge.report.charts import number, terrain_label
from ...gauge.report.pages import page_of, page_template
from .. import interval_charts
from .charts import curves
from .statistics import DIFFERENT, EQUIVALENT
from .study import SCHEMA

CURVES = {
    "position": ("distance of the bases", "m"),
    "angle": ("angle between the bases", "rad"),
    "joints": ("joint angles, root mean square", "rad"),
    "energy": ("difference of mechanical energy", "J"),
}
TESTS = {"air": "Chirp in free fall", "stand": "Standing pose held", "walk": "The policy’s recorded targets"}
FIELD_LABELS = {
    "total_mass": "total mass [kg]",
    "body_mass": "body masses [kg]",
    "body_inertia": "principal moments of inertia [kg·m²]",
    "joint_range": "joint limits [rad]",
    "joint_armature": "rotor inertia [kg·m²]",
    "joint_damping": "passive damping [N·m·s/rad]",
    "joint_friction_loss": "dry friction [N·m]",
    "stiffness": "motor stiffness [N·m/rad]",
    "damping": "motor damping [N·m·s/rad]",
    "torque_limit": "torque limit [N·m]",
    "contact_friction": "sliding friction under the feet",
    "contact_dimension": "dimension of the feet's contacts",
    "contact_torsion": "torsional friction under the feet [m]",
    "contact_rolling": "rolling friction under the feet [m]",
    "contact_cone": "faces of the friction cone",
    "contact_softness": "time constant of the feet's contacts [s]",
    "contact_restitution": "restitution of the feet",
}


def write_page(folder: Path) -> Path:
    """Write ``consistency.html`` beside the ``consistency.json`` that it shows, all or nothing.

    Raises:
        StoreError: the folder holds no study, or a damaged one, or one of another version.
    """
    return page_of(folder / "consistency.json", "consistency.html", render, command="consistency", schema=SCHEMA)


def render(results: Mapping[str, Any]) -> str:
    """The page of some results, as HTML text. Whatever they contain is shown as text and never becomes markup."""
    template = page_template(
        __file__,
        "consistency.html.j2",
        fixed=_fixed,
        short=_short,
        number=number,
        model_difference=difference_of_fields,
        terrain=terrain_label,
        metric=metric_label,
    )
    return template.render(page_data(results))


def page_data(results: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that the page shows, in its order and coordinates."""
    suite, provenance = results["suite"], results["provenance"]
    levels = sorted({c["level"] for c in results["cells"] if c["level"]})
    frictions = sorted({c["friction"] for c in results["cells"]})
    facts = [
        f"{suite['name']} {suite['version']}",
        f"robot {results['robot']}",
        f"reference {results['reference']}",
        f"friction {', '.join(map(number, frictions))}",
        *(["level " + ", ".join(str(v) for v in levels)] if levels else []),
        f"{len(results['seeds'])} seeds",
        provenance["date"][:10],
    ]
    policies = [_policy(p, results["reference"], results["margin"]) for p in results["policies"]]
    more = {"facts": facts, "seeds": len(results["seeds"]), "policies": policies, "fields": FIELD_LABELS}
    return dict(results) | more


def _policy(block: Mapping[str, Any], reference: str, margin: float) -> dict[str, Any]:
    """One policy's part of the page."""
    gaps = [{"pair": g["pair"], "place": "overall", **g["overall"]} for g in block["gaps"]]
    scale = interval_charts.common_scale([g["gap"] for g in gaps] + [block["floor"]["overall"]["gap"]], signed=False)
    for row in gaps:
        row["strip"] = interval_charts.strip(row["gap"], scale, block["floor"]["overall"]["gap"])
    return dict(block) | {
        "title": PurePath(block["policy"].replace("\\", "/")).name,
        "gaps": gaps,
        "gap_scale": interval_charts.strip_scale(scale),
        "floor": block["floor"]["overall"]["gap"],
        "verdicts": [
            {"label": label, "text": verdict(pair["overall"], margin)} for label, pair in block["pairs"].items()
        ],
        "pairs": {label: _pair(pair) for label, pair in block["pairs"].items()},
        "open_loop": _open_loop(block["open_loop"], reference),
        "attribution": _attribution(block["attribution"]),
        "unhealthy": {k: v for k, v in block["health"].items() if v["diverged"] or v["overflowed"]},
    }


def difference_of_fields(found: Mapping[str, Any]) -> str:
    """Return the place of the largest difference between two models with both values: the other's, then the reference's."""
    if found["values"] is None:
        return str(found["entry"])
    reference, other = ("none" if value is None else f"{value:.4g}" for value in found["values"])
    return f"{other}, not {reference} ({found['entry']})"


def verdict(overall: Mapping[str, Any], margin: float) -> str:
    """What a comparison says, in one sentence."""
    difference, excess = overall["difference"], overall["excess"]
    low, high = difference["interval"]
    where = f"{_signed(low)} to {_signed(high)}"
    if overall["verdict"] == EQUIVALENT:
        text = f"The qualities are equivalent: their difference ({where}) lies within ±{margin:g}"
    elif overall["verdict"] == DIFFERENT:
        side = "higher" if difference["value"] > 0 else "lower"
        text = f"The quality is {side} by {_fixed(abs(difference['value']))} ({where})"
    else:
        text = f"Whether the qualities differ is open: the difference lies between {_signed(low)} and {_signed(high)}"
        seeds = overall["deciding_seeds"]
        text += (
            ", more than 1000 seeds would decide" if seeds is None else f"; about {seeds} seeds would decide (--seeds)"
        )
    if excess is None:
        return text + "."
    low, high = excess["interval"]
    if low > 0.0:
        return f"{text}; single episodes differ by more than single precision makes them differ in the reference engine alone."
    if high < margin:
        return (
            f"{text}; single episodes differ by no more than single precision makes them differ in the reference engine alone, "
            f"to within {margin:g}."
        )
    return f"{text}; single episodes may differ by up to {_fixed(high)} more than single precision explains: more seeds would tell."


def cause(to: Mapping[str, Any]) -> str:
    """What a switch's change of the gap to another engine says of it."""
    if to["verdict"] == EQUIVALENT:
        return "no cause"
    if to["verdict"] == DIFFERENT:
        return "a cause" if to["change"]["value"] < 0.0 else "drives apart"
    return str(to["verdict"])


def _pair(pair: Mapping[str, Any]) -> dict[str, Any]:
    """Terrains, metrics and outcomes of one comparison."""
    places = {"overall": pair["overall"], **pair["terrains"]}
    gap_scale = interval_charts.common_scale([p[k] for p in places.values() for k in ("gap", "floor")], signed=False)
    difference_scale = interval_charts.common_scale([p["difference"] for p in places.values()], signed=True)
    metrics = pair["overall"]["metrics"]
    metric_scale = interval_charts.common_scale([m["difference"] for m in metrics.values()], signed=True)
    return {
        "rows": [
            {
                "place": name,
                **place,
                "gap_strip": interval_charts.strip(place["gap"], gap_scale, place["floor"]),
                "difference_strip": interval_charts.strip(place["difference"], difference_scale),
            }
            for name, place in places.items()
        ],
        "gap_scale": interval_charts.strip_scale(gap_scale),
        "difference_scale": interval_charts.strip_scale(difference_scale),
        "metrics": {
            n: {**m, "strip": interval_charts.strip(m["difference"], metric_scale)} for n, m in metrics.items()
        },
        "metric_scale": interval_charts.strip_scale(metric_scale),
        "commands": pair["commands"],
        "matrix": {
            name: {m: row["difference"] for m, row in place["metrics"].items()}
            for name, place in pair["terrains"].items()
        },
    }


def _open_loop(block: Mapping[str, Any], reference: str) -> dict[str, Any]:
    """Curves of every test, and what they end with."""
    differences: Mapping[str, Any] = block["differences"]
    labels = [label for label in differences if label != block["floor"]] + [block["floor"]]
    tests = []
    for test, title in TESTS.items():
        rows = [{"label": label, **differences[label][test]} for label in labels]
        panels = [
            curves({row["label"]: (row["time"], row["curves"][name]) for row in rows}, title=words, unit=unit)
            for name, (words, unit) in CURVES.items()
        ]
        tests.append({"name": test, "title": title, "panels": panels, "rows": rows})
    supports = {label: differences[label]["stand"]["support"][1] for label in labels[:-1]}
    base = differences[labels[0]]["stand"]["support"][0] if labels else None
    return {"tests": tests, "labels": labels, "floor": block["floor"], "support": {reference: base, **supports}}


def _attribution(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Interval charts of what each switch does."""
    played = [r for r in rows if r["not_run"] is None]
    scale = interval_charts.common_scale([r["difference"] for r in played], signed=True)
    changes = interval_charts.common_scale([t["change"] for r in played for t in r["to"].values()], signed=True)
    shown: list[dict[str, Any]] = [
        {
            **r,
            "strip": interval_charts.strip(r["difference"], scale),
            "to": {
                label: {**t, "cause": cause(t), "strip": interval_charts.strip(t["change"], changes)}
                for label, t in r["to"].items()
            },
        }
        for r in played
    ]
    return {
        "rows": shown,
        "scale": interval_charts.strip_scale(scale),
        "change_scale": interval_charts.strip_scale(changes),
        "engines": list(dict.fromkeys(label for r in shown for label in r["to"])),
        "metrics": list(shown[0]["metrics"]) if shown else [],
        "not_run": [r for r in rows if r["not_run"] is not None],
    }


def _fixed(value: float | None, digits: int = 4) -> str:
    """A number with fixed decimals, or as a power of ten where these would hide it; a dash for what does not exist."""
    if value is not None and digits == 4 and 0.0 < abs(value) < 5e-4:
        return f"{value:.1e}".replace("-", "−")
    return "–" if value is None else f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


def _signed(value: float) -> str:
    return ("+" if value > 0.0 else "") + _fixed(value)


def _short(value: float | None) -> str:
    """A number with three significant digits; a dash for what does not exist."""
    return "–" if value is None else f"{value:.3g}".replace("-", "−")
