"""One evaluation from request to results: builds the worlds, plays the plan, keeps every episode, writes ``results.json``."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from ..backends.mujoco import MujocoBackend
from ..backends.registry import find_backend
from ..policy.base import Policy
from ..policy.contract import check_robot
from ..policy.loading import find_policy, load_policy
from ..robots import Robot, RobotError, load_robot
from ..terrains.registry import make_terrain, terrain_names
from .episodes import Episode
from .goals import SUB_COMMANDS, TARGET, check_terrain
from .lanes import LaneJob, play, play_in_lanes
from .pipelines import PIPELINES, Environment, Plan, make_environments
from .results import fold, health, rows_csv
from .runner import Progress
from .store import RunFolder, write_atomically
from .suite import Goal, Suite, SuiteError, load_suite

PACKAGES = ("gaitgauge", "mujoco", "mujoco-warp", "newton", "warp-lang", "torch", "numpy", "rsl-rl-lib")
_SLOTS = 24
"""Worlds of a process on the CPU: more share the loop's cost, fewer keep more processes busy to the end."""
_GPU_SLOTS = 4096
"""Largest number of worlds on a GPU."""
_WATCH_INTERVAL = 0.2
"""Time between two looks at how far a run is [s]."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is to be evaluated, and how. Empty tuples and None stand for the suite's own choice."""

    policy: str
    suite: str = "gaitgauge-1"
    pipeline: str = "stress"
    backend: str = "mujoco"
    device: str = "cpu"
    robot: str = "go2"
    terrains: tuple[str, ...] = ()
    level: int | None = None
    frictions: tuple[float, ...] = ()
    payloads: tuple[float, ...] = ()
    seeds: tuple[int, ...] = ()
    threads: int = 1
    """CPU threads; they change the time, never the results."""
    trust: bool = False
    """Run the program that a policy file of the project's own format carries inside."""


@dataclass
class Status:
    """How far an evaluation is, for the progress display."""

    done: int
    """Episodes that have ended, those of an earlier run included."""
    known: int
    """Episodes known to be needed so far; level searches add more."""
    expected: int
    """Episodes expected in all, searches that are still open estimated."""
    active: tuple[Episode, ...]
    physics_steps: int
    seconds: float
    remaining_work: float
    """Estimated share of the work that is left, 0 to 1."""


def prepare(request: Request) -> tuple[Suite, Robot, Policy, list[Environment], list[int]]:
    """Check a request and load what it names.

    Raises:
        SuiteError, RobotError, TerrainError, PolicyError, ContractError, BackendError: one sentence on what is wrong.
    """
    suite = load_suite(request.suite)
    robot = load_robot(request.robot)
    if suite.parameters not in robot.parameters:
        raise RobotError(
            f"suite '{suite.name}' needs the joint parameters '{suite.parameters}', which robot '{robot.name}' lacks; "
            f"it has {', '.join(sorted(robot.parameters))} (robot.toml)"
        )
    find_backend(request.backend, request.device)
    terrains, level = _terrains(request, suite), request.level
    for friction in request.frictions:
        if not 0.0 < friction <= 10.0:
            raise SuiteError(
                f"friction {friction:g} is not possible; give a coefficient above 0 and at most 10 (--friction)"
            )
    for payload in request.payloads:
        if not -5.0 <= payload <= 50.0:
            raise SuiteError(f"payload {payload:g} kg is not possible; give -5 to 50 kg (--payload)")
    for seed in request.seeds:
        if seed < 0:
            raise SuiteError(f"seed {seed} is not possible; give a whole number of at least 0 (--seed)")
    frictions, payloads, seeds = request.frictions, request.payloads, request.seeds or suite.matrix.seeds
    if request.pipeline == "base":
        frictions = frictions or (suite.matrix.nominal_friction,)
        payloads = payloads or (suite.matrix.nominal_payload,)
        seeds = seeds[:1]
        if len(terrains) * len(frictions) * len(payloads) != 1:
            raise SuiteError(
                "pipeline 'base' plays one environment; give one --terrain, --friction and --payload, or use multi"
            )
    environments = make_environments(
        suite, terrains=terrains, frictions=frictions or None, payloads=payloads or None, level=level
    )
    for name, environment in {e.terrain: e for e in environments}.items():
        level = suite.scoring.levels if environment.searched else environment.level
        check_terrain(suite, make_terrain(name, level), searched=environment.searched)
    policy = load_policy(request.policy, robot, trust=request.trust)
    check_robot(policy.contract, robot)
    if abs(policy.contract.control_period - suite.physics.control_period) > 1e-9:
        raise SuiteError(
            f"the policy was made for a control period of {policy.contract.control_period:g} s, suite '{suite.name}' runs "
            f"{suite.physics.control_period:g} s; use a policy of that period"
        )
    return suite, robot, policy, environments, list(dict.fromkeys(seeds))


def _terrains(request: Request, suite: Suite) -> list[str]:
    """The terrains of a request, in the suite's order."""
    if request.pipeline not in PIPELINES:
        raise SuiteError(f"there is no pipeline '{request.pipeline}'; choose one of {', '.join(PIPELINES)}")
    for name in request.terrains:
        if name not in terrain_names():
            make_terrain(name)  # raises with the nearest names
    order = list(suite.matrix.terrains)
    chosen = sorted(set(request.terrains), key=lambda t: (order.index(t) if t in order else len(order), t))
    if request.pipeline in ("base", "multi"):
        chosen = chosen or ["flat"]
    if request.level is not None and chosen and all(t == "flat" for t in chosen):
        raise SuiteError(f"terrain 'flat' has no levels, so --level {request.level} means nothing; leave it out")
    if request.pipeline in ("base", "multi"):
        if request.level is None and any(t != "flat" for t in chosen):
            raise SuiteError(
                f"pipeline '{request.pipeline}' plays one level of terrain '{chosen[-1]}'; say which with --level"
            )
        return chosen
    chosen = chosen or order
    if request.pipeline == "level":
        if request.level is not None:
            raise SuiteError("pipeline 'level' searches the level; leave --level out, or use pipeline 'multi'")
        chosen = [t for t in chosen if t != "flat"]
        if not chosen:
            raise SuiteError("terrain 'flat' has no levels to search; choose another --terrain, or pipeline 'multi'")
    return chosen


def identity(request: Request, suite: Suite, policy: Policy, environments: list[Environment], seeds: list[int]) -> dict:
    """What decides about the results: a folder that holds another run is refused."""
    return {
        "suite": f"{suite.name} {suite.version}",
        "suite_digest": suite.digest,
        "policy": policy.contract.hash,
        "policy_file": policy_digest(request.policy),
        "pipeline": request.pipeline,
        "backend": request.backend,
        "device": torch.device(request.device).type,
        "robot": request.robot,
        "level": request.level,
        "environments": [e.key for e in environments],
        "seeds": seeds,
        "noise": "by segment",  # runs begun before episodes fell into segments drew theirs otherwise
    }


def policy_digest(name: str) -> str:
    """SHA-256 of a policy's file, hexadecimal."""
    return hashlib.sha256(find_policy(name).read_bytes()).hexdigest()


def evaluate(
    request: Request,
    folder: Path,
    *,
    resume: bool = False,
    command: Sequence[str] = (),
    watch: Callable[[Status], None] | None = None,
) -> dict[str, Any]:
    """Evaluate a policy; every finished episode is on disk at once, so that nothing is lost when the process is killed.

    Args:
        request: what to do.
        folder: where ``results.json``, ``episodes.csv``, ``report.html`` and ``episodes/`` go.
        resume: go on with what the folder holds.
        command: the command line, for the provenance.
        watch: called a few times a second, between control steps.

    Returns:
        The content of ``results.json``.

    Raises:
        SuiteError, RobotError, TerrainError, PolicyError, ContractError, BackendError, StoreError: one sentence.
    """
    began = time.perf_counter()
    suite, robot, policy, environments, seeds = prepare(request)
    store = RunFolder(folder, identity(request, suite, policy, environments, seeds), resume=resume)
    on_cpu = torch.device(request.device).type == "cpu"
    if on_cpu:
        torch.set_num_threads(1)  # several would change the last bits of the policy's output
    evaluated = request.pipeline != "level"
    columns: tuple[str, ...] = (*suite.metrics.weights, "quality")
    # A GPU plays every level of every search at once: a few long batches instead of many short ones.
    plan = Plan(suite, environments, seeds, store, evaluate=evaluated, speculative=not on_cpu)
    job, lanes = _job(request, suite, robot, policy, plan)
    on_step = _watcher(plan, watch, began)
    effort = play(job, policy, plan, on_step) if lanes == 1 else play_in_lanes(job, plan, lanes, on_step)
    results = fold(suite, environments, columns, evaluated=evaluated)
    results["policy"] = {
        "path": policy.path,
        "contract_hash": policy.contract.hash,
        "file_sha256": policy_digest(request.policy),
        "provenance": dict(policy.contract.provenance),
    }
    results["pipeline"] = request.pipeline
    results["backend"] = request.backend
    results["robot"] = robot.name
    results["health"] = dict(health(environments))
    results["solver"] = dict(find_backend(request.backend, request.device).solver_settings(suite.physics))
    provenance = _provenance(request, command, time.perf_counter() - began, effort.physics_steps)
    results["provenance"] = provenance | {"processes": lanes}
    if effort.engine_seconds is not None:
        results["provenance"]["engine_seconds"] = round(effort.engine_seconds, 2)
    write_atomically(folder / "episodes.csv", rows_csv([r for e in environments for r in (*e.trials, *e.records)]))
    write_atomically(folder / "results.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
    return results


def _job(request: Request, suite: Suite, robot: Robot, policy: Policy, plan: Plan) -> tuple[LaneJob, int]:
    """What to play with, and in how many processes."""
    keys = [
        (e.terrain, level)
        for e in plan.environments
        for level in ([e.level] if e.level is not None else range(1, suite.scoring.levels + 1))
        if level > 0 or e.terrain == "flat"
    ]
    keys = list(dict.fromkeys(keys)) or [("flat", 0)]
    parts = sum(len(SUB_COMMANDS[g.name]) for g in suite.goals if g.name != TARGET)
    lanes = 1
    tests, quality = plan.waiting
    if torch.device(request.device).type == "cpu":
        at_once = max(len(plan.seeds) * parts, len(suite.matrix.search_seeds))
        slots = min(len(plan.environments) * at_once, _SLOTS)
        if request.backend == MujocoBackend.name and os.name == "posix":
            lanes = max(min(request.threads, tests + quality), 1)
    else:
        slots = min(max(tests + quality * parts, 1), _GPU_SLOTS)
    job = LaneJob(
        policy=policy.path,
        trust=request.trust,
        suite=suite,
        robot=robot,
        backend=request.backend,
        device=request.device,
        terrains=tuple(keys),
        slots=slots,
        threads=max(request.threads // lanes, 1),
    )
    return job, lanes


def _watcher(plan: Plan, watch: Callable[[Status], None] | None, began: float) -> Callable[[Progress], None] | None:
    if watch is None:
        return None
    suite = plan.suite
    goals: dict[str, Goal] = {g.name: g for g in suite.goals}
    seconds: dict[str, float] = {
        name: sum(goal.phases) * len(SUB_COMMANDS[name]) or 0.4 * max(suite.commands.target_time.values(), default=25.0)
        for name, goal in goals.items()
    }

    next_time = began

    def on_step(progress: Progress) -> None:
        nonlocal next_time
        if time.perf_counter() < next_time:
            return
        left = plan.expected_left()
        total = plan.done + left
        expected = round(total)
        active = progress.active()
        for episode, age in active.items():
            usual = sum(seconds[g] for g in episode.goals) / suite.physics.control_period
            left -= min(age / usual, 0.95)
        watch(
            Status(
                done=plan.done,
                known=plan.total_known,
                expected=expected,
                active=tuple(active),
                physics_steps=progress.physics_steps,
                seconds=time.perf_counter() - began,
                remaining_work=max(left, 0.0) / total if total else 0.0,
            )
        )
        next_time = time.perf_counter() + _WATCH_INTERVAL

    return on_step


def _provenance(request: Request, command: Sequence[str], seconds: float, physics_steps: int) -> dict[str, Any]:
    """Where a result comes from."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "versions": versions,
        "command": " ".join(command),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "machine": f"{platform.machine()}, {os.cpu_count()} CPUs, {platform.system()} {platform.release()}",
        "device": _device_name(request.device),
        "threads": request.threads,
        "seconds": round(seconds, 2),
        "physics_steps": physics_steps,
    }


def _device_name(device: str) -> str:
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    return device
