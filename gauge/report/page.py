"""``report.html``: one self-contained page with what ``results.json`` holds. It loads nothing from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path, PurePath
from typing import Any

from ...policy.contract import PHYSICS
from ..coverage import notes, score_label, suite_label
from ..episodes import QUALITY
from ..metrics import metric_label
from ..result import EnvironmentRow, Health, MetricScore, Result, TerrainScore
from ..result_figures import check_figures
from ..scoring import STATISTICS
from ..store import StoreError
from . import charts
from .breakdown import breakdown, own_parts
from .charts import number, terrain_label
from .pages import page_of, page_template
from .references import comparable, references_for

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
_DIVERGED = "The simulation became invalid there; each counts as a fall. The engine or its settings may be at fault."
_DROPPED = "The engine had no room for all contacts or constraints there, so these values are not exact."
_FELL = "The robot tilted beyond the suite's limit; the suite says what that ends and what it costs."
FELL_AT_LIMIT = "Quality is measured at the highest level that the policy passes, where it is at its limit; the score counts every fall."
_MANY_FALLS = 0.5
"""Share of environments with falls above which falls at the policy's own limit are grave, too."""
_TOUCHED = "Legs that strike each other can break on a robot; episodes.csv says at which commands."
_LITTLE_CONTACT = 0.01
"""Share of the samples below which contact of the robot with itself takes one line."""
_FAILED = "They score zero and no quality is measured there."
_SANK = "A foot sank into the terrain, and the goal was started again once, as the suite says."


def write_report(folder: Path) -> Path:
    """Write ``report.html`` beside the results that it shows, all or nothing.

    Raises:
        StoreError: the folder holds no results, or damaged ones, or some of another version.
    """
    file, clip = folder / "results.json", _clip(folder)

    def page(data: Mapping[str, Any]) -> str:
        source = f"{file} was edited or is damaged"
        result = Result.from_data(data, source, StoreError)
        check_figures(result, source, StoreError)
        return render(result, clip)

    return page_of(file, "report.html", page, command="evaluate")


_short_metric = partial(metric_label, short=True)


def _clip(folder: Path) -> bytes | None:
    """Return the film that lies in a folder of results, None where there is none that fits into a page."""
    path = folder / CLIP
    return path.read_bytes() if path.is_file() and path.stat().st_size <= _LARGEST_CLIP else None


def render(result: Result, clip: bytes | None = None) -> str:
    """Return a result's page as HTML, all texts as text and never markup; ``clip``: a WebP film of the robot."""
    template = page_template(
        __file__,
        "report.html.j2",
        number=number,
        terrain=terrain_label,
        metric=metric_label,
        short_metric=_short_metric,
        grouped=_grouped,
    )
    return template.render(**report_data(result), clip=None if clip is None else base64.b64encode(clip).decode())


def report_data(result: Result) -> dict[str, Any]:
    """Return everything that ``templates/report.html.j2`` shows, in the order and the coordinates in which it is shown."""
    rows, terrains, evaluated = result.environments, result.terrains, result.score is not None
    searched = any(r.search is not None for r in rows)
    both = (("friction", "over friction"), ("payload", "over payload"))
    expected = result.chance.level != "bisection"
    counts = [_plural(len(terrains), "terrain"), _plural(len(rows), "environment")]
    counts += [_plural(result.health.episodes, "quality episode")] if result.health.episodes else []
    references = references_for(result)
    groups = {name: (value, result.groups_interval.get(name)) for name, value in result.groups.items()}
    return {
        "result": result,
        "title": PurePath(result.policy.path.replace("\\", "/")).name,
        "subtitle": [
            suite_label(result),
            f"{result.pipeline} pipeline",
            f"robot {result.robot}",
            f"engine {_engine(result)}",
            result.provenance.date[:10],
        ],
        "evaluated": evaluated,
        "searched": searched,
        "score_label": score_label(result),
        "score_strip": None
        if result.score is None
        else charts.strip({"mean50": result.score}, result.score_interval, [r.score for r in references]),
        "groups": {
            name: {"value": value, "interval": interval, "strip": charts.strip({"mean50": value}, interval)}
            for name, (value, interval) in groups.items()
        },
        "level_label": f"mean {'expected' if expected else 'maximum'} level" if searched else "mean level played",
        "expected_level": expected,
        "counts": " · ".join(counts),
        "warnings": warnings(rows, result.health, notes(result)),
        "statistics": STATISTIC_LABELS,
        "terrain_strips": {name: _strip(row) for name, row in terrains.items()} if evaluated else {},
        "terrain_counts": {name: sum(r.terrain == name for r in rows) for name in terrains},
        "radar": charts.radar(terrains, STATISTIC_LABELS) if evaluated else None,
        "level_figures": _figures(rows, "level", both) if searched else [],
        "score_figures": _figures(rows, "score", both) if evaluated else [],
        "metric_strips": {name: _strip(row) for name, row in result.metrics.items()},
        "metric_matrix": metric_matrix(rows),
        "breakdown": breakdown(rows, own_parts(result)),
        "references": [
            {"of": r, "strip": charts.strip({"mean50": r.score}, r.interval, [result.score])}
            for r in references
            if result.score is not None
        ],
        "comparable": comparable(result) if evaluated else None,
        "searches": charts.searches(rows),
        "rows": [(row, [f"{count} {flag}" for flag in _FLAGS if (count := getattr(row, flag))]) for row in rows],
        "events": any(getattr(r, flag) for r in rows for flag in _FLAGS),
        "terrain_order": {name: i for i, name in enumerate(terrains)},
        "several_payloads": len({r.payload for r in rows}) > 1,
        "sources": sources(result),
    }


def _strip(row: TerrainScore | MetricScore) -> dict[str, Any]:
    return charts.strip({statistic: getattr(row, statistic) for statistic in STATISTICS}, row.interval)


def warnings(rows: Sequence[EnvironmentRow], health: Health, remarks: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return what went wrong in a run, gravest first.

    Args:
        remarks: sentences for the reader of the score.

    Returns:
        For each kind ``severity`` (``grave``, ``note`` or ``slight``), ``headline``, ``meaning`` and ``places``, the worst first.
    """
    total = _plural(health.episodes, "quality episode")
    failed, restarted = [r for r in rows if r.level == 0], sum(r.restarted or 0 for r in rows)
    searched = _plural(sum(r.search is not None for r in rows), "searched environment")
    share = health.self_contact or 0.0
    touching = f"parts of the robot touch each other in {_percent(share)} of the samples"
    touch = "slight" if share < _LITTLE_CONTACT else "note"
    at_limit = falls_at_limit(rows)
    fall, fell = ("note", FELL_AT_LIMIT) if at_limit else ("grave", _FELL)
    kinds = [
        (health.diverged, "grave", f"physics diverged in {health.diverged} of {total}", _DIVERGED, "diverged"),
        (health.overflowed, "grave", f"contacts dropped in {health.overflowed} of {total}", _DROPPED, "overflowed"),
        (health.falls, fall, f"{_plural(health.falls, 'fall')} in {total}", fell, "falls"),
        (share, touch, touching, _TOUCHED, "self_contact"),
        (failed, "note", f"not even level 1 passed in {len(failed)} of {searched}", _FAILED, None),
        *((text, "note", "for the reader of the score", f"{text[0].upper()}{text[1:]}.", "") for text in remarks),
        (restarted, "note", f"restarts in {restarted} of {total}", _SANK, "restarted"),
    ]
    found = [
        {
            "severity": severity,
            "headline": headline,
            "meaning": meaning,
            "places": [] if key == "" else _places(failed if key is None else rows, key),
        }
        for happened, severity, headline, meaning, key in kinds
        if happened
    ]
    return sorted(found, key=lambda w: ("grave", "note", "slight").index(w["severity"]))


def falls_at_limit(rows: Sequence[EnvironmentRow]) -> bool:
    """Return whether all falls happened at levels that were searched for, and not in more than half of the environments."""
    fell = [r for r in rows if r.falls]
    return 0 < len(fell) <= _MANY_FALLS * len(rows) and all(r.search is not None for r in fell)


def _places(rows: Sequence[EnvironmentRow], key: str | None) -> list[str]:
    """Return names of environments, those with the most of ``key`` first and how much that is, cut to a readable number."""
    chosen = list(rows)
    if key is not None:
        chosen = sorted((r for r in rows if getattr(r, key)), key=attrgetter(key), reverse=True)
    payloads, said = len({r.payload for r in rows}) > 1, _percent if key == "self_contact" else str
    names = []
    for row in chosen[:_SHOWN]:
        name = f"{terrain_label(row.terrain)}, μ {number(row.friction)}"
        name += f", {number(row.payload)} kg" if payloads else ""
        names.append(name + (f" ({said(getattr(row, key))})" if key else ""))
    return names + ([f"and {len(chosen) - _SHOWN} more"] if len(chosen) > _SHOWN else [])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def metric_matrix(rows: Sequence[EnvironmentRow]) -> dict[str, dict[str, float]]:
    """Return mean@50 of each metric on each terrain: the mean over its played environments at the levels reached, not weighted."""
    matrix: dict[str, dict[str, float]] = {}
    for terrain in dict.fromkeys(r.terrain for r in rows if r.quality):
        tables = [{**r.metrics, QUALITY: r.quality} for r in rows if r.terrain == terrain and r.quality]
        matrix[terrain] = {m: sum(t[m].mean50 for t in tables) / len(tables) for m in tables[0]}
    return matrix


def sources(result: Result) -> dict[str, str]:
    """Return where a result comes from, as labelled texts."""
    policy, provenance = result.policy, result.provenance
    entries = {
        "policy": policy.path,
        "policy file, SHA-256": policy.file_sha256,
        "policy contract, SHA-256": policy.contract_hash,
        "suite": f"{result.suite}: {result.suite.title}",
        "of the suite": result.coverage.text,
        "pipeline": result.pipeline,
        "robot": result.robot,
        "engine": _engine(result),
        "solver": _in_words(result.solver) or "–",
        "feet": _feet(result),
        "trained in": _in_words([each.to_data() for each in result.training.trained]) or result.training.note or "–",
        "tuned with": _in_words([each.to_data() for each in result.training.tuned]) or "–",
        "command limits of the policy": _in_words(result.commands.limits),
        "commands beyond them": _in_words(
            {axis: f"{100 * share:.3g} %" for axis, share in result.commands.beyond.items()}
        )
        or "not counted",
        "assumed of the policy": _in_words(result.policy.assumptions) or "–",
        "machine": f"{provenance.host}: {provenance.machine}",
        "date": provenance.date,
        "time": f"{_duration(provenance.seconds)} on {provenance.device}, CPU threads: {provenance.threads}",
        "physics steps": _grouped(provenance.physics_steps),
    }
    if provenance.physics_steps and provenance.seconds >= 1.0:  # not wholly resumed
        entries["physics steps"] += f" ({_grouped(round(provenance.physics_steps / provenance.seconds))} a second)"
    for key, value in policy.provenance.items():
        if key == PHYSICS:  # it has rows of its own
            continue
        text = _in_words(value)
        entries[f"policy: {key}"] = text if len(text) <= _LONGEST else text[:_LONGEST] + "…"
    return entries


def _in_words(value: Any) -> str:
    """Return a provenance entry, which may be a table or a list, for readers."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_in_words(entry)}" for name, entry in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(_in_words, value))
    return "–" if value is None else str(value)


def _feet(result: Result) -> str:
    """Return the contact of the feet in words."""
    words = {
        1: "no friction",
        3: "sliding friction",
        4: "sliding and torsional friction",
        6: "sliding, torsional and rolling friction",
    }
    if not result.feet.dimension:
        return "–"
    found = " or ".join(words[dimension] for dimension in result.feet.dimension)
    return f"{found}, torsion {1000 * result.feet.torsion:g} mm" if result.feet.torsion else found


def _engine(result: Result) -> str:
    return f"{result.backend} {result.engine_version}" if result.engine_version else result.backend


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _figures(rows: Sequence[EnvironmentRow], quantity: str, axes: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
    """Return charts of a quantity over friction and over payload, or over both where they are crossed."""
    figures: list[dict[str, Any]] = []
    for axis, words in axes:
        panels = charts.sweep(rows, axis=axis, quantity=quantity)
        if panels:
            fixed = {p["fixed"] for p in panels}
            where = ""
            if axis == "payload" and len(fixed) == 1:
                where = f" at friction {number(fixed.pop())}"
            elif len({r.payload for r in rows}) > 1 and len(fixed) == 1:
                where = f" at payload {number(fixed.pop())} kg"
            failed = any(p["failed"] for panel in panels for p in panel["points"])
            figures.append({"kind": "lines", "title": words + where, "panels": panels, "failed": failed})
    maps = charts.heat(rows, quantity=quantity)
    if maps:
        figures.append({"kind": "heat", "title": "over friction and payload", "panels": maps, "failed": False})
    return figures


_FLAGS = ("diverged", "overflowed", "restarted")


def _grouped(value: int) -> str:
    """Return a whole number with thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min {rest:02d} s" if hours else f"{minutes} min {rest:02d} s"
