"""Minutes from the command to a score: of trainings with kept checkpoints, startup and compilation included.

    gaitgauge train go2-moe-cts --iterations 1750 --no-score training.run.save_interval=150 training.run.keep_episodes=false
    python benchmarks/time_to_score.py logs/rsl_rl/go2_moe_cts/* --threads 16 --out times

Gauges every checkpoint of each RUN with a suite (results that lie in --out are not played again) and prints minutes and steps
at the first checkpoint that has each score, with the GPU and the number of processes. The wall time of a checkpoint is that of
its iteration in the log, from the start of the command in ``run.json``; a run must be whole, not resumed. A RUN is a run directory, or a
folder with ``run.json``, the log and policy files ``model_<n>.gauge.pt``. Results of other machines may be given with --cards:
a folder with ``model_<n>/results.json``, for one RUN.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path

from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.gauge.result import Result, read_result
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

SCORES = (0.60, 0.65, 0.70, 0.72)


class TimesError(ValueError):
    """What was asked for cannot be done; one sentence."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """A checkpoint."""

    iteration: int
    minutes: float
    """From the start of the command."""
    steps: float
    """Environment steps, millions."""
    score: float


@dataclass(frozen=True, kw_only=True)
class Times:
    """A training."""

    run: str
    task: str
    seed: int
    device: str
    processes: int
    points: list[Point] = field(default_factory=list)

    def first(self, score: float) -> Point | None:
        """Return the first checkpoint with at least a score."""
        return next((point for point in self.points if point.score >= score), None)


def wall_times(run: Path) -> dict[int, tuple[float, float]]:
    """Return minutes since the start of the command and million environment steps after each iteration.

    Raises:
        TimesError: the run has no log, was resumed, or does not say when its command began.
    """
    noted = json.loads((run / "run.json").read_text())
    if noted.get("resumed"):
        raise TimesError(f"'{run}' was resumed, so its wall time is not that of one command; give a run that was not")
    if "began" in noted:
        began = datetime.fromisoformat(noted["began"]).timestamp()
    elif found := re.match(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", run.name):
        began = datetime.strptime(found[0], "%Y-%m-%d_%H-%M-%S").astimezone().timestamp()
    else:
        raise TimesError(f"'{run}' does not say when it began, neither in run.json nor by its name")
    log = EventAccumulator(str(run), size_guidance={"scalars": 0})
    log.Reload()
    if "Perf/total_steps" not in log.Tags()["scalars"]:
        raise TimesError(f"'{run}' has no log of TensorBoard; give a run directory")
    return {e.step + 1: ((e.wall_time - began) / 60.0, e.value / 1e6) for e in log.Scalars("Perf/total_steps")}


def card_of(policy: Path, folder: Path, options: argparse.Namespace) -> Result:
    """Return the score card of a policy, from an earlier evaluation or a new one in ``folder``."""
    for known in (folder, options.cards and options.cards / folder.name):
        if known and (known / "results.json").is_file():
            return read_result(known / "results.json", TimesError)
    request = Request(policy=str(policy), suite=options.suite, threads=options.threads)
    return evaluate(request, folder)


def measure(run: Path, options: argparse.Namespace) -> Times:
    """Gauge the checkpoints of a run."""
    noted, times = json.loads((run / "run.json").read_text()), wall_times(run)
    policies = {
        int(found[1]): path
        for path in sorted(run.glob("model_*.pt"))
        if (found := re.fullmatch(r"model_(\d+)(\.gauge)?\.pt", path.name))
    }
    points = []
    for iteration in sorted(policies):
        if iteration not in times:
            raise TimesError(f"the log of '{run}' does not reach iteration {iteration}")
        card = card_of(policies[iteration], options.out / run.name / f"model_{iteration}", options)
        minutes, steps = times[iteration]
        points.append(Point(iteration=iteration, minutes=minutes, steps=steps, score=card.score or 0.0))
        print(
            f"{run.name}: iteration {iteration}, {minutes:.1f} min, {steps:.0f} M steps, {card.score:.4f}", flush=True
        )
    processes = round(next(iter(times.values()))[1] * 1e6 / steps_of_one(noted))
    return Times(
        run=run.name,
        task=noted["task"],
        seed=noted["seed"],
        device=noted["device"],
        processes=processes,
        points=points,
    )


def steps_of_one(noted: Mapping[str, object]) -> float:
    """Return environment steps of one process in one iteration."""
    settings = noted["settings"]
    assert isinstance(settings, Mapping)
    return float(settings["environment"]["num_envs"] * settings["training"]["run"]["steps_per_iteration"])


def table(found: Sequence[Times], scores: Sequence[float]) -> str:
    """Return a Markdown table: minutes (million steps) to each score, and medians of a task on one kind and number of devices."""
    lines = ["| task | seed | devices | " + " | ".join(f"{score:.2f}" for score in scores) + " | last |"]
    lines.append("| --- " * (len(scores) + 4) + "|")
    groups: dict[tuple[str, str], list[Times]] = {}
    for each in found:
        devices = f"{each.processes} × {each.device}"
        groups.setdefault((each.task, devices), []).append(each)
        cells = [_cell(each.first(score)) for score in scores]
        last = each.points[-1]
        lines.append(
            f"| {each.task} | {each.seed} | {devices} | {' | '.join(cells)} | {last.score:.4f}, {last.minutes:.1f} min |"
        )
    for (task, devices), own in groups.items():
        if len(own) < 2:
            continue
        reached = [[point.minutes for each in own if (point := each.first(score))] for score in scores]
        cells = [f"{statistics.median(m):.1f}" if len(m) == len(own) else f"{len(m)} of {len(own)}" for m in reached]
        lines.append(f"| {task} | median of {len(own)} | {devices} | {' | '.join(cells)} | |")
    return "\n".join(lines)


def _cell(point: Point | None) -> str:
    return "–" if point is None else f"{point.minutes:.1f} ({point.steps:.0f} M)"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--scores", type=float, nargs="+", default=list(SCORES))
    parser.add_argument("--suite", default="robogauge-1.1")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--cards", type=Path)
    parser.add_argument("--out", type=Path, default=Path("results/time-to-score"))
    options = parser.parse_args(arguments)
    try:
        found = [measure(run, options) for run in options.runs]
    except TimesError as error:
        raise SystemExit(f"time_to_score: {error}") from error
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "times.json").write_text(json.dumps([asdict(each) for each in found], indent=2) + "\n")
    print(table(found, options.scores))


if __name__ == "__main__":
    main()
