"""``report.html``: one self-contained page with what ``results.json`` holds. It loads nothing from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePath
from typing import Any

from ...files.parsing import shown
from ..coverage import coverage_of, notes, score_label, suite_label
from ..metrics import metric_label
from ..results import SCHEMA
from ..store import StoreError
from . import charts
from .breakdown import breakdown
from .charts import FLAT, Row, number, terrain_label
from .pages import page_of, page_template
from .references import references_for

STATISTIC_LABELS = {"mean": "mean", "mean50": "mean@50", "mean25": "mean@25"}
"""In the order in which the radar draws them."""

CLIP = "clip.webp"
"""A film of the robot beside the results; it becomes part of the page."""
_LARGEST_CLIP = 4_000_000
"""[bytes]"""
_SHOWN = 6
"""Environments that a warning names before it says how many more there are."""
_LONGEST = 400
"""Characters of a provenance entry."""


def write_report(folder: Path) -> Path:
    """Write ``report.html`` beside the results that it shows, all or nothing.

    Raises:
        StoreError: the folder holds no results, or damaged ones, or some of another version.
    """
    clip = _clip(folder)
    return page_of(folder / "results.json", "report.html", lambda found: render(found, clip), command="evaluate")


def _clip(folder: Path) -> bytes | None:
    """The film that lies in a folder of results, None where there is none that fits into a page."""
    path = folder / CLIP
    return path.read_bytes() if path.is_file() and path.stat().st_size <= _LARGEST_CLIP else None


def render(results: Mapping[str, Any], clip: bytes | None = None) -> str:
    """The page of some results, as HTML text. Whatever they contain is shown as text and never becomes markup.

    Args:
        clip: a WebP film of the robot.

    Raises:
        StoreError: results of another schema.
    """
    if not isinstance(results, Mapping) or results.get("schema") != SCHEMA:
        found = results.get("schema") if isinstance(results, Mapping) else None
        raise StoreError(
            f"the results have schema {shown(found)}, this version reads {SCHEMA}; evaluate the policy again"
        )
    template = page_template(
        __file__,
        "report.html.j2",
        number=number,
        terrain=terrain_label,
        metric=metric_label,
        short_metric=partial(metric_label, short=True),
        grouped=_grouped,
    )
    return template.render(**report_data(results), clip=None if clip is None else base64.b64encode(clip).decode())


def report_data(results: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that ``templates/report.html.j2`` shows, in the order and the coordinates in which it is shown."""
    rows: list[Row] = results["environments"]
    evaluated = results["score"] is not None
    terrains: Mapping[str, Row] = results["terrains"]
    searched = any("search" in r for r in rows)
    both = (("friction", "over friction"), ("payload", "over payload"))
    level_figures = _figures(rows, "level", both) if searched else []
    expected = results["chance"].get("level") == "curve"
    return {
        "title": PurePath(results["policy"]["path"].replace("\\", "/")).name,
        "suite": results["suite"],
        "subtitle": _subtitle(results),
        "evaluated": evaluated,
        "searched": searched,
        "score": results["score"],
        "score_label": score_label(results),
        "coverage": coverage_of(results),
        "score_interval": results["score_interval"],
        "score_strip": _score_strip(results["score"], results["score_interval"]),
        "groups": _groups(results),
        "level": results["level"],
        "level_interval": results["level_interval"],
        "chance_note": results["chance"]["note"],
        "level_label": f"mean {'expected' if expected else 'maximum'} level" if searched else "mean level played",
        "expected_level": expected,
        "counts": _counts(results),
        "warnings": warnings(results),
        "statistics": STATISTIC_LABELS,
        "terrains": {
            name: {
                **row,
                "strip": charts.strip(row) if evaluated else None,
                "environments": sum(r["terrain"] == name for r in rows),
            }
            for name, row in terrains.items()
        },
        "radar": charts.radar(terrains, STATISTIC_LABELS) if evaluated else None,
        "level_figures": level_figures,
        "score_figures": _figures(rows, "score", both) if evaluated else [],
        "metrics": {name: {**row, "strip": charts.strip(row)} for name, row in results["metrics"].items()},
        "metric_matrix": metric_matrix(rows),
        "breakdown": breakdown(rows),
        "references": [
            {"of": r, "strip": charts.strip({"mean50": r.score, "interval": r.interval})}
            for r in references_for(results)
        ],
        "searches": charts.searches(rows),
        "rows": [_row(r) for r in rows],
        "events": any(r.get(flag) for r in rows for flag in _FLAGS),
        "metric_names": list(results["metrics"]),
        "terrain_order": {name: i for i, name in enumerate(terrains)},
        "several_payloads": len({r["payload"] for r in rows}) > 1,
        "sources": sources(results),
        "versions": results["provenance"]["versions"],
        "command": results["provenance"]["command"],
    }


def warnings(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What went wrong in a run, gravest first.

    Returns:
        For each kind ``severity`` (``grave`` or ``note``), ``headline``, ``meaning`` and ``places``, the worst first.
    """
    rows: Sequence[Row] = results["environments"]
    health = results["health"]
    total = _plural(health["episodes"], "quality episode")
    found = []
    if health["diverged"]:
        headline = f"physics diverged in {health['diverged']} of {total}"
        meaning = (
            "The simulation became invalid there; each counts as a fall. The engine or its settings may be at fault."
        )
        found.append(_warning("grave", headline, meaning, _places(rows, "diverged")))
    if health["overflowed"]:
        headline = f"contacts dropped in {health['overflowed']} of {total}"
        meaning = "The engine had no room for all contacts or constraints there, so these values are not exact."
        found.append(_warning("grave", headline, meaning, _places(rows, "overflowed")))
    if health["falls"]:
        headline = f"{_plural(health['falls'], 'fall')} in {total}"
        meaning = "The robot tilted beyond the suite's limit; the suite says what that ends and what it costs."
        found.append(_warning("grave", headline, meaning, _places(rows, "falls")))
    touching = health.get("self_contact")  # cards from before do not say
    if touching:
        headline = f"parts of the robot touch each other in {_percent(touching)} of the samples"
        meaning = "Legs that strike each other can break on a robot; episodes.csv says at which commands."
        found.append(_warning("note", headline, meaning, _places(rows, "self_contact", _percent)))
    failed = [r for r in rows if r["level"] == 0]
    if failed:
        searched = _plural(sum("search" in r for r in rows), "searched environment")
        headline = f"not even level 1 passed in {len(failed)} of {searched}"
        meaning = "They score zero and no quality is measured there."
        found.append(_warning("note", headline, meaning, _places(failed, None)))
    found += [
        _warning("note", "for the reader of the score", f"{text[0].upper()}{text[1:]}.", []) for text in notes(results)
    ]
    restarted = sum(r.get("restarted", 0) for r in rows)
    if restarted:
        headline = f"restarts in {restarted} of {total}"
        meaning = "A foot sank into the terrain, and the goal was started again once, as the suite says."
        found.append(_warning("note", headline, meaning, _places(rows, "restarted")))
    return found


def _warning(severity: str, headline: str, meaning: str, places: list[str]) -> dict[str, Any]:
    return {"severity": severity, "headline": headline, "meaning": meaning, "places": places}


def _places(rows: Sequence[Row], key: str | None, said: Callable[[Any], str] = str) -> list[str]:
    """Names of environments, those with the most of ``key`` first and how much that is, cut to a readable number."""
    chosen = list(rows) if key is None else sorted((r for r in rows if r.get(key)), key=lambda r: -r[key])
    payloads = len({r["payload"] for r in rows}) > 1
    names = []
    for row in chosen[:_SHOWN]:
        name = f"{terrain_label(row['terrain'])}, μ {number(row['friction'])}"
        name += f", {number(row['payload'])} kg" if payloads else ""
        names.append(name + (f" ({said(row[key])})" if key else ""))
    return names + ([f"and {len(chosen) - _SHOWN} more"] if len(chosen) > _SHOWN else [])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def metric_matrix(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Mean@50 of each metric on each terrain, over its environments that were played: at the levels reached, not weighted by them."""
    matrix: dict[str, dict[str, float]] = {}
    for terrain in dict.fromkeys(r["terrain"] for r in rows if "metrics" in r):
        played = [r for r in rows if r["terrain"] == terrain and "metrics" in r]
        tables = [{**r["metrics"], "quality": r["quality"]} for r in played]
        matrix[terrain] = {m: sum(t[m]["mean50"] for t in tables) / len(tables) for m in tables[0]}
    return matrix


def sources(results: Mapping[str, Any]) -> dict[str, str]:
    """Where the results come from, as labelled texts."""
    policy, provenance = results["policy"], results["provenance"]
    suite = results["suite"]
    entries = {
        "policy": policy["path"],
        "policy file, SHA-256": policy["file_sha256"],
        "policy contract, SHA-256": policy["contract_hash"],
        "suite": f"{suite['name']} {suite['version']}: {suite['title']}",
        "of the suite": coverage_of(results)["text"],
        "pipeline": results["pipeline"],
        "robot": results["robot"],
        "engine": _engine(results),
        "machine": f"{provenance['host']}: {provenance['machine']}",
        "date": provenance["date"],
        "time": f"{_duration(provenance['seconds'])} on {provenance['device']}, CPU threads: {provenance['threads']}",
        "physics steps": _grouped(provenance["physics_steps"]) + _rate(provenance),
    }
    for key, value in policy["provenance"].items():
        text = _in_words(value)
        entries[f"policy: {key}"] = text if len(text) <= _LONGEST else text[:_LONGEST] + "…"
    return entries


def _in_words(value: Any) -> str:
    """A provenance entry, which may be a table or a list, for readers."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_in_words(entry)}" for name, entry in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(_in_words, value))
    return "–" if value is None else str(value)


def _engine(results: Mapping[str, Any]) -> str:
    backend: str = results["backend"]
    version = results["provenance"]["versions"].get(backend.partition(":")[0])
    return f"{backend} {version}" if version else backend


def _rate(provenance: Mapping[str, Any]) -> str:
    """Physics steps per second, where the run was long enough and not wholly resumed."""
    if not provenance["physics_steps"] or provenance["seconds"] < 1.0:
        return ""
    return f" ({_grouped(round(provenance['physics_steps'] / provenance['seconds']))} a second)"


def _subtitle(results: Mapping[str, Any]) -> list[str]:
    return [
        suite_label(results),
        f"{results['pipeline']} pipeline",
        f"robot {results['robot']}",
        f"engine {_engine(results)}",
        results["provenance"]["date"][:10],
    ]


def _counts(results: Mapping[str, Any]) -> str:
    """How much the results rest on, in one line."""
    rows, episodes = results["environments"], results["health"]["episodes"]
    parts = [_plural(len(results["terrains"]), "terrain"), _plural(len(rows), "environment")]
    return " · ".join([*parts, _plural(episodes, "quality episode")] if episodes else parts)


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _groups(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    intervals = results.get("groups_interval", {})
    return {
        name: {"value": value, "interval": intervals.get(name), "strip": _score_strip(value, intervals.get(name))}
        for name, value in results["groups"].items()
    }


def _score_strip(value: float | None, interval: Sequence[float] | None) -> dict[str, Any] | None:
    return None if value is None else charts.strip({"mean50": value, "interval": interval})


def _figures(rows: Sequence[Row], quantity: str, axes: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
    """Charts of a quantity over friction and over payload, or over both where they are crossed."""
    figures: list[dict[str, Any]] = []
    for axis, words in axes:
        panels = charts.sweep(rows, axis=axis, quantity=quantity)
        if panels:
            fixed = {p["fixed"] for p in panels}
            where = ""
            if axis == "payload" and len(fixed) == 1:
                where = f" at friction {number(fixed.pop())}"
            elif len({r["payload"] for r in rows}) > 1 and len(fixed) == 1:
                where = f" at payload {number(fixed.pop())} kg"
            failed = any(p["failed"] for panel in panels for p in panel["points"])
            figures.append({"kind": "lines", "title": words + where, "panels": panels, "failed": failed})
    maps = charts.heat(rows, quantity=quantity)
    if maps:
        figures.append({"kind": "heat", "title": "over friction and payload", "panels": maps, "failed": False})
    return figures


def _row(row: Row) -> dict[str, Any]:
    """A line of the table of environments."""
    flags = [f"{row[k]} {word}" for k, word in _FLAGS.items() if row.get(k)]
    return {"falls": None, "metrics": {}, **row, "flat": row["terrain"] == FLAT, "flags": flags}


_FLAGS = {"diverged": "diverged", "overflowed": "overflowed", "restarted": "restarted"}


def _grouped(value: int) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min {rest:02d} s" if hours else f"{minutes} min {rest:02d} s"
