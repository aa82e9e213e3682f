"""Scores of policies on the nominal robot and on measured ones: does the gauge see what identification brought?

    python benchmarks/measured_robot.py pretrained dc.pt:dc.yaml pace.pt:pace.yaml --sets gauge identified --suite mid
    python benchmarks/measured_robot.py anymal.pt --robot anymal_c --sets gauge motors/network.toml \
        --suite gaitgauge-1-network

A policy without a contract of its own is followed by a colon and the file that describes it. Sets are names or files; differences
are to the first, on the same episodes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from gaitgauge.gauge.request import Request
from gaitgauge.studies.naming import distinct_names
from gaitgauge.studies.reality.scoring import score_sets


def main() -> None:
    """Evaluate and print a line for each policy and set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+", help="POLICY or POLICY:CONTRACT")
    parser.add_argument("--sets", nargs="+", default=["gauge", "identified"])
    parser.add_argument("--suite", default="gaitgauge-1")
    parser.add_argument("--pipeline", default="stress", choices=("stress", "multi"))
    parser.add_argument("--terrain", action="append", default=[])
    parser.add_argument("--level", type=int)
    parser.add_argument("--robot")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, default=Path("results/measured-robot"))
    options = parser.parse_args()
    names = distinct_names([text.partition(":")[0] for text in options.policies])
    found: dict[str, Any] = {}
    for name, text in zip(names, options.policies, strict=True):
        policy, _, contract = text.partition(":")
        request = Request(
            policy=policy,
            contract=contract or None,
            suite=options.suite,
            pipeline=options.pipeline,
            terrains=tuple(options.terrain),
            level=options.level,
            robot=options.robot,
            threads=options.threads,
        )
        found[name], _ = score_sets(request, options.sets, folder=options.out / name, runs=options.out / name)
        scores = [d for d in found[name]["differences"] if d["kind"] == "score"]
        for d in scores:
            low, high = d["interval"] or (float("nan"), float("nan"))
            values = f"{d['first']} {d['values'][0]:.4f}, {d['second']} {d['values'][1]:.4f}"
            print(f"{name}: {values}, difference {d['difference']:+.4f} ({low:+.4f} to {high:+.4f})", flush=True)
    (options.out / "measured_robot.json").write_text(json.dumps(found, indent=1, default=str), encoding="utf-8")


if __name__ == "__main__":
    main()
