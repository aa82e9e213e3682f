"""How often policies fall in the same random cases of ``gaitgauge worst``, with upper bounds, and by how much they differ.

    python benchmarks/fall_bounds.py pretrained trained.pt control.pt --cases 3000 --seed 12 --threads 6 --folder /tmp/bounds

The cases are the random sample of a search with that seed: all conditions at once, uniformly from the ranges. All policies meet
the same cases with the same start and noise, so differences are paired. The policies take turns, a batch each; what the folder
holds is not played again, and a run that is stopped or goes on with more ``--cases`` keeps what it has.
"""

from __future__ import annotations

import argparse
import json
import sys
from itertools import combinations
from math import sqrt
from pathlib import Path

import numpy as np
import torch
from gaitgauge.files.choices import cpu_threads
from gaitgauge.files.writing import write_atomically
from gaitgauge.gauge.store import StoreError
from gaitgauge.studies.worst.playing import Players
from gaitgauge.studies.worst.prepared import PreparedSearch, prepare_search
from gaitgauge.studies.worst.ranges import scenario_of
from gaitgauge.studies.worst.request import WorstRequest
from gaitgauge.studies.worst.search import random_case, upper_bound

_NORMAL, _POWER = 1.96, 0.84
"""Of a two-sided interval of 95 %, and of a difference that is seen with a chance of 80 %."""


def play(prepared: PreparedSearch, path: Path, first: int, last: int, threads: int) -> list[bool]:
    """Return whether the robot fell in each case up to ``last``; plays those from ``first`` on that the file does not hold."""
    held: list[bool] = json.loads(path.read_text()) if path.is_file() else []
    seed, begin = prepared.request.seed, max(first, len(held))
    if begin < last:
        cases = [
            random_case(np.random.default_rng([seed, 1, i]), prepared.ranges, f"sample-{i}") for i in range(begin, last)
        ]
        with Players(prepared.loaded.policy, prepared.robot, threads) as players:
            plays = [(scenario_of(case, prepared.measures), 0) for case in cases]
            held = held[:begin] + [outcome.fell for outcome in players.play(plays, prepared.engine)]
        write_atomically(path, json.dumps(held), StoreError)
    return held[:last]


def report(fell: dict[str, list[bool]]) -> None:
    """Print falls, bounds and paired differences of the cases that all policies have played."""
    count = min(map(len, fell.values()))
    print(f"\n{count} cases\n{'policy':40}{'falls':>7}{'share':>9}{'at most':>9}")
    for label, own in fell.items():
        falls = sum(own[:count])
        print(f"{label:40}{falls:7}{falls / count:9.4f}{upper_bound(falls, count):9.4f}")
    for a, b in combinations(fell, 2):
        gain = np.array(fell[b][:count], dtype=float) - np.array(fell[a][:count], dtype=float)
        error = float(gain.std(ddof=1)) / sqrt(count)
        print(
            f"{b} minus {a}: {gain.mean():+.4f} ({gain.mean() - _NORMAL * error:+.4f} to {gain.mean() + _NORMAL * error:+.4f}); "
            f"{int((gain > 0).sum())} fall only with it, {int((gain < 0).sum())} no longer; "
            f"a difference of {(_NORMAL + _POWER) * error:.4f} would be seen in 80 %"
        )
    sys.stdout.flush()


def main() -> None:
    """Play and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--folder", type=Path, required=True, help="what was played is kept there")
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=200, help="cases of a turn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    prepared = {
        name: prepare_search(WorstRequest(policy=name, others=(), seed=arguments.seed, device="cpu"))
        for name in arguments.policies
    }
    threads = cpu_threads(arguments.threads)
    fell: dict[str, list[bool]] = {name: [] for name in prepared}
    for first in range(0, arguments.cases, arguments.batch):
        last = min(first + arguments.batch, arguments.cases)
        for name, each in prepared.items():
            path = arguments.folder / f"{each.loaded.policy.file_sha256[:12]}-{arguments.seed}.json"
            fell[name] = play(each, path, first, last, threads)
        if len(fell) > 1 or last == arguments.cases:
            report(fell)


if __name__ == "__main__":
    main()
