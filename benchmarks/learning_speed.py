"""Speed of learning without an environment: rollout bookkeeping and updates on random data.

    python benchmarks/learning_speed.py --num-envs 8192 --device cuda:0
    python benchmarks/learning_speed.py --task go2-him --variants "tf32, compiled, CUDA graphs, alternate"

Prints, for each variant of the algorithm's settings, the time of a rollout's forward passes, of one update, and the
environment steps a second that learning alone would allow.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from gaitgauge.policy.contract import standard_contract
from gaitgauge.robots import load_robot
from gaitgauge.training.algorithms.methods import find_method
from gaitgauge.training.algorithms.symmetry import build_mirror
from gaitgauge.training.configuration import TrainingConfiguration
from gaitgauge.training.environment.configuration import ObservationConfiguration
from gaitgauge.training.tasks import find_task
from tensordict import TensorDict

WIDTHS = {"policy": 45, "history": 225, "privileged": 263}
PUBLISHED: dict[str, Any] = {"symmetry": "none", "precision": "tf32"}
"""What a variant has where it names nothing else."""
PLAIN: dict[str, Any] = {"cuda_graphs": False, "compile_mode": "none"}
VARIANTS: dict[str, dict[str, Any]] = {
    "float32": PLAIN | {"precision": "float32"},
    "tf32": PLAIN,
    "bfloat16": PLAIN | {"precision": "bfloat16"},
    "tf32, CUDA graphs": PLAIN | {"cuda_graphs": True},
    "bfloat16, CUDA graphs": PLAIN | {"precision": "bfloat16", "cuda_graphs": True},
    "tf32, compiled": PLAIN | {"compile_mode": "default"},
    "tf32, compiled, CUDA graphs": {"compile_mode": "default", "cuda_graphs": True},
    "bfloat16, compiled, CUDA graphs": {"precision": "bfloat16", "compile_mode": "default", "cuda_graphs": True},
    "tf32, compiled, CUDA graphs, augmented": {"compile_mode": "default", "cuda_graphs": True, "symmetry": "augment"},
    "bfloat16, compiled, CUDA graphs, augmented": {
        "precision": "bfloat16",
        "compile_mode": "default",
        "cuda_graphs": True,
        "symmetry": "augment",
    },
    "tf32, compiled, CUDA graphs, alternate": {"compile_mode": "default", "cuda_graphs": True, "symmetry": "alternate"},
    "bfloat16, compiled, CUDA graphs, alternate": {
        "precision": "bfloat16",
        "compile_mode": "default",
        "cuda_graphs": True,
        "symmetry": "alternate",
    },
}


def measure(configuration: TrainingConfiguration, *, num_envs: int, repeat: int, device: str) -> dict[str, float]:
    """Seconds of a rollout and of an update, means over ``repeat`` iterations after as many to warm up."""
    torch.manual_seed(0)
    steps = configuration.run.steps_per_iteration
    robot = load_robot("go2")
    mirror = build_mirror(ObservationConfiguration(), contract=standard_contract(robot), robot=robot)
    groups = {name: torch.randn(num_envs, width, device=device) for name, width in WIDTHS.items()}
    observations = TensorDict(groups, batch_size=[num_envs])
    algorithm = find_method(configuration.algorithm.method).build(
        observations,
        configuration,
        num_actions=robot.num_joints,
        command_entries=(6, 7, 8),
        mirror=mirror,
        device=device,
    )
    rewards, dones = torch.randn(num_envs, device=device), torch.zeros(num_envs, dtype=torch.bool, device=device)
    on_gpu = torch.device(device).type == "cuda"
    times = {"rollout": 0.0, "update": 0.0}
    for iteration in range(2 * repeat):
        marks = []
        for part in ("start", "rollout", "update"):
            if part == "rollout":
                with torch.inference_mode():
                    for _ in range(steps):
                        algorithm.act(observations)
                        algorithm.store_outcome(rewards, dones, {"time_outs": dones})
                    algorithm.compute_returns(observations)
            elif part == "update":
                algorithm.update()
            if on_gpu:
                torch.cuda.synchronize()
            marks.append(time.perf_counter())
        if iteration >= repeat:
            times["rollout"] += (marks[1] - marks[0]) / repeat
            times["update"] += (marks[2] - marks[1]) / repeat
    return times | {"memory_gb": torch.cuda.max_memory_allocated() / 1e9 if on_gpu else 0.0}


def main() -> None:
    """Measure all variants that the device can run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", default="go2-moe-cts", help="whose method and networks are measured")
    parser.add_argument("--num-envs", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--student-period", type=int, default=2, help="every which environment is the student's")
    parser.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--variants", nargs="*", help="names, default all", default=list(VARIANTS))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    results = {}
    for name in options.variants:
        settings = {"student_period": options.student_period} | VARIANTS[name]
        if settings.get("cuda_graphs") and torch.device(options.device).type != "cuda":
            continue
        if torch.device(options.device).type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        training = find_task(options.task).training
        configuration = replace(
            training,
            algorithm=replace(training.algorithm, **(PUBLISHED | settings)),
            run=replace(training.run, steps_per_iteration=options.steps),
        )
        result = measure(configuration, num_envs=options.num_envs, repeat=options.repeat, device=options.device)
        speed = options.num_envs * options.steps / (result["rollout"] + result["update"])
        results[name] = result | {"steps_per_second": speed}
        print(
            f"{name:43s} rollout {result['rollout'] * 1e3:8.1f} ms   update {result['update'] * 1e3:8.1f} ms   "
            f"{speed:12,.0f} steps/s   {result['memory_gb']:5.1f} GB",
            flush=True,
        )
    if options.out:
        options.out.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
