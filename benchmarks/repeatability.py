"""How much of a score is chance: whole evaluations of one policy by the rules of a suite, with fresh seeds each time.

    python benchmarks/repeatability.py --evaluations 8 --threads 13 --folder /tmp/repeated --out docs/data/repeatability.json

Prints the score's standard deviation over the evaluations, its bound (0.005), the intervals' half widths and how many of them
hold the mean, and what an evaluation costs in control steps, that of its counted episodes. ``--before`` plays one more, with the
levels found by bisection over five seeds and without pushes, as the suite was before: the cost may be twice that. ``--terrain``,
``--friction`` and ``--payload`` take a part of the suite, for a first try; ``--threads`` are the processes of one evaluation.
Evaluation k has the quality seeds 10000 + 100 k … and the search seeds 10050 + 100 k …; what the folder holds is not played again.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gaitgauge.files.writing import json_text, write_atomically
from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import Suite, load_suite

BOUND = 0.005
"""Largest standard deviation of a whole evaluation's score that the suite allows itself."""
MOST_COST = 2.0
"""Largest cost, as a multiple of an evaluation by the rules before."""
SUITE = """
extends = "{extends}"
name = "{name}"

[matrix]
seeds = {seeds}
search_seeds = {search_seeds}
{rest}"""
BEFORE = """
[scoring]
level = "bisection"
"""


def suite_text(suite: Suite, index: int, *, before: bool = False) -> str:
    """The suite with seeds of its own; index 0 keeps the suite's, ``before`` takes the rules before."""
    matrix = suite.matrix
    seeds, search_seeds = list(matrix.seeds), list(matrix.search_seeds)
    if index:
        seeds = [10_000 + 100 * index + n for n in range(len(seeds))]
        search_seeds = [10_050 + 100 * index + n for n in range(len(search_seeds))]
    name = "before" if before else f"repeated-{index}"
    if before:
        search_seeds = search_seeds[:5]
    text = SUITE.format(
        extends=suite.name,
        name=name,
        seeds=seeds,
        search_seeds=search_seeds,
        rest=BEFORE if before else "",
    )
    return text.replace("\n\n[matrix]", "\npush = false\n\n[matrix]") if before else text


def control_steps(folder: Path) -> int:
    """Control steps of an evaluation's counted episodes."""
    with (folder / "episodes.csv").open(encoding="utf-8") as file:
        return sum(int(row["control_steps"]) for row in csv.DictReader(file) if row["command"] == "all")


def play(text: str, name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """One evaluation, and what is kept of it."""
    arguments.folder.mkdir(parents=True, exist_ok=True)
    file, folder = arguments.folder / f"{name}.toml", arguments.folder / name
    file.write_text(text)
    request = Request(
        policy=arguments.policy,
        suite=str(file),
        threads=arguments.threads,
        terrains=tuple(arguments.terrain),
        frictions=tuple(arguments.friction),
        payloads=tuple(arguments.payload),
    )
    found = evaluate(request, folder, resume=True)
    return {
        "seeds": found["chance"]["seeds"],
        "search_seeds": found["chance"]["search_seeds"],
        "score": found["score"],
        "interval": found["score_interval"],
        "level": found["level"],
        "terrains": {t: {k: row[k] for k in ("score", "level", "interval")} for t, row in found["terrains"].items()},
        "environments": len(found["environments"]),
        "control_steps": control_steps(folder),
        "policy": found["policy"]["file_sha256"],
        "coverage": found["coverage"]["text"],
    }


def judge(evaluations: Sequence[dict[str, Any]], before: dict[str, Any] | None) -> dict[str, Any]:
    """Scatter, intervals and cost of some evaluations."""
    scores = np.array([e["score"] for e in evaluations])
    intervals = [e["interval"] for e in evaluations if e["interval"] is not None]
    steps = float(np.mean([e["control_steps"] for e in evaluations]))
    terrains = {
        name: float(np.std([e["terrains"][name]["score"] for e in evaluations], ddof=1))
        for name in evaluations[0]["terrains"]
    }
    return {
        "mean": float(scores.mean()),
        "sigma": float(scores.std(ddof=1)),
        "bound": BOUND,
        "sigma_of_terrains": terrains,
        "half_width": float(np.median([(high - low) / 2 for low, high in intervals])),
        "covered": float(np.mean([low <= scores.mean() <= high for low, high in intervals])),
        "control_steps": steps,
        "cost": None if before is None else steps / before["control_steps"],
    }


def report(found: dict[str, Any]) -> None:
    """Print the figures."""
    kept = "below" if found["sigma"] < BOUND else "NOT below"
    print(f"score {found['mean']:.4f}, σ {found['sigma']:.4f}, {kept} the {BOUND} of a whole evaluation")
    print("σ of terrains: " + ", ".join(f"{name} {value:.4f}" for name, value in found["sigma_of_terrains"].items()))
    print(f"intervals: median half width {found['half_width']:.4f}, {found['covered']:.0%} hold the mean")
    cost = "" if found["cost"] is None else f", {found['cost']:.2f} times as many as before (at most {MOST_COST:g})"
    print(f"control steps of an evaluation: {found['control_steps']:,.0f}{cost}")


def main() -> None:
    """Play, judge, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="pretrained")
    parser.add_argument("--suite", default="gaitgauge-1", help="name of a suite that ships")
    parser.add_argument("--evaluations", type=int, default=8)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--terrain", action="append", default=[])
    parser.add_argument("--friction", action="append", type=float, default=[])
    parser.add_argument("--payload", action="append", type=float, default=[])
    parser.add_argument("--before", action="store_true", help="the cost of the rules before, too")
    parser.add_argument("--folder", type=Path, required=True, help="what is played stays here")
    parser.add_argument("--out", type=Path, help="JSON file of the figures")
    arguments = parser.parse_args()
    if arguments.evaluations < 2:
        parser.error(f"--evaluations is {arguments.evaluations}; at least 2 show a scatter")
    suite = load_suite(arguments.suite)
    evaluations = []
    for index in range(1, arguments.evaluations + 1):
        found = play(suite_text(suite, index), f"repeated-{index}", arguments)
        print(f"{index}: {found['score']:.4f} level {found['level']} steps {found['control_steps']:,}", flush=True)
        evaluations.append(found)
    before = play(suite_text(suite, 0, before=True), "before", arguments) if arguments.before else None
    figures = judge(evaluations, before)
    report(figures)
    if arguments.out:
        whole = {
            "suite": {"name": suite.name, "version": suite.version, "digest": suite.digest},
            "policy": evaluations[0]["policy"],
            "coverage": evaluations[0]["coverage"],
            **figures,
            "evaluations": evaluations,
            "before": before,
        }
        write_atomically(arguments.out, json_text(json.loads(json.dumps(whole))), StoreError)


if __name__ == "__main__":
    main()
