"""How long a stress run takes on the CPU engine, where the time goes, how it scales with threads, and how policies compare.

    python benchmarks/gauge_speed.py POLICY [POLICY …] [--friction 0.6] [--threads 1 2] [--repeat 1] [--out FILE.json]

For each number of threads it plays the suite's stress pipeline at the given frictions into a temporary folder, the
policies in turn in each repeat, and prints medians: wall time, processor time of all processes, physics steps, time per
physics step and core, the share of the wall time that a process spends inside MuJoCo's own stepping (start, loading and
writing included in the rest), the score, and wall and processor time for each physics step against the first policy's. What
others do on the machine changes the figures of a run, but those of runs beside each other alike.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import statistics
import tempfile
import time
from pathlib import Path

from gaitgauge.gauge.evaluate import Request, evaluate


def processor_seconds() -> float:
    """What this process and its finished children have used."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in used)


def run(arguments: argparse.Namespace, policy: str, threads: int) -> dict[str, float]:
    """One run; returns its figures."""
    request = Request(
        policy=policy,
        suite=arguments.suite,
        frictions=tuple(arguments.friction),
        terrains=tuple(arguments.terrain),
        threads=threads,
    )
    with tempfile.TemporaryDirectory() as folder:
        began, used = time.perf_counter(), processor_seconds()
        result = evaluate(request, Path(folder) / "run")
        seconds = time.perf_counter() - began
    provenance = result.provenance
    steps, processes, engine = provenance.physics_steps, provenance.processes, provenance.engine_seconds or 0.0
    return {
        "threads": threads,
        "seconds": seconds,
        "processor_seconds": processor_seconds() - used,
        "physics_steps": steps,
        "microseconds_per_step_and_core": engine * (threads // processes) / steps * 1e6,
        "stepping_share": engine / processes / seconds,
        "score": result.score,
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+", metavar="policy")
    parser.add_argument("--suite", default="robogauge-1.1")
    parser.add_argument("--friction", type=float, nargs="+", default=[0.6])
    parser.add_argument("--terrain", nargs="*", default=[])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rows = []
    print(f"{arguments.suite}, friction {arguments.friction}, {platform.processor() or platform.machine()}")
    print("threads  seconds  processor  physics steps  us/step/core  stepping  score   against the first  policy")
    for threads in arguments.threads:
        runs: dict[str, list[dict[str, float]]] = {policy: [] for policy in arguments.policies}
        for _ in range(arguments.repeat):
            for policy, made in runs.items():
                made.append(run(arguments, policy, threads))
        first = runs[arguments.policies[0]]
        for policy, made in runs.items():
            row = {k: statistics.median(r[k] for r in made) for k in made[0]}
            for kind in ("seconds", "processor_seconds"):
                row[f"{kind}_ratio"] = statistics.median(
                    (a[kind] / a["physics_steps"]) / (b[kind] / b["physics_steps"])
                    for a, b in zip(made, first, strict=True)
                )
            rows.append({"policy": policy, **row})
            print(
                f"{row['threads']:7.0f}  {row['seconds']:7.1f}  {row['processor_seconds']:9.1f}  "
                f"{row['physics_steps']:13.0f}  {row['microseconds_per_step_and_core']:12.1f}  "
                f"{row['stepping_share']:8.1%}  {row['score']:.4f}  "
                f"{row['seconds_ratio']:8.2f} {row['processor_seconds_ratio']:8.2f}  {policy}",
                flush=True,
            )
    if arguments.out:
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
