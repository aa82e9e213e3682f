"""Speed of training one policy on several GPUs, with the same number of worlds on each.

    python benchmarks/several_gpus.py --gpus 1 2 4 --num-envs 8192 --out several_gpus.json

Trains a task for some iterations on the first GPU, on the first two, and so on; prints environment steps a second of the
iterations after ``--skip`` (compiling and CUDA graphs are behind them), as the median over iterations, how much that is of the
first line, and where the time of an iteration goes. ``--device cpu --backend mujoco`` tries it on a machine without a GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaitgauge.training.environment.stretches import first_alone
from gaitgauge.training.tasks import find_task
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

KEYS = {"speed": "Perf/total_fps", "collection": "Perf/collection_time", "learning": "Perf/learning_time"}


def measure(count: int, options: argparse.Namespace) -> dict[str, float]:
    """Train in ``count`` processes; medians over the iterations after the first ones.

    Raises:
        SystemExit: the training failed.
    """
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)] if count > 1 else []
    environment = dict(os.environ)
    if options.device == "cuda":
        given = environment.get("CUDA_VISIBLE_DEVICES")
        names = given.split(",") if given else [str(n) for n in range(max(options.gpus))]
        environment["CUDA_VISIBLE_DEVICES"] = ",".join(names[:count])
    with tempfile.TemporaryDirectory() as logs:
        command = [sys.executable, *launcher, "-m", "gaitgauge.cli.main", "train", options.task, "--no-score"]
        command += ["--device", options.device, "--backend", options.backend, "--num-envs", str(options.num_envs)]
        command += ["--iterations", str(options.iterations), "--log-root", logs, "training.run.keep_episodes=false"]
        command += first_alone(find_task(options.task).environment)
        command += [] if options.fuse is None else ["--fuse" if options.fuse else "--no-fuse"]
        done = subprocess.run(
            [*command, *options.settings], env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout[-3000:]}")
        (events,) = Path(logs).rglob("events.out.tfevents.*")
        log = EventAccumulator(str(events))
        log.Reload()
        return {
            name: statistics.median(e.value for e in log.Scalars(key) if e.step >= options.skip)
            for name, key in KEYS.items()
        }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure each number of GPUs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gpus", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--task", default="go2-moe-cts")
    parser.add_argument("--num-envs", type=int, default=8192, help="worlds on each GPU")
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--skip", type=int, default=20, help="iterations that do not count")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--backend", default="mujoco-warp")
    parser.add_argument(
        "--fuse", action=argparse.BooleanOptionalAction, help="compile the environment's torch parts; default: on a GPU"
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("settings", nargs="*", metavar="key=value", help="settings of the task")
    options = parser.parse_intermixed_args(arguments)
    rows: list[dict[str, Any]] = []
    for count in options.gpus:
        found = measure(count, options)
        first = rows[0]["speed"] if rows else found["speed"]
        rows.append({"gpus": count, "num_envs": options.num_envs, **found, "speed_up": found["speed"] / first})
        print(
            f"{count} GPU{'s' if count > 1 else ' '}  {options.num_envs} worlds each  {found['speed']:12,.0f} steps/s  "
            f"{rows[-1]['speed_up']:5.2f} times  collection {found['collection'] * 1e3:7.1f} ms  "
            f"learning {found['learning'] * 1e3:7.1f} ms",
            flush=True,
        )
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
