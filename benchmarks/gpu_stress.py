"""Where the time of a whole stress run on a GPU goes.

    python benchmarks/gpu_stress.py POLICY --warm-up --out stress.json
    python benchmarks/gpu_stress.py POLICY --device cpu --terrain flat wave --friction 0.6 1.0 --seed 0 --worlds 24 --limit 60

Plays ``gaitgauge evaluate POLICY --suite robogauge-1.1 --backend mujoco-warp --device cuda`` into a temporary folder and
prints: wall time; control steps in a row; milliseconds of a control step spent in physics, in the rest of the rollout's work on
the device, and on the host at polls while the device waits; start-up; and a line for every 200 control steps with the worlds at
work. With ``--device cpu`` it does on the CPU what a GPU would do (all levels at once, a poll every ten control steps), for
trying out. ``--warm-up`` compiles the kernels before anything is timed, with the same ground and a few worlds.
"""

from __future__ import annotations

import argparse
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
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.goals import TARGET
from gaitgauge.gauge.play import workers
from gaitgauge.gauge.play.rollout import POLL_INTERVAL, Rollout
from gaitgauge.gauge.play.workers import Job

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
    rollout: Rollout | None = None
    watches: dict[str, Stopwatch] = field(default_factory=dict)
    host: dict[str, float] = field(default_factory=dict)
    """Seconds of the host's clock in parts of the loop."""
    polls: int = 0
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


def instrument(account: Account, rollout: Rollout, limit: float) -> None:
    """Make a rollout tell where its time goes."""
    device = rollout.backend.device
    account.watches = {name: Stopwatch(device) for name in ("physics", "limp", "block")}
    step, launch, poll = rollout.backend.step, rollout.launch, rollout.poll

    def timed_step(*arguments: Any, **options: Any) -> None:
        watch = account.watches["limp" if options.get("substeps") == 1 else "physics"]
        begin = watch.mark()
        step(*arguments, **options)
        watch.add(begin)

    def timed_launch() -> None:
        begin = account.watches["block"].mark()
        launch()
        account.watches["block"].add(begin)

    def counted_poll() -> Any:
        if device.type == "cuda":
            began = perf_counter()
            torch.cuda.synchronize(device)
            waited = account.host.get("waiting for the device", 0.0) + perf_counter() - began
            account.host["waiting for the device"] = waited
        records = poll()
        account.polls += 1
        if (
            rollout.control_steps
            and rollout.control_steps // LINE_STEPS != (rollout.control_steps - rollout.poll_interval) // LINE_STEPS
        ):
            line(account, rollout.backend.num_worlds - rollout.free_worlds)
        if perf_counter() - account.started > limit:
            raise OutOfTimeError
        return records

    rollout.backend.step = timed_step  # type: ignore[method-assign]
    rollout.launch = timed(account, "launching", timed_launch)  # type: ignore[method-assign]
    rollout.poll = timed(account, "polling", counted_poll)  # type: ignore[method-assign]
    rollout.begin = timed(account, "beginning segments", rollout.begin)  # type: ignore[method-assign]
    account.rollout, account.started = rollout, perf_counter()


def line(account: Account, taken: int) -> None:
    """Print how the run is, and keep it."""
    assert account.rollout is not None
    physics = account.watches["physics"].total()
    before = account.lines[-1] if account.lines else {"control_steps": 0, "physics_s": 0.0}
    steps = account.rollout.control_steps - before["control_steps"]
    row = {
        "control_steps": account.rollout.control_steps,
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
    rollout = account.rollout
    if rollout is None or rollout.control_steps == 0:
        return {"wall_s": ended - began}
    steps, host = rollout.control_steps, account.host
    physics, limp, block = (account.watches[name].total() for name in ("physics", "limp", "block"))
    # what the host does while the device has nothing to do: seeing what ended, filling the worlds
    idle = host.get("polling", 0.0) - host.get("waiting for the device", 0.0) + host.get("beginning segments", 0.0)
    return {
        "wall_s": ended - began,
        "start_up_s": account.started - began,
        "playing_s": ended - account.started,
        "worlds": rollout.backend.num_worlds,
        "control_steps": steps,
        "physics_steps": rollout.physics_steps,
        "polls": account.polls,
        "ms_a_control_step": {
            "playing": (ended - account.started) / steps * 1e3,
            "physics": physics / steps * 1e3,
            "limp physics step of robots put back": limp / steps * 1e3,
            "rollout on the device": (block - physics) / steps * 1e3,
            "host at polls": idle / steps * 1e3,
        },
        "share_of_wall": {
            "physics": (physics + limp) / (ended - began),
            "start_up": (account.started - began) / (ended - began),
        },
        "host_s": {name: round(seconds, 3) for name, seconds in host.items()},
        "captured": rollout.captured,
        "timeline": account.lines,
    }


def compile_kernels(rollout: Rollout, job: Job) -> None:
    """Play the beginning of a walk on the first ground."""
    terrain, level = job.places[0]
    goals = tuple(goal.name for goal in job.suite.goals if goal.name != TARGET)
    walk = Episode(terrain=terrain, level=level, friction=0.5, payload=0.0, seed=0, stage="eval", goals=goals)
    rollout.play([walk])
    for _ in range(2):
        rollout.advance()
    if rollout.backend.device.type == "cuda":
        torch.cuda.synchronize(rollout.backend.device)
    rollout.backend.close()


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """One run; returns its figures."""
    account = Account()

    def build(job: Job) -> Rollout:
        if arguments.worlds:
            job = replace(job, worlds=arguments.worlds)
        if arguments.warm_up:
            begun = perf_counter()
            compile_kernels(plain(replace(job, worlds=16)), job)
            print(f"warm-up {perf_counter() - begun:.1f} s", flush=True)
            excluded[0] += perf_counter() - begun
        rollout = plain(job)
        instrument(account, rollout, arguments.limit)
        return rollout

    plain, began, excluded = workers.Job.rollout, perf_counter(), [0.0]
    workers.Rollout = partial(  # type: ignore[misc, assignment]
        Rollout, poll_interval=arguments.poll_interval, capture=not arguments.no_capture
    )
    workers.Job.rollout = build  # type: ignore[method-assign]
    speculation = evaluation.GPU_SPECULATION
    at_once = replace(speculation, at_work=arguments.worlds or speculation.at_work)
    evaluation.GPU_SPECULATION = at_once
    evaluation.Speculation = lambda **options: at_once  # type: ignore[misc, assignment]
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
            result = evaluation.evaluate(request, Path(folder) / "run")
            outcome = {"finished": True, "score": result.score, "health": result.health.to_data()}
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
    parser.add_argument("--worlds", type=int, default=0, help="worlds; 0 for as many as evaluate takes")
    parser.add_argument("--poll-interval", type=int, default=POLL_INTERVAL)
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
