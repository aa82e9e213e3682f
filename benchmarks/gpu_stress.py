"""Where the time of a whole stress run on a GPU goes.

    python benchmarks/gpu_stress.py POLICY --warm-up --out stress.json
    python benchmarks/gpu_stress.py POLICY --device cpu --terrain flat wave --friction 0.6 1.0 --seed 0 --slots 24 --limit 60

Plays ``gaitgauge evaluate POLICY --suite robogauge-1.1 --backend mujoco-warp --device cuda`` into a temporary folder and
prints: wall time; control steps in a row; milliseconds of a control step spent in physics, in the rest of the runner's work on
the device, and on the host at looks while the device waits; start-up; and a line for every 200 control steps with the worlds at
work. With ``--device cpu`` it does on the CPU what a GPU would do (all levels at once, a look every ten control steps), for
trying out. ``--warm-up`` compiles the kernels before anything is timed, with the same ground and a few worlds.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from gaitgauge.gauge import evaluate as evaluation
from gaitgauge.gauge import lanes
from gaitgauge.gauge.episodes import Episode, Record
from gaitgauge.gauge.goals import TARGET
from gaitgauge.gauge.lanes import LaneJob
from gaitgauge.gauge.pipelines import Plan
from gaitgauge.gauge.runner import LOOK_INTERVAL, EpisodeRunner, Progress
from gaitgauge.policy.base import Policy

LINE_STEPS = 200


class OutOfTimeError(RuntimeError):
    """The run was stopped at its limit."""


class Stopwatch:
    """Adds up the time between marks: on the device's own clock, without waiting for it, or on the CPU's."""

    def __init__(self, device: torch.device) -> None:
        self._on_gpu = device.type == "cuda"
        self._pairs: list[tuple[Any, Any]] = []
        self.seconds = 0.0

    def mark(self) -> Any:
        """The present moment, in the order of the device's work."""
        if not self._on_gpu:
            return perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def add(self, begin: Any) -> None:
        """Add the time since a mark."""
        self._pairs.append((begin, self.mark()))

    def total(self) -> float:
        """Seconds so far; everything before must have happened."""
        for begin, end in self._pairs:
            self.seconds += begin.elapsed_time(end) * 1e-3 if self._on_gpu else end - begin
        self._pairs.clear()
        return self.seconds


@dataclass
class Account:
    """What was measured."""

    started: float = 0.0
    """When the worlds were ready."""
    runner: EpisodeRunner | None = None
    watches: dict[str, Stopwatch] = field(default_factory=dict)
    host: dict[str, float] = field(default_factory=dict)
    """Seconds of the host's clock in parts of the loop."""
    looks: int = 0
    lines: list[dict[str, float]] = field(default_factory=list)


def timed(account: Account, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with the host's time in it added to the account."""

    def call(*arguments: Any, **options: Any) -> Any:
        began = perf_counter()
        try:
            return function(*arguments, **options)
        finally:
            account.host[name] = account.host.get(name, 0.0) + perf_counter() - began

    return call


def instrument(account: Account, runner: EpisodeRunner, limit: float) -> None:
    """Make a runner tell where its time goes."""
    slots, device = runner._slots, runner.backend.device
    names = ("physics", "limp", "block")
    account.watches = {name: Stopwatch(device) for name in names}
    step, advance = runner.backend.step, slots.advance

    def timed_step(*arguments: Any, **options: Any) -> None:
        watch = account.watches["limp" if options.get("substeps") == 1 else "physics"]
        begin = watch.mark()
        step(*arguments, **options)
        watch.add(begin)

    def timed_advance(steps: int) -> None:
        begin = account.watches["block"].mark()
        advance(steps)
        account.watches["block"].add(begin)

    look = timed(account, "waiting for the device", slots.look)

    def counted_look() -> Any:
        found = look()
        account.looks += 1
        if runner.control_steps // LINE_STEPS != (runner.control_steps - runner._look_interval) // LINE_STEPS:
            line(account, len(slots._taken))
        if perf_counter() - account.started > limit:
            raise OutOfTimeError
        return found

    runner.backend.step = timed_step  # type: ignore[method-assign]
    slots.advance = timed(account, "launching", timed_advance)  # type: ignore[method-assign]
    slots.look = counted_look  # type: ignore[method-assign]
    for name, part in (("collecting", "_look"), ("filing", "_report"), ("seating", "_fill")):
        setattr(runner, part, timed(account, name, getattr(runner, part)))
    account.runner, account.started = runner, perf_counter()


def line(account: Account, taken: int) -> None:
    """Print how the run is, and keep it."""
    assert account.runner is not None
    physics = account.watches["physics"].total()
    before = account.lines[-1] if account.lines else {"control_steps": 0, "physics_s": 0.0}
    steps = account.runner.control_steps - before["control_steps"]
    row = {
        "control_steps": account.runner.control_steps,
        "seconds": perf_counter() - account.started,
        "worlds_at_work": taken,
        "physics_s": physics,
        "physics_ms_a_step": (physics - before["physics_s"]) / max(steps, 1) * 1e3,
    }
    account.lines.append(row)
    print(
        f"{row['control_steps']:7d} control steps, {row['seconds']:7.1f} s, {taken:5d} worlds at work, "
        f"physics {row['physics_ms_a_step']:.2f} ms a step",
        flush=True,
    )


def summary(account: Account, began: float, ended: float) -> dict[str, Any]:
    """The figures of a run that got as far as it did."""
    runner = account.runner
    if runner is None or runner.control_steps == 0:
        return {"wall_s": ended - began}
    steps, host = runner.control_steps, account.host
    physics, limp, block = (account.watches[name].total() for name in ("physics", "limp", "block"))
    # what the host does while the device has nothing to do: looking at what ended, filling the slots
    idle = host.get("collecting", 0.0) - host.get("waiting for the device", 0.0) + host.get("seating", 0.0)
    return {
        "wall_s": ended - began,
        "start_up_s": account.started - began,
        "playing_s": ended - account.started,
        "worlds": runner.backend.num_worlds,
        "control_steps": steps,
        "physics_steps": runner.physics_steps,
        "looks": account.looks,
        "ms_a_control_step": {
            "playing": (ended - account.started) / steps * 1e3,
            "physics": physics / steps * 1e3,
            "limp physics step of robots put back": limp / steps * 1e3,
            "runner on the device": (block - physics) / steps * 1e3,
            "host at looks": idle / steps * 1e3,
        },
        "share_of_wall": {
            "physics": (physics + limp) / (ended - began),
            "start_up": (account.started - began) / (ended - began),
        },
        "host_s": {name: round(seconds, 3) for name, seconds in host.items()},
        "recorded": runner._slots._recording.enabled,
        "timeline": account.lines,
    }


class Warming:
    """An agenda with one walk on the first ground."""

    def __init__(self, job: LaneJob) -> None:
        terrain, level = job.terrains[0]
        goals = tuple(goal.name for goal in job.suite.goals if goal.name != TARGET)
        walk = {"terrain": terrain, "level": level, "friction": 0.5, "payload": 0.0, "seed": 0, "stage": "eval"}
        self._waiting = [Episode(**walk, goals=goals)]  # type: ignore[arg-type]

    def take(self, most: int, *, urgent: bool = False) -> list[Episode]:
        """The walk, once."""
        taken, self._waiting = ([], self._waiting) if urgent or not most else (self._waiting, [])
        return taken

    def finished(self, record: Record) -> tuple[()]:
        """Nothing follows."""
        return ()


def compile_kernels(runner: EpisodeRunner, job: LaneJob) -> None:
    """Play the beginning of a walk."""

    def watch(progress: Progress) -> None:
        if progress.control_steps >= 2 * runner._look_interval:
            raise OutOfTimeError

    with contextlib.suppress(OutOfTimeError):
        runner.run(Warming(job), watch)
    if runner.backend.device.type == "cuda":
        torch.cuda.synchronize(runner.backend.device)
    runner.backend.close()


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """One run; returns its figures."""
    account = Account()

    def build(job: LaneJob, policy: Policy) -> EpisodeRunner:
        if arguments.slots:
            job = replace(job, slots=arguments.slots)
        if arguments.warm_up:
            begun = perf_counter()
            compile_kernels(plain(replace(job, slots=16), policy), job)
            print(f"warm-up {perf_counter() - begun:.1f} s", flush=True)
            excluded[0] += perf_counter() - begun
        runner = plain(job, policy)
        instrument(account, runner, arguments.limit)
        return runner

    plain, began, excluded = lanes.build_runner, perf_counter(), [0.0]
    lanes.EpisodeRunner = partial(  # type: ignore[misc, assignment]
        EpisodeRunner, look_interval=arguments.look_interval, capture=not arguments.no_capture
    )
    lanes.build_runner = build
    evaluation.Plan = lambda *values, **options: Plan(*values, **options | {"speculative": True})  # type: ignore[misc, assignment]
    request = evaluation.Request(
        policy=arguments.policy,
        suite=arguments.suite,
        backend=arguments.backend,
        device=arguments.device,
        terrains=tuple(arguments.terrain),
        frictions=tuple(arguments.friction),
        seeds=tuple(arguments.seed),
    )
    outcome: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        try:
            results = evaluation.evaluate(request, Path(folder) / "run")
            outcome = {"finished": True, "score": results["score"], "health": results["health"]}
        except OutOfTimeError:
            outcome = {"finished": False}
        ended = perf_counter()
    return outcome | summary(account, began + excluded[0], ended)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("--suite", default="robogauge-1.1")
    parser.add_argument("--backend", default="mujoco-warp")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--terrain", nargs="*", default=[])
    parser.add_argument("--friction", type=float, nargs="*", default=[])
    parser.add_argument("--seed", type=int, nargs="*", default=[])
    parser.add_argument("--slots", type=int, default=0, help="worlds; 0 for as many as evaluate takes")
    parser.add_argument("--look-interval", type=int, default=LOOK_INTERVAL)
    parser.add_argument("--no-capture", action="store_true", help="do not record control steps as CUDA graphs")
    parser.add_argument("--warm-up", action="store_true", help="compile the kernels before anything is timed")
    parser.add_argument("--limit", type=float, default=500.0, help="stop playing after so many seconds")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    figures = run(arguments)
    print(json.dumps({name: value for name, value in figures.items() if name != "timeline"}, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
