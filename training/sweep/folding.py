"""Fold a sweep: its runs as rows, its entries compared, its curves, and a page of all."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...files.writing import json_text, write_atomically
from ...gauge.chance.intervals import Chance
from ...gauge.report import charts
from ...gauge.report.pages import page_template
from ...gauge.result import Result, read_result
from ...studies.compare.comparison import ComparisonError, compare, load_result
from ...studies.compare.report import write_comparison
from .across import across_seeds, chance_of_seeds
from .across import sentence as across_sentence
from .curves import Curve, by_figure, curves_csv, learning_curves
from .file import Sweep, SweepError
from .runs import RUN_ERRORS, SCORES, SweepRun, read_card, what_failed

_FOUND = (*("environment_steps", "training_seconds", "best_training_score", "policy", "results"), *SCORES)
"""Fields of a run's row, None where there is nothing yet."""


def fold_sweep(
    sweep: Sweep, runs: Sequence[SweepRun], refused: Mapping[str, str], failures: Mapping[str, str], folder: Path
) -> dict[str, Any]:
    """Write ``sweep.json``, ``sweep.html``, ``curves.csv``, and the comparison of the entries where two or more have a score.

    Args:
        refused: why entries could not start, by name.
        failures: why runs failed, by label.

    Returns:
        The content of ``sweep.json``: ``runs``, ``entries``, their differences ``across_seeds``, ``sentences``, and whether the
        entries were ``compared``. A run whose files are damaged has the state ``failed``.

    Raises:
        SweepError: a file cannot be written.
    """
    rows: list[dict[str, Any]] = []
    curves: dict[tuple[str, int], dict[str, Curve]] = {}
    for run in runs:
        row = {"entry": run.entry.name, "seed": run.seed, "task": run.entry.task, "settings": list(run.settings)}
        row |= {"state": "unfinished", "reason": failures.get(run.label, ""), **dict.fromkeys(_FOUND)}
        try:
            _fill(row, sweep, run, folder)
            curves[run.entry.name, run.seed] = learning_curves(run.directory) if run.directory else {}
        except RUN_ERRORS as error:
            row["reason"] = row["reason"] or what_failed(error)
        rows.append(row | ({"state": "failed"} if row["reason"] else {}))
    best = {row["entry"]: row for row in sorted(rows, key=lambda r: r["score"] or 0.0) if row["score"] is not None}
    sentences, compared = [], False
    if len(best) > 1:
        order = [e.name for e in sweep.entry if e.name in best]
        try:
            found = compare([load_result(folder / best[name]["results"]) for name in order], order)
            write_comparison(folder, found)
            sentences, compared = found.sentences, True
        except ComparisonError as error:
            sentences = [f"No comparison: {error}."]
    scores = {
        e.name: [r["score"] for r in rows if r["entry"] == e.name and r["score"] is not None] for e in sweep.entry
    }
    pairs = across_seeds(scores, _gauge_seeds(rows, folder) if compared else None)
    sentences += [across_sentence(pairs)] if pairs else []
    if alike := [name for name, own in scores.items() if len(own) > 1 and len(set(own)) == 1]:
        sentences.append(f"All seeds of {_listed(alike)} have the same score, which says nothing of their spread.")
    if other := [r.label for r, row in zip(runs, rows, strict=True) if row["state"] == "trained" and r.has_results]:
        sentences.append(f"Results of {_listed(other)} are of another suite or checkpoint and do not count.")
    seeds = {e.name: sweep.seeds_of(e) for e in sweep.entry}
    data: dict[str, Any] = {
        "schema": 1,
        "name": sweep.name,
        "title": sweep.title,
        "suite": sweep.suite,
        "runs": rows,
        "entries": [
            _entry(e.name, [r for r in rows if r["entry"] == e.name], refused.get(e.name)) for e in sweep.entry
        ],
        "across_seeds": pairs,
        "compared": compared,
        "sentences": sentences,
    }
    write_atomically(folder / "sweep.json", json_text(data), SweepError)
    write_atomically(folder / "curves.csv", curves_csv(curves), SweepError)
    write_atomically(folder / "sweep.html", _page(data, by_figure(curves, seeds)), SweepError)
    return data


def _fill(row: dict[str, Any], sweep: Sweep, run: SweepRun, folder: Path) -> None:
    """Put into a row how far a run is, and in numbers what became of it, as long as its files can be read."""
    noted = run.description()
    row |= {"environment_steps": noted.get("environment_steps"), "training_seconds": noted.get("training_seconds")}
    row["best_training_score"] = noted.get("best_score")
    row["state"] = "trained" if run.trained else "unfinished"
    policy, results = run.policy(sweep), run.results(sweep)
    row["policy"] = str(policy.relative_to(folder)) if policy else None
    if results is not None and run.gauged(sweep):
        card = read_card(results)
        row |= {name: getattr(card, name) for name in SCORES}
        row |= {"state": "gauged", "results": str(results.relative_to(folder))}


def _gauge_seeds(rows: Sequence[Mapping[str, Any]], folder: Path) -> dict[str, Chance]:
    """Return what the gauge's seeds add to each entry's mean score."""
    cards: dict[str, list[Result]] = {}
    for row in rows:
        if row["results"] is not None:
            cards.setdefault(row["entry"], []).append(read_result(folder / row["results"], SweepError))
    return {name: chance_of_seeds(own, name=name) for name, own in cards.items()}


def _entry(name: str, rows: Sequence[Mapping[str, Any]], refused: str | None) -> dict[str, Any]:
    """An entry's runs together: its best run by the score, and the scores' mean, spread and range over the seeds."""
    scored = sorted((r for r in rows if r["score"] is not None), key=lambda r: r["score"])
    scores = [r["score"] for r in scored]
    best = scored[-1] if scored else None
    return {
        "entry": name,
        "reason": refused or "; ".join(r["reason"] for r in rows if r["reason"]),
        "runs": len(rows),
        "scored": len(scored),
        "mean": statistics.fmean(scores) if scores else None,
        "deviation": statistics.stdev(scores) if len(scores) > 1 else None,
        "range": [scores[0], scores[-1]] if len(scores) > 1 else None,
        "best": best and {k: best[k] for k in ("seed", "score", "score_interval", "level", "groups", "results")},
    }


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)


def _page(data: Mapping[str, Any], figures: Mapping[str, Mapping[str, Sequence[Curve]]]) -> str:
    """The page, as HTML text. Whatever names contain is shown as text and never becomes markup."""
    names = [entry["entry"] for entry in data["entries"]]
    groups = list(dict.fromkeys(g for e in data["entries"] if e["best"] for g in e["best"]["groups"] or {}))
    return page_template(__file__, "sweep.html.j2").render(
        sweep=data,
        groups=groups,
        names=names,
        figures={figure: charts.curves(series) for figure, series in figures.items()},
    )
