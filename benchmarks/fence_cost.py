"""What it costs that a stranger's program runs in a locked process of its own.

    python benchmarks/fence_cost.py [POLICY] [--suite demo] [--terrain NAME …] [--repeat 3]

Plays part of a suite with one worker, in turn with the program of a TorchScript or ONNX file behind the fence and in the worker
itself, and prints wall times, their medians and the median of the pairs' ratios. Without POLICY it is the shipped one as
TorchScript. Files whose networks are known are rebuilt from their weights and need no fence; here they are run with their own
code all the same, since that is what the fence is for. Both must give the same score. For an idle machine of two cores or more:
worker and program take turns, but on one core each would wait for the other to be put aside.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.policy.base import PolicySession
from gaitgauge.policy.export import export_torchscript
from gaitgauge.policy.fence.child import Program
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot


class Unfenced:
    """A program in this process, in the place of ``policy.fence.child.Child``."""

    def __init__(self, make: Callable[[bytes, str], Program], data: bytes, *, source: str) -> None:
        self._program = make(data, source)
        self._sessions: dict[int, PolicySession] = {}

    def ask(self, do: str, **details: Any) -> dict[str, Any]:
        """See ``Child``."""
        return dict(self._program.answer({"do": do, **details}))

    def session(self, rows: int, *, rowwise: bool) -> tuple[int, bool]:
        """See ``Child``."""
        made = self._program.session(rows, rowwise=rowwise)
        number = max(self._sessions, default=0) + 1
        self._sessions[number] = made
        return number, made.batched

    def drop(self, number: int) -> None:
        """See ``Child``."""
        self._sessions.pop(number, None)

    def act(self, number: int, observation: np.ndarray, forget: np.ndarray | None, joints: int) -> torch.Tensor:
        """See ``Child``."""
        session = self._sessions[number]
        if forget is not None:
            session.reset(torch.from_numpy(forget))
        return session.act(torch.from_numpy(observation))


def run(request: Request) -> tuple[float, float]:
    """Seconds and score of one run."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        results = evaluate(request, Path(folder) / "run")
        return time.perf_counter() - began, results["score"]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", nargs="?")
    parser.add_argument("--suite", default="demo")
    parser.add_argument("--terrain", nargs="*", default=[])
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, patch("gaitgauge.policy.loading.rebuilt", lambda policy: policy):
        policy = arguments.policy or f"{folder}/policy.pt"
        if arguments.policy is None:
            export_torchscript(load_policy("pretrained", load_robot("go2")), policy)
        request = Request(policy=policy, suite=arguments.suite, terrains=tuple(arguments.terrain), threads=1)
        pairs = []
        print("fenced [s]  in the worker [s]  ratio   score", flush=True)
        for _ in range(arguments.repeat):
            fenced, score = run(request)
            with patch("gaitgauge.policy.fence.child.Child", Unfenced):
                alone, same = run(request)
            if score != same:
                raise SystemExit(f"scores differ: {score} behind the fence, {same} without")
            pairs.append((fenced, alone))
            print(f"{fenced:10.2f}  {alone:17.2f}  {fenced / alone:5.3f}  {score:.4f}", flush=True)
    first, second = (statistics.median(column) for column in zip(*pairs, strict=True))
    print(f"{first:10.2f}  {second:17.2f}  {statistics.median(a / b for a, b in pairs):5.3f}  medians")


if __name__ == "__main__":
    main()
