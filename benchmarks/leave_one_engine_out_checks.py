"""Attacks the result of ``leave_one_engine_out.py``, and draws it. None of this was part of the plan.

python benchmarks/leave_one_engine_out_checks.py noise JURIES docs/data/leave-one-engine-out.json    # adds the scores' standard errors
python benchmarks/leave_one_engine_out_checks.py attack docs/data/leave-one-engine-out.json
python benchmarks/leave_one_engine_out_checks.py draw docs/data/leave-one-engine-out.json docs/media/leave-one-engine-out.png
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import leave_one_engine_out as study
import numpy as np

HIDDEN = [f for f in study.FAMILIES if f != "mujoco"]
_NOT_OURS = ("published", "katari16", "kms1115", "rl_")
_DRAWS = 2000


def standard_errors(juries: Path) -> dict[str, dict[str, float]]:
    """Return the standard error of each score, from its 95 % interval, by policy and engine."""
    found = {}
    for path in sorted(juries.glob("*/jury.json")):
        (block,) = json.loads(path.read_text())["policies"]
        name = path.parent.name.removesuffix(".pt").removesuffix(".onnx").removesuffix(".gauge")
        widths = {e: np.subtract(*reversed(v["score"]["interval"])) for e, v in block["engines"].items()}
        found[name] = {e: float(w) / (2 * 1.96) for e, w in widths.items()}
    return found


def gain(scores: dict[str, np.ndarray]) -> tuple[float, float]:
    """Return tau of the jury's score and of MuJoCo's alone, averaged over the hidden families other than MuJoCo; scores by engine, (P,)."""
    whole = np.ones((1, len(scores["mujoco"])))
    taus = []
    for hidden in HIDDEN:
        real = scores[study.FAMILIES[hidden][0]]
        jury = np.mean([scores[e[0]] for f, e in study.FAMILIES.items() if f != hidden], axis=0)
        taus.append([study.tau(p, real, whole)[0] for p in (jury, scores["mujoco"])])
    ours, alone = np.mean(taus, axis=0)
    return float(ours), float(alone)


def subsets(data: dict[str, Any], names: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield subsets of the policies, with a title each."""
    yield "all", names
    yield "other people's", [n for n in names if n.startswith(_NOT_OURS)]
    yield "ours", [n for n in names if not n.startswith(_NOT_OURS)]
    first = {study.training_of(n): n for n in sorted(names, reverse=True)}
    yield "one of each training", sorted(first.values())
    best = max(data["policies"][n]["mujoco"]["score"] for n in names)
    for share in (0.25, 0.5, 0.75, 0.9):
        chosen = [n for n in names if data["policies"][n]["mujoco"]["score"] >= share * best]
        yield f"at least {share:g} of the best in MuJoCo", chosen
    for training in sorted({study.training_of(n) for n in names}):
        yield f"without {training}", [n for n in names if study.training_of(n) != training]


def attack(data: dict[str, Any]) -> None:
    """Print how the main figure depends on choices that the plan made, and on noise."""
    engines = [e[0] for e in study.FAMILIES.values()]
    names = [n for n, found in data["policies"].items() if all(e in found for e in engines)]
    every = {e: np.array([data["policies"][n][e]["score"] for n in names]) for e in [*engines, study.TRAINING]}
    print("| policies | count | tau of the jury | of MuJoCo alone | difference |\n| --- | --- | --- | --- | --- |")
    for title, chosen in subsets(data, names):
        if len(chosen) < 4:
            continue
        index = [names.index(n) for n in chosen]
        ours, alone = gain({e: v[index] for e, v in every.items()})
        print(f"| {title} | {len(chosen)} | {ours:.3f} | {alone:.3f} | {ours - alone:+.3f} |")
    free = {**every, "mujoco": every[study.TRAINING]}
    ours, alone = gain(free)
    print(
        f"\nwith free feet as MuJoCo's member of the jury and as the single judge: {ours:.3f}, {alone:.3f}, {ours - alone:+.3f}"
    )
    print("\n| engines | tau of their scores | pairs closer than 0.01 in either |\n| --- | --- | --- |")
    for one, other in itertools.combinations([*engines, study.TRAINING], 2):
        a, b = every[one], every[other]
        upper = np.triu_indices(len(names), 1)
        close = [(np.abs(v[:, None] - v[None]) < 0.01)[upper] for v in (a, b)]
        value = study.tau(a, b, np.ones((1, len(names))))[0]
        print(f"| {one}, {other} | {value:.3f} | {np.mean(close[0] | close[1]):.0%} |")
    if "standard_errors" in data:
        generator = np.random.default_rng(1)
        sigma = {e: np.array([data["standard_errors"][n][e] for n in names]) for e in engines}
        noisy = [gain({e: every[e] + generator.normal(0.0, sigma[e]) for e in engines}) for _ in range(_DRAWS)]
        for title, values in zip(("jury", "MuJoCo alone"), np.transpose(noisy), strict=True):
            low, high = np.quantile(values, (0.025, 0.975))
            print(
                f"\nscores with their own noise once more, {title}: tau {np.mean(values):.3f} [{low:.3f}, {high:.3f}]"
            )


def draw(data: dict[str, Any], path: Path) -> None:
    """Draw tau and violation of the hidden score, survival and tracking by hidden family and predictor, as a small PNG."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    table = study.analyse(data)["table"]
    first = ["jury: score", "jury: the target itself", *(f"{f}: score" for f in study.FAMILIES)]
    names = list(dict.fromkeys([*first, *(row["predictor"] for row in table)]))
    colours = {"score": "#1f5fa8", "survival": "#c05621", "tracking": "#4a7c2f"}
    figure, axes = plt.subplots(2, 4, figsize=(11, 7.2), sharey=True, sharex="row", layout="constrained")
    for column, hidden in enumerate(study.FAMILIES):
        for row, (key, title) in enumerate((("tau", "Kendall's tau"), ("violation", "mean maximum rank violation"))):
            axis = axes[row, column]
            for shift, (target, colour) in zip((-0.22, 0.0, 0.22), colours.items(), strict=True):
                found = [r for r in table if r["hidden"] == hidden and r["target"] == target]
                height = [names.index(r["predictor"]) + shift for r in found]
                low, high = np.transpose([r[f"{key}_interval"] for r in found])
                axis.hlines(height, low, high, color=colour, linewidth=1.2)
                axis.plot([r[key] for r in found], height, "o", color=colour, markersize=3.5, label=target)
            axis.grid(axis="x", color="#dddddd", linewidth=0.6)
            axis.set_title(f"{hidden} hidden" if row == 0 else "", fontsize=10)
            axis.set_xlabel(title, fontsize=9)
            axis.set_yticks(range(len(names)), names, fontsize=8)
    axes[0, 0].invert_yaxis()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, title="target", fontsize=8, title_fontsize=8, loc="outside upper left", ncols=3)
    figure.savefig(path, dpi=90)
    with Image.open(path) as image:
        image.convert("RGB").quantize(32).save(path, optimize=True)


def main() -> None:
    """Carry out one of the three steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("noise", "attack", "draw"))
    parser.add_argument("files", type=Path, nargs="+", help="JURIES DATA, DATA, or DATA IMAGE")
    asked = parser.parse_args()
    if asked.step == "noise":
        juries, path = asked.files
        data = json.loads(path.read_text()) | {"standard_errors": standard_errors(juries)}
        path.write_text(json.dumps(data, indent=1) + "\n")
    elif asked.step == "attack":
        attack(json.loads(asked.files[0].read_text()))
    else:
        draw(json.loads(asked.files[0].read_text()), asked.files[1])


if __name__ == "__main__":
    main()
