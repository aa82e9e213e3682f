"""What it costs that a stranger's program runs in a locked process of its own.

    python benchmarks/fence_cost.py [POLICY …] [--suite demo] [--terrain NAME …] [--repeat 3]

Plays part of a suite with one worker. At every control step the program of a TorchScript or ONNX file is asked twice, behind the
fence and in the worker itself. Both must give the same action to the last bit; they take turns in who is asked first, and only
that one's time counts, since it finds the caches as physics left them. So one run compares thousands of steps a few milliseconds
apart, whatever else the machine has to do. A run with either takes what the rest of it took, so many control steps, and loading.

Without POLICY it is the shipped one, as TorchScript and as ONNX. Linux only. Processor time is that of all processes; wall time
means something on an idle machine of two cores or more alone.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.policy.base import PolicySession
from gaitgauge.policy.export.files import export_onnx, export_torchscript
from gaitgauge.policy.foreign.fence.child import Child, Program
from gaitgauge.policy.foreign.fenced_policy import FencedPolicy, FencedSession
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot


class Unfenced:
    """A program in this process, in the place of ``policy.fence.child.Child``."""

    def __init__(self, make: Callable[[bytes, str], Program], data: bytes, *, source: str) -> None:
        self.program = make(data, source)

    def ask(self, do: str, **details: Any) -> dict[str, Any]:
        """See ``Child``."""
        return dict(self.program.answer({"do": do, **details}))


@dataclass(frozen=True)
class Times:
    """What something takes [s]."""

    processor: float
    """Of this process and of the program's."""
    wall: float

    def __add__(self, other: Times) -> Times:
        return Times(self.processor + other.processor, self.wall + other.wall)

    def __sub__(self, other: Times) -> Times:
        return Times(self.processor - other.processor, self.wall - other.wall)

    def __mul__(self, number: int) -> Times:
        return Times(self.processor * number, self.wall * number)


def now(child: Child | None = None) -> Times:
    """What this process, and that of a program, have used since they began, and the time."""
    used = time.process_time()
    if child is not None:
        # the clock of that process, as clock_getcpuclockid gives it
        used += time.clock_gettime(((~child._process.pid) << 3) | 2)
    return Times(used, time.perf_counter())


class InTurn(PolicySession):
    """A program behind the fence and in this process: both get everything, and who is first takes turns."""

    def __init__(self, fenced: PolicySession, alone: PolicySession, child: Child) -> None:
        self._sessions, self._child = (fenced, alone), child
        self.first: tuple[list[Times], list[Times]] = ([], [])
        """Of the steps in which each was first."""
        self.second = Times(0.0, 0.0)
        """Of all that was second."""

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``."""
        for session in self._sessions:
            session.reset(episodes)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        turn = len(self.first[0]) > len(self.first[1])
        began = now(self._child)
        action = self._sessions[turn].act(observation, rows)
        between = now(self._child)
        same = torch.equal(action, self._sessions[not turn].act(observation, rows))
        self.second += now(self._child) - between
        self.first[turn].append(between - began)
        if not same:
            raise SystemExit("actions differ behind the fence and without")
        return action


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a run takes."""

    rest: Times
    """Without the policy's steps and without loading it."""
    number: int
    """Of control steps."""
    steps: tuple[Times, Times]
    """One of them behind the fence, and in the worker: processor time on average, the median of wall times."""
    loading: tuple[Times, Times]
    """Of the policy behind the fence, and in the worker."""

    def shares(self) -> tuple[float, float]:
        """What the fence adds to a run: as a share of its processor time, and of its wall time."""
        fenced, alone = (
            self.rest + step * self.number + load for step, load in zip(self.steps, self.loading, strict=True)
        )
        return fenced.processor / alone.processor - 1.0, fenced.wall / alone.wall - 1.0

    def __str__(self) -> str:
        step, load = ([times.processor for times in pair] for pair in (self.steps, self.loading))
        shares = self.shares()
        return (
            f"a control step takes {1e6 * step[0]:.0f} µs of processor time behind the fence, {1e6 * step[1]:.0f} µs in the "
            f"worker; {self.number} of them, {self.rest.processor:.1f} s for all else, {load[0]:.2f} and {load[1]:.2f} s to load: "
            f"{100 * shares[0]:.1f} % of a run's processor time, {100 * shares[1]:.1f} % of its wall time"
        )


def load_both(policy: str) -> tuple[FencedPolicy, Program, tuple[Times, Times]]:
    """A policy behind the fence, its program in this process, and what it took to load each."""
    began = now()
    fenced = load_policy(policy)
    assert isinstance(fenced, FencedPolicy)
    behind = now(fenced._child) - began
    began = now()
    with patch("gaitgauge.policy.foreign.fence.child.Child", Unfenced):
        alone: Any = load_policy(policy)
    return fenced, alone._child.program, (behind, now() - began)


def run(request: Request) -> Cost:
    """Play both."""
    fenced, program, loading = load_both(str(request.policy))
    sessions: list[InTurn] = []

    def session(child: Child, rows: int, *given: Any, rowwise: bool = False, **options: Any) -> PolicySession:
        behind = FencedSession(child, rows, *given, rowwise=rowwise, **options)
        sessions.append(InTurn(behind, program.session(rows, rowwise=rowwise), child))
        return sessions[-1]

    with (
        tempfile.TemporaryDirectory() as folder,
        patch("gaitgauge.policy.foreign.fenced_policy.FencedSession", session),
        patch("gaitgauge.gauge.evaluate.load_policy", lambda *_, **__: fenced),
    ):
        began = now(fenced._child)
        evaluate(request, Path(folder) / "run")
        rest = now(fenced._child) - began
    first: tuple[list[Times], list[Times]] = ([], [])
    for made in sessions:
        rest = rest - sum(made.first[0] + made.first[1], Times(0.0, 0.0)) - made.second
        for all_of_them, its in zip(first, made.first, strict=True):
            all_of_them.extend(its)
    steps = [
        Times(statistics.mean(t.processor for t in times), statistics.median(t.wall for t in times)) for times in first
    ]
    return Cost(rest=rest, number=len(first[0]) + len(first[1]), steps=(steps[0], steps[1]), loading=loading)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="*", metavar="POLICY")
    parser.add_argument("--suite", default="demo")
    parser.add_argument("--terrain", nargs="*", default=[])
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        policies = arguments.policies
        if not policies:
            shipped = load_policy("pretrained", load_robot("go2"))
            policies = [f"{folder}/pretrained.pt", f"{folder}/pretrained.onnx"]
            export_torchscript(shipped, policies[0])
            export_onnx(shipped, policies[1])
        for policy in policies:
            request = Request(policy=policy, suite=arguments.suite, terrains=tuple(arguments.terrain), threads=1)
            shares = []
            for _ in range(arguments.repeat):
                cost = run(request)
                shares.append(cost.shares())
                print(f"{Path(policy).name}: {cost}", flush=True)
            processor, wall = (100 * statistics.median(column) for column in zip(*shares, strict=True))
            print(
                f"{Path(policy).name}: medians {processor:.1f} % of the processor time, {wall:.1f} % of the wall time",
                flush=True,
            )


if __name__ == "__main__":
    main()
