"""What it costs that a stranger's program runs in a locked process of its own.

    python benchmarks/fence_cost.py [POLICY] [--suite demo] [--terrain NAME …] [--repeat 3]

Plays part of a suite with one worker, in turn with the program of a TorchScript or ONNX file behind the fence and in the worker
itself, and prints wall times, their medians and the median of the pairs' ratios. Without POLICY it is the shipped one as
TorchScript. Files whose networks are known are rebuilt from their weights and need no fence; here they are run with their own
code all the same, since that is what the fence is for. Both must give the same score. For an idle machine of two cores or more:
worker and program take turns, but on one core each would wait for the other to be put aside. Runs of a few seconds differ by more
than the fence costs: the last line is of control steps alone, measured in turn.
"""

from __future__ import annotations

import argparse
import gc
import resource
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
from gaitgauge.policy.fenced import FencedPolicy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.steady import ROWS
from gaitgauge.robots import load_robot

STEPS = 500
"""Control steps of which the processor time is measured alone."""


class Unfenced:
    """A program in this process, in the place of ``policy.fence.child.Child``."""

    def __init__(self, make: Callable[[bytes, str], Program], data: bytes, *, source: str) -> None:
        self._program = make(data, source)

    def ask(self, do: str, **details: Any) -> dict[str, Any]:
        """See ``Child``."""
        return dict(self._program.answer({"do": do, **details}))

    def session(self, rows: int, width: int, joints: int, *, rowwise: bool) -> UnfencedSession:
        """See ``Child``."""
        return UnfencedSession(self._program.session(rows, rowwise=rowwise))


class UnfencedSession:
    """In the place of ``policy.fence.child.ChildSession``."""

    acted = 0

    def __init__(self, session: PolicySession) -> None:
        self._session, self.batched = session, session.batched

    def act(self, observation: np.ndarray, forget: np.ndarray | None) -> np.ndarray:
        """See ``ChildSession``."""
        UnfencedSession.acted += 1
        if forget is not None:
            self._session.reset(torch.from_numpy(forget))
        return self._session.act(torch.from_numpy(observation)).numpy()


def processor_seconds() -> float:
    """Processor time of this process and of its children that have ended, user and system."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def run(request: Request) -> tuple[float, float, float]:
    """Wall time, processor time and score of one run."""
    with tempfile.TemporaryDirectory() as folder:
        began, used = time.perf_counter(), processor_seconds()
        results = evaluate(request, Path(folder) / "run")
        wall = time.perf_counter() - began
        gc.collect()  # a program's process ends, and is counted, with what refers to it
        return wall, processor_seconds() - used, results["score"]


def step_seconds(policy: str) -> tuple[float, float]:
    """Processor time of one action of all rows behind the fence and in this process: medians of calls in turn.

    Something else is calculated between them, as physics is in a run. Linux only.
    """
    fenced = load_policy(policy)
    assert isinstance(fenced, FencedPolicy)
    with patch("gaitgauge.policy.fence.child.Child", Unfenced):
        alone = load_policy(policy)
    child = ((~fenced._child._process.pid) << 3) | 2  # the clock of that process, as clock_getcpuclockid gives it
    other, observation = np.random.rand(1_000_000), torch.randn(ROWS, fenced.contract.observation_width)
    sessions = fenced.session(ROWS), alone.session(ROWS)
    used: tuple[list[float], list[float]] = ([], [])
    with torch.inference_mode():
        for _ in range(STEPS):
            for session, seconds in zip(sessions, used, strict=True):
                for _ in range(8):
                    other.sum()
                began = time.thread_time() + time.clock_gettime(child)
                session.act(observation)
                seconds.append(time.thread_time() + time.clock_gettime(child) - began)
    return statistics.median(used[0]), statistics.median(used[1])


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", nargs="?")
    parser.add_argument("--suite", default="demo")
    parser.add_argument("--terrain", nargs="*", default=[])
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder, patch("gaitgauge.policy.loading.rebuilt", lambda policy: policy):
        policy = arguments.policy or f"{folder}/policy.pt"
        if arguments.policy is None:
            export_torchscript(load_policy("pretrained", load_robot("go2")), policy)
        request = Request(policy=policy, suite=arguments.suite, terrains=tuple(arguments.terrain), threads=1)
        ratios, steps = [], step_seconds(policy)
        print("        fenced [s]       in the worker [s]          ratio")
        print("    wall processor       wall   processor    wall processor   score", flush=True)
        for _ in range(arguments.repeat):
            wall, used, score = run(request)
            with patch("gaitgauge.policy.fence.child.Child", Unfenced):
                before = UnfencedSession.acted
                wall_alone, used_alone, same = run(request)
                counted = UnfencedSession.acted - before
            if score != same:
                raise SystemExit(f"scores differ: {score} behind the fence, {same} without")
            ratios.append((wall / wall_alone, used / used_alone))
            print(
                f"{wall:8.2f} {used:9.2f}  {wall_alone:9.2f}   {used_alone:9.2f}  "
                f"{ratios[-1][0]:6.3f} {ratios[-1][1]:9.3f}  {score:.4f}",
                flush=True,
            )
    medians = [statistics.median(column) for column in zip(*ratios, strict=True)]
    print(f"medians of the ratios: wall {medians[0]:.3f}, processor {medians[1]:.3f}")
    extra = steps[0] - steps[1]
    print(
        f"one control step of {ROWS} robots, processor time: {1e6 * steps[0]:.0f} µs fenced, {1e6 * steps[1]:.0f} µs in the "
        f"worker; {counted} of them in a run: {100 * extra * counted / used_alone:.1f} % of its processor time"
    )


if __name__ == "__main__":
    main()
