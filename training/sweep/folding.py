"""What became of a sweep: its runs as rows, its entries compared, its curves, and a page of all."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from scipy.stats import ttest_ind

from ...files.writing import json_text, write_atomically
from ...gauge import charts
from ...gauge.comparison import ComparisonError, compare, format_p, holm, load_result
from ...gauge.comparison_report import write_comparison
from ...gauge.intervals import CONFIDENCE
from ...gauge.pages import page_template
from ..run_directory import read_run_json
from .curves import Curve, by_figure, curves_csv, learning_curves
from .file import Sweep, SweepError
from .runs import SweepRun


def fold_sweep(
    sweep: Sweep, runs: Sequence[SweepRun], refused: Mapping[str, str], failures: Mapping[str, str], folder: Path
) -> dict[str, Any]:
    """Write ``sweep.json``, ``sweep.html``, ``curves.csv``, and the comparison of the entries where two or more have a score.

    Args:
        refused: why entries could not start, by name.
        failures: why runs failed, by label.

    Returns:
        The content of ``sweep.json``: ``runs``, ``entries``, their differences ``across_seeds``, and ``sentences``.

    Raises:
        SweepError, ComparisonError, CheckpointError: a file is damaged or cannot be written.
    """
    rows = [_row(sweep, run, failures.get(run.label, ""), folder) for run in runs]
    best = {row["entry"]: row for row in sorted(rows, key=lambda r: r["score"] or 0.0) if row["score"] is not None}
    sentences = []
    if len(best) > 1:
        order = [e.name for e in sweep.entry if e.name in best]
        try:
            found = compare([load_result(folder / best[name]["results"]) for name in order], order)
            write_comparison(folder, found)
            sentences = found.sentences
        except ComparisonError as error:
            sentences = [f"No comparison: {error}."]
    scores = {
        e.name: [r["score"] for r in rows if r["entry"] == e.name and r["score"] is not None] for e in sweep.entry
    }
    pairs = across_seeds(scores)
    sentences += [_seeds_sentence(pairs)] if pairs else []
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
        "sentences": sentences,
    }
    curves = {(r.entry.name, r.seed): learning_curves(run) for r in runs if (run := r.directory) is not None}
    write_atomically(folder / "sweep.json", json_text(data), SweepError)
    write_atomically(folder / "curves.csv", curves_csv(curves), SweepError)
    write_atomically(folder / "sweep.html", _page(data, curves, compared=len(best) > 1), SweepError)
    return data


def _row(sweep: Sweep, run: SweepRun, failure: str, folder: Path) -> dict[str, Any]:
    """One run in numbers; None where there is none yet."""
    directory, results = run.directory, run.results(sweep)
    noted = read_run_json(directory) if directory else {}
    row: dict[str, Any] = {
        "entry": run.entry.name,
        "seed": run.seed,
        "task": run.entry.task,
        "settings": list(run.settings),
        "state": "failed" if failure else "gauged" if run.gauged(sweep) else "trained" if run.trained else "unfinished",
        "reason": failure,
        "environment_steps": noted.get("environment_steps"),
        "training_seconds": noted.get("training_seconds"),
        "best_training_score": noted.get("best_score"),
        "policy": str(policy.relative_to(folder)) if (policy := run.policy(sweep)) else None,
        "results": None,
    }
    row |= dict.fromkeys(("score", "score_interval", "level", "groups"))
    if results is not None and run.gauged(sweep):
        found = load_result(results)
        row |= {name: found[name] for name in ("score", "score_interval", "level", "groups")}
        row["results"] = str(results.relative_to(folder))
    return row


def _entry(name: str, rows: Sequence[Mapping[str, Any]], refused: str | None) -> dict[str, Any]:
    """An entry's runs together: its best run by the score, and the scores' mean and spread over the seeds."""
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
        "best": {k: best[k] for k in ("seed", "score", "score_interval", "level", "groups", "results")}
        if best
        else None,
    }


def across_seeds(scores: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """Differences of the entries' mean scores over their seeds of training, by Welch's t-test, corrected for many looks by Holm.

    Args:
        scores: of each entry's runs; an entry with fewer than two says nothing of its spread and is left out.

    Returns:
        ``first``, ``second``, ``difference`` of the second's mean minus the first's, ``p_value`` and ``corrected`` of each pair.
    """
    known = {name: own for name, own in scores.items() if len(own) > 1}
    pairs: list[dict[str, Any]] = []
    for (first, one), (second, two) in combinations(known.items(), 2):
        spread = statistics.variance(one) + statistics.variance(two)
        difference = statistics.fmean(two) - statistics.fmean(one)
        p_value = float(ttest_ind(one, two, equal_var=False).pvalue) if spread > 0.0 else float(difference == 0.0)
        pairs.append({"first": first, "second": second, "difference": round(difference, 6), "p_value": p_value})
    corrected = holm([pair["p_value"] for pair in pairs])
    return [pair | {"corrected": p} for pair, p in zip(pairs, corrected, strict=True)]


def _seeds_sentence(pairs: Sequence[Mapping[str, Any]]) -> str:
    """What the seeds of training allow to say about the entries themselves."""
    real = sorted((p for p in pairs if p["corrected"] < 1.0 - CONFIDENCE), key=lambda p: p["corrected"])
    found = f"Over the seeds of training, {len(real)} of {len(pairs)} differences are real (Welch's test, Holm's correction)"
    shown = ", ".join(
        f"'{p['second']}' and '{p['first']}' {p['difference']:+.4f} (p {format_p(p['corrected'])})" for p in real
    )
    return f"{found}: {shown}." if real else f"{found}: with so few runs the methods cannot be told apart."


def _page(data: Mapping[str, Any], curves: Mapping[tuple[str, int], Mapping[str, Curve]], *, compared: bool) -> str:
    """The page, as HTML text. Whatever names contain is shown as text and never becomes markup."""
    names = [entry["entry"] for entry in data["entries"]]
    groups = list(dict.fromkeys(g for e in data["entries"] if e["best"] for g in e["best"]["groups"] or {}))
    return page_template("sweep.html.j2").render(
        sweep=data,
        groups=groups,
        names=names,
        compared=compared,
        figures={figure: charts.curves(series) for figure, series in by_figure(curves, names).items()},
    )
