"""How much of a score is chance: whole evaluations of one policy by the rules of a suite, with fresh seeds each time.

    python benchmarks/repeatability.py --evaluations 8 --threads 13 --folder /tmp/repeated --out docs/data/repeatability.json

Prints the score's standard deviation σ over the evaluations, its bound (0.005), the intervals' half widths and how many of them
hold the mean, and what an evaluation costs in control steps, that of its counted episodes. ``--before`` plays one more, with the
levels found by bisection over five seeds and without pushes, as the suite was before: the cost may be twice that. ``--terrain``,
``--friction`` and ``--payload`` take a part of the suite, for a first try; ``--threads`` are the processes of one evaluation.
Evaluation k has the quality seeds 10000 + 100 k … and the search seeds 10050 + 100 k ….

Eight scores alone leave σ open by a factor of 3. Where a suite gives every episode noise of its own, the environments of an
evaluation are independent, σ² is the sum of their variances, and 91 environments know it seven times as well; both are printed,
with their 95 % intervals, and how probable it is that they differ by as much if environments are independent.

What has been played stays in the folder and is not played again: an evaluation's figures in ``repeated-k.json``, and the episodes
of one that was stopped. ``--only 3`` plays the third alone (``--only 0`` the one by the rules before), so that several processes
share the work; the same command without it then makes the figures, on this machine or on another that was given the folder.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gaitgauge.files.parsing import parse_json, read_text
from gaitgauge.files.writing import json_text, write_atomically
from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import Suite, load_suite
from gaitgauge.gauge.totals import environment_weights
from gaitgauge.studies.policies import file_digest
from scipy import stats

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


def play(suite: Suite, index: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """Evaluation ``index``, 0 by the rules before, and what is kept of it; from its file if it was played."""
    arguments.folder.mkdir(parents=True, exist_ok=True)
    name = f"repeated-{index}" if index else "before"
    file, folder, kept = (arguments.folder / f"{name}{end}" for end in (".toml", "", ".json"))
    text = suite_text(suite, index, before=not index)
    wanted = {
        "suite_text": text,
        "suite_digest": suite.digest,
        "policy": file_digest(arguments.policy),
        "part": [arguments.terrain, arguments.friction, arguments.payload],
    }
    if kept.exists():
        figures: dict[str, Any] = parse_json(read_text(kept, "figures", StoreError), str(kept), StoreError)
        if differing := [k for k, v in wanted.items() if figures.get(k) != v]:
            raise StoreError(f"{kept} is of another run ({', '.join(differing)} differ); give another --folder")
        return figures
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
    figures = {
        **wanted,
        "seeds": found.chance.seeds,
        "search_seeds": found.chance.search_seeds,
        "score": found.score,
        "interval": found.score_interval,
        "level": found.level,
        "terrains": {
            t: {"score": row.score, "level": row.level, "interval": row.interval} for t, row in found.terrains.items()
        },
        "environments": [
            {k: getattr(row, k) for k in ("terrain", "friction", "payload", "level", "score")}
            for row in found.environments
        ],
        "control_steps": control_steps(folder),
        "coverage": found.coverage.text,
        "provenance": {k: getattr(found.provenance, k) for k in ("versions", "processor", "date")},
    }
    write_atomically(kept, json_text(figures), StoreError)
    return figures


def spread(variance: float, freedom: float) -> dict[str, Any]:
    """A standard deviation, its degrees of freedom and its 95 % interval, by the χ² distribution of a variance."""
    low, high = (variance * freedom / stats.chi2.ppf(p, freedom) for p in (0.975, 0.025))
    return {"sigma": math.sqrt(variance), "freedom": freedom, "interval": [math.sqrt(low), math.sqrt(high)]}


def judge(evaluations: Sequence[dict[str, Any]], before: dict[str, Any] | None, *, independent: bool) -> dict[str, Any]:
    """Scatter, intervals and cost of some evaluations.

    Args:
        evaluations: two or more, of the same environments.
        before: the one by the rules before.
        independent: whether environments share no noise.
    """
    scores = np.array([e["score"] for e in evaluations])
    intervals = [e["interval"] for e in evaluations if e["interval"] is not None]
    steps = float(np.mean([e["control_steps"] for e in evaluations]))
    terrains = {
        name: float(np.std([e["terrains"][name]["score"] for e in evaluations], ddof=1))
        for name in evaluations[0]["terrains"]
    }
    whole = spread(float(scores.var(ddof=1)), len(scores) - 1)
    parts, probability = None, None
    if independent:
        weights = environment_weights([row["terrain"] for row in evaluations[0]["environments"]])
        by_environment = np.array([[row["score"] for row in e["environments"]] for e in evaluations])
        variances = weights**2 * by_environment.var(0, ddof=1)
        # Welch and Satterthwaite: the degrees of freedom of a sum of variances
        freedom = float(variances.sum() ** 2 / (variances**2).sum() * (len(scores) - 1))
        parts = spread(float(variances.sum()), freedom)
        ratio = stats.f(len(scores) - 1, freedom).cdf((whole["sigma"] / parts["sigma"]) ** 2)
        probability = float(2.0 * min(ratio, 1.0 - ratio))
    return {
        "mean": float(scores.mean()),
        **whole,
        "by_environments": parts,
        "independent": probability,
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
    print(f"score {found['mean']:.4f}, σ {_spread_text(found)}, {kept} the {BOUND} of a whole evaluation")
    if parts := found["by_environments"]:
        kept = "below" if parts["sigma"] < BOUND else "NOT below"
        print(
            f"from the environments' variances: σ {_spread_text(parts)}, {kept} it; p {found['independent']:.2f} of the two"
        )
    print("σ of terrains: " + ", ".join(f"{name} {value:.4f}" for name, value in found["sigma_of_terrains"].items()))
    print(f"intervals: median half width {found['half_width']:.4f}, {found['covered']:.0%} hold the mean")
    cost = "" if found["cost"] is None else f", {found['cost']:.2f} times as many as before (at most {MOST_COST:g})"
    print(f"control steps of an evaluation: {found['control_steps']:,.0f}{cost}")


def _spread_text(found: dict[str, Any]) -> str:
    low, high = found["interval"]
    return f"{found['sigma']:.4f} ({low:.4f} to {high:.4f}, {found['freedom']:.0f} degrees of freedom)"


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
    parser.add_argument(
        "--only", type=int, nargs="+", help="play these evaluations and make no figures; 0: by the rules before"
    )
    arguments = parser.parse_args()
    if arguments.evaluations < 2:
        parser.error(f"--evaluations is {arguments.evaluations}; at least 2 show a scatter")
    suite = load_suite(arguments.suite)
    evaluations = []
    numbers = range(1, arguments.evaluations + 1)
    for index in arguments.only or numbers:
        found = play(suite, index, arguments)
        print(f"{index}: {found['score']:.4f} level {found['level']} steps {found['control_steps']:,}", flush=True)
        evaluations.append(found)
    if arguments.only:
        return
    before = play(suite, 0, arguments) if arguments.before else None
    figures = judge(evaluations, before, independent=suite.noise.stream == "counter")
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
