"""How long a stress run takes on the CPU engine, where the time goes, and how it scales with threads.

    python benchmarks/gauge_speed.py POLICY [--friction 0.6] [--threads 1 2] [--repeat 1] [--out FILE.json]

For each number of threads it plays the suite's stress pipeline at the given frictions into a temporary folder and
prints: wall time, physics steps, time per physics step and core, the share of the wall time that a process spends inside
MuJoCo's own stepping (start, loading and writing included in the rest), and the score.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import tempfile
import time
from pathlib import Path

from gaitgauge.gauge.evaluate import Request, evaluate


def run(arguments: argparse.Namespace, threads: int) -> dict[str, float]:
    """One run; returns its figures."""
    request = Request(
        policy=arguments.policy,
        suite=arguments.suite,
        frictions=tuple(arguments.friction),
        terrains=tuple(arguments.terrain),
        threads=threads,
    )
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        results = evaluate(request, Path(folder) / "run")
        seconds = time.perf_counter() - began
    provenance = results["provenance"]
    steps, processes, engine = provenance["physics_steps"], provenance["processes"], provenance["engine_seconds"]
    return {
        "threads": threads,
        "seconds": seconds,
        "physics_steps": steps,
        "microseconds_per_step_and_core": engine * (threads // processes) / steps * 1e6,
        "stepping_share": engine / processes / seconds,
        "score": results["score"],
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("--suite", default="robogauge-1.1")
    parser.add_argument("--friction", type=float, nargs="+", default=[0.6])
    parser.add_argument("--terrain", nargs="*", default=[])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rows = []
    print(f"{arguments.suite}, friction {arguments.friction}, {platform.processor() or platform.machine()}")
    print("threads  seconds  physics steps  us/step/core  stepping  score")
    for threads in arguments.threads:
        runs = [run(arguments, threads) for _ in range(arguments.repeat)]
        row = {k: statistics.median(r[k] for r in runs) for k in runs[0]}
        rows.append(row)
        print(
            f"{row['threads']:7.0f}  {row['seconds']:7.1f}  {row['physics_steps']:13.0f}  "
            f"{row['microseconds_per_step_and_core']:12.1f}  {row['stepping_share']:8.1%}  {row['score']:.4f}",
            flush=True,
        )
    if arguments.out:
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
