"""Train the task ``toy`` with several seeds and judge each with a seed of the gauge that nothing was chosen by.

    python benchmarks/toy_training.py --seeds 1 2 3 --out toy.json

Prints for each seed the scores of a robot that stands, of the untrained networks and of the trained ones; the training's time and speed;
the speed of MuJoCo's own calls in the same run, on which other programs on the machine weigh alike; and CPU time for each environment
step, of which the physics' part is spread over the cores.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import gaitgauge
import torch
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.training.run.launch import train
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.run.resuming import save_run
from gaitgauge.training.run.runner import TrainingRunner

HELD_OUT = 4000
"""Seed of the gauge that judges."""


class Meter:
    """Times and CPU times of training loops, and of MuJoCo within them."""

    def __init__(self) -> None:
        self.run: dict[str, float] = {}
        learn = TrainingRunner.learn

        def measured(runner: TrainingRunner, *arguments: Any, **options: Any) -> Any:
            assert runner.log_dir is not None
            save_run(runner, runner.log_dir / "model_0.pt")
            backend: Any = runner.env.backend
            step, engine = backend.step, 0.0

            def stepped(*given: Any, **named: Any) -> None:
                nonlocal engine
                began = time.process_time()
                step(*given, **named)
                engine += time.process_time() - began

            backend.step, backend.engine_seconds = stepped, 0.0
            cpu = time.process_time()
            outcome = learn(runner, *arguments, **options)
            steps = float(runner.logger.total_steps)
            self.run = {
                "steps": steps,
                "loop_seconds": runner.logger.total_time,
                "engine_seconds": backend.engine_seconds,
                "cpu_microseconds": 1e6 * (time.process_time() - cpu) / steps,
                "physics_cpu_microseconds": 1e6 * engine / steps,
            }
            return outcome

        TrainingRunner.learn = measured  # type: ignore[method-assign, assignment]


def standing(folder: Path) -> Path:
    """Return the file of a policy that holds the standing pose."""
    contract = standard_contract(load_robot("go2"), provenance={"kind": "standing"})
    arguments: dict[str, Any] = {"frame_width": contract.frame_width, "num_actions": 12, "hidden": [1]}
    zeros = {name: torch.zeros_like(value) for name, value in MlpNetwork(**arguments).state_dict().items()}
    save_policy(
        folder / "standing.gauge.pt", contract, StoredNetwork(architecture="mlp", arguments=arguments, state_dict=zeros)
    )
    return folder / "standing.gauge.pt"


def main() -> None:
    """Train, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--log-root", type=Path, default=Path("logs/rsl_rl"))
    parser.add_argument("--out", type=Path, help="write a JSON file")
    asked = parser.parse_args()
    meter, rows = Meter(), []
    asked.log_root.mkdir(parents=True, exist_ok=True)

    def score(policy: Path, name: str, folder: Path) -> float | None:
        result = gaitgauge.evaluate(policy, suite="toy", seeds=(HELD_OUT,), out=folder / f"judged-{name}")
        return result.score

    still = score(standing(asked.log_root), "standing", asked.log_root)
    print("seed  standing  untrained  trained  minutes  steps/s  MuJoCo steps/s  CPU us/step (physics)  load")
    for seed in asked.seeds:
        began, cpu = time.monotonic(), time.process_time()
        plan = prepare(TrainRequest(task="toy", seed=seed, log_root=asked.log_root))
        outcome, run = train(plan, began=began)
        minutes, measured = (time.monotonic() - began) / 60.0, meter.run
        assert outcome.checkpoint is not None
        row = {
            "seed": seed,
            "standing": still,
            "untrained": score(run / "model_0.pt", "untrained", run),
            "trained": score(outcome.checkpoint, "trained", run),
            "minutes": minutes,
            "cpu_seconds": time.process_time() - cpu,
            **measured,
            "load": os.getloadavg()[2],
            "run": str(run),
        }
        rows.append(row)
        print(
            f"{seed:4}  {row['standing']:8.4f}  {row['untrained']:9.4f}  {row['trained']:7.4f}  {minutes:7.1f}  "
            f"{measured['steps'] / measured['loop_seconds']:7,.0f}  {measured['steps'] / measured['engine_seconds']:14,.0f}  "
            f"{measured['cpu_microseconds']:11.0f} ({measured['physics_cpu_microseconds']:.0f})  {row['load']:.1f}",
            flush=True,
        )
        if asked.out:
            asked.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
