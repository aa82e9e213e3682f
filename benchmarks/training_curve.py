"""The curve of a training run in one or more stretches: a table and a picture from the TensorBoard files of its run directories.

    python benchmarks/training_curve.py RUN [RUN ...] --csv curve.csv --svg curve.svg [--before curve.csv]

Stretches are given in the order in which they were trained; environment steps and seconds are added up. ``--before`` puts the
rows of an earlier table in front, for stretches whose run directories are gone. Printed is how well reward and terrain level rank the
scored checkpoints as MuJoCo does: do training's own figures mislead?
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

COLUMNS = {
    "steps_per_second": "Perf/total_fps",
    "mean_reward": "Train/mean_reward",
    "mean_terrain_level": "Curriculum/mean_level",
    "latent_loss": "Loss/latent",
    "action_std": "Policy/mean_std",
    "quick_score": "Gauge/quick/score",
}
FIELDS = ("stretch", "iteration", "environment_steps_millions", "hours", *COLUMNS)
EVERY = 20
WINDOW = 12.0
"""Over how many million environment steps training's own figures are averaged before a score is compared with them."""


def read_stretch(run: Path, number: int, steps_before: float, hours_before: float) -> list[dict[str, str]]:
    """Rows of one run directory, every 20th iteration and every scored one."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    values = {
        name: {event.step: event.value for event in events.Scalars(tag)}
        for name, tag in COLUMNS.items()
        if tag in events.Tags()["scalars"]
    }
    totals = {event.step: event.value for event in events.Scalars("Perf/total_steps")}
    times = {event.step: event.wall_time for event in events.Scalars("Perf/total_steps")}
    first = min(totals)
    per_iteration = totals[first + 1] - totals[first]
    # scores are written at the iteration count that was scored, all else at the index of the iteration
    scored = values.get("quick_score", {})
    rows = []
    for index in sorted(totals):
        if (index - first) % EVERY and index + 1 not in scored:
            continue
        row = {"stretch": str(number), "iteration": str(index + 1)}
        row["environment_steps_millions"] = f"{steps_before + (index + 1 - first) * per_iteration / 1e6:.2f}"
        row["hours"] = f"{hours_before + (times[index] - times[first]) / 3600:.4f}"
        row |= dict.fromkeys(COLUMNS, "")
        for name, series in values.items():
            at = index + 1 if name == "quick_score" else index
            row[name] = f"{series[at]:.4g}" if at in series else ""
        rows.append(row)
    return rows


def main() -> None:
    """Write the table and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--before", type=Path, help="table of earlier stretches")
    parser.add_argument("--csv", type=Path, required=True)
    parser.add_argument("--svg", type=Path)
    arguments = parser.parse_args()
    rows: list[dict[str, str]] = []
    if arguments.before:
        with arguments.before.open(newline="") as file:
            rows = list(csv.DictReader(file))
    for run in arguments.runs:
        last = rows[-1] if rows else {"stretch": "0", "environment_steps_millions": "0", "hours": "0"}
        number, steps, hours = (
            int(last["stretch"]),
            float(last["environment_steps_millions"]),
            float(last["hours"]),
        )
        rows += read_stretch(run, number + 1, steps, hours)
    with arguments.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows(rows)
    if arguments.svg:
        draw(rows, arguments.svg)
    print_ranks(rows)


def print_ranks(rows: list[dict[str, str]]) -> None:
    """Rank correlation (Spearman) of the score in MuJoCo with training's own figures, over all stretches and within each."""
    from scipy.stats import spearmanr

    print(f"{'score in MuJoCo and':22} {'all':>12}" + "".join(f"{f'stretch {n}':>15}" for n in stretches(rows)))
    for name in ("mean_reward", "mean_terrain_level"):
        line = f"{name.replace('_', ' '):22}"
        for number in ("", *stretches(rows)):
            points = [
                (float(row["quick_score"]), recent(rows, row, name))
                for row in rows
                if row["quick_score"] and number in ("", row["stretch"])
            ]
            rank = f"{spearmanr(*zip(*points, strict=True)).statistic:+.2f}" if len(points) > 2 else "-"
            line += f"{rank + f' ({len(points)})':>{15 if number else 13}}"
        print(line)


def stretches(rows: list[dict[str, str]]) -> list[str]:
    """Numbers of the stretches, in order."""
    return sorted({row["stretch"] for row in rows}, key=int)


def recent(rows: list[dict[str, str]], at: dict[str, str], name: str) -> float:
    """Mean of a figure over the last ``WINDOW`` million environment steps before a row of its stretch."""
    end = float(at["environment_steps_millions"])
    values = [
        float(row[name])
        for row in rows
        if row["stretch"] == at["stretch"]
        and row[name]
        and 0.0 <= end - float(row["environment_steps_millions"]) < WINDOW
    ]
    return sum(values) / len(values)


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """Gauge score and terrain level over environment steps."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7.5, 4.0))
    levels = axes.twinx()
    for number in sorted({row["stretch"] for row in rows}, key=int):
        own = [row for row in rows if row["stretch"] == number]
        scored = [(float(r["environment_steps_millions"]), float(r["quick_score"])) for r in own if r["quick_score"]]
        level = [(float(r["environment_steps_millions"]), r["mean_terrain_level"]) for r in own]
        if scored:
            axes.plot(*zip(*scored, strict=True), "o-", label=f"stretch {number}")
        levels.plot(*zip(*[(x, float(y)) for x, y in level if y], strict=True), color="0.7", linewidth=1, zorder=0)
        axes.axvline(float(own[-1]["environment_steps_millions"]), color="0.9", linewidth=1)
    axes.set_xlabel("environment steps [million]")
    axes.set_ylabel("score in MuJoCo, suite quick")
    levels.set_ylabel("mean terrain level in training (grey)")
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
