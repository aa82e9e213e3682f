"""Identifies simulated robots with known constants and counts how often they lie inside their 98 % intervals.

    python benchmarks/identification_coverage.py --draws 100 --processes 32

Each draw is a Go2 with random constants, recorded hung up in two chirps with different kd, with noise and uneven times.
``--draws-file`` gets a line for each draw as it ends; draws that stand there already are not repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gaitgauge.robots import JointParameters, Robot, load_robot
from gaitgauge.robots.sets import joint_groups
from gaitgauge.studies.reality.chirp import Chirp, simulated_log
from gaitgauge.studies.reality.identification import KINDS, Fit, identify

RANGES = {
    "armature": (0.005, 0.03),
    "joint_damping": (0.05, 0.4),
    "friction_loss": (0.05, 0.5),
    "stiffness_factor": (0.85, 1.1),
    "damping_factor": (0.85, 1.15),
    "target_offset": (-0.03, 0.03),
}
DELAYS = (0.002, 0.010)
HALF_STEP = 0.001
"""Half of a physics step [s], the least error of a delay that matters."""


def random_robot(robot: Robot, seed: int) -> JointParameters:
    """Return the nominal set with random constants, uniform in ``RANGES``."""
    random = np.random.default_rng(seed)
    values: dict[str, Any] = {}
    for key, (low, high) in RANGES.items():
        drawn = random.uniform(low, high, robot.num_joints)
        if not KINDS[key].each_joint:
            for joints in joint_groups(robot).values():
                drawn[joints] = drawn[joints[0]]
        values[key] = tuple(drawn.tolist())
    return replace(robot.parameters["gauge"], **values, delay=float(random.uniform(*DELAYS)))


def true_values(fit: Fit, truth: JointParameters) -> list[float]:
    """Return the true value of each unknown; NaN for velocities at the start."""
    values = []
    for unknown in fit.unknowns:
        if unknown.key == "start":
            values.append(float("nan"))
        else:
            value = getattr(truth, unknown.key)
            values.append(value if unknown.key == "delay" else value[unknown.joints[0]])
    return values


def identify_draw(seed: int, seconds: float = 8.0, last: float = 5.0) -> dict[str, Any]:
    """Identify one random robot; return by constant whether it is known and inside its interval, and the errors of the delays."""
    robot = load_robot("go2", check=False)
    truth = random_robot(robot, seed)
    chirp = Chirp(seconds=seconds, last=last)
    logs = [
        simulated_log(robot, truth, chirp=chirp, damping=kd, seed=2 * seed + i, name=f"kd{kd:g}")
        for i, kd in enumerate((1.0, 3.0))
    ]
    fit = identify(logs, robot.parameters["gauge"], threads=1, seed=seed)
    found: dict[str, Any] = {"seed": seed, "inside": {}, "unknown": [], "delay_error": []}
    for unknown, value, span, known, true in zip(
        fit.unknowns, fit.values, fit.intervals, fit.known, true_values(fit, truth), strict=True
    ):
        if unknown.key == "start":
            continue
        if unknown.key == "delay":
            found["delay_error"].append(abs(float(value) - true))
        if not known:
            found["unknown"].append(unknown.label)
        else:
            found["inside"][unknown.label] = bool(span[0] <= true <= span[1])
    return found


def main() -> None:
    """Run the draws and print a line for each constant."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seconds", type=float, default=8.0, help="length of each recording [s]")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--draws-file", type=Path, default=Path("results/identification_coverage.jsonl"))
    options = parser.parse_args()
    began = time.perf_counter()
    options.draws_file.parent.mkdir(parents=True, exist_ok=True)
    lines = options.draws_file.read_text(encoding="utf-8").splitlines() if options.draws_file.exists() else []
    seeds = range(options.first, options.first + options.draws)
    done = {draw["seed"]: draw for draw in map(json.loads, lines) if draw["seed"] in seeds}
    with ProcessPoolExecutor(options.processes) as pool, open(options.draws_file, "a", encoding="utf-8") as file:
        left = [pool.submit(identify_draw, seed, options.seconds) for seed in seeds if seed not in done]
        for draw in (task.result() for task in as_completed(left)):
            done[draw["seed"]] = draw
            file.write(json.dumps(draw) + "\n")
            file.flush()
    found = [done[seed] for seed in seeds]
    labels = list(dict.fromkeys(label for draw in found for label in (*draw["inside"], *draw["unknown"])))
    worst = 1.0
    for label in labels:
        inside = [draw["inside"][label] for draw in found if label in draw["inside"]]
        share = float(np.mean(inside)) if inside else float("nan")
        worst = min(worst, share) if inside else worst
        print(f"{label:32s} inside in {sum(inside)} of {len(inside)}, not told in {len(found) - len(inside)}")
    errors = [error for draw in found for error in draw["delay_error"]]
    near = sum(error <= HALF_STEP for error in errors)
    print(f"delays: {near} of {len(errors)} to half a step (1 ms), largest error {1e3 * max(errors):.2f} ms")
    print(f"least share inside {worst:.2f}; {options.draws} draws in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
