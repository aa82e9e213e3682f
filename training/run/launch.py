"""Carry out a plan: build the environment and the run, join its processes, train."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import torch

from ...backends.registry import find_backend
from ...files.choices import cpu_threads
from ...files.provenance import provenance, versions
from ...files.writing import LOCK, lock_folder
from ...policy.contract import PHYSICS, PolicyContract
from ...policy.finding import shipped_policies
from ..algorithms.symmetry import build_mirror
from ..configuration import ConfigurationError
from ..environment.configuration import EnvironmentConfiguration
from ..environment.environment import TrainingEnvironment
from ..processes import RUN_TOLD, Processes, ProcessLostError
from .checkpoint import CheckpointError
from .filming import Filmer
from .page import write_page
from .plan import TrainPlan
from .resuming import begin_with, resume_run
from .run_directory import new_run_directory, read_run_json, update_run_json, write_parameters
from .runner import TrainingRunner
from .scoring import Scorer
from .seeding import seed_everything
from .stopping import Progress, TrainingOutcome


def train(
    plan: TrainPlan,
    *,
    began: float,
    started: Callable[[Path], None] = lambda _: None,
    progress: Callable[[Progress], None] = lambda _: None,
    message: Callable[[str], None] = lambda _: None,
) -> tuple[TrainingOutcome, Path]:
    """Build environment, networks and run directory, and train.

    Args:
        began: value of ``time.monotonic()`` from which the wall-clock limit counts.
        started: called with the run directory before anything slow.

    Returns:
        How it ended, and the run directory.

    Raises:
        ConfigurationError, BackendError, CheckpointError, TrainingDivergedError, ProcessLostError: one sentence on what
        went wrong.
    """
    run_settings, device = plan.task.training.run, plan.device
    first = Processes.told().rank == 0
    run: Path | None = None
    seed_everything(run_settings.seed + Processes.told().rank)
    with ExitStack() as closing:
        if run_settings.torch_threads is not None:
            closing.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(run_settings.torch_threads)
        if first:
            run = _open_run(plan, closing, started, message)
        worlds = f"{plan.task.environment.num_envs} environments"
        with _enough_memory(f"{worlds} do not fit into the memory of {device}; use a smaller --num-envs"):
            env = _environment(plan, closing)
            if first and env.unfused:
                message(env.unfused)
            runner = _runner(plan, env, run, progress if first else None, message if first else None)
            closing.callback(runner.close)
        too_much = f"learning with {worlds} does not fit into the memory of {device}"
        try:
            with _enough_memory(f"{too_much}; use a smaller --num-envs, or more training.algorithm.minibatches"):
                if plan.checkpoint is not None:
                    resume_run(runner, plan.checkpoint)
                elif plan.weights is not None:
                    begin_with(runner, plan.weights)
                if run is not None:  # a run that anything above refuses is left as it was
                    _describe(plan, run, env, began)
                limit = plan.request.seconds
                seconds = None if limit is None else max(limit - (time.monotonic() - began), 0.0)
                outcome = runner.learn(
                    run_settings.iterations - runner.iteration, max_seconds=seconds, fit=plan.request.fit
                )
            if run is not None and plan.request.film and outcome.reason != "signal":
                page = write_page(run, scores=plan.suite, scalars=runner.logger.scalars)
                message(f"Page: {page}")
        except ProcessLostError:
            closing.pop_all()  # closing would wait for the lost process
            raise
        runner.processes.leave()
    assert runner.log_dir is not None
    return outcome, runner.log_dir


def _open_run(
    plan: TrainPlan, closing: ExitStack, started: Callable[[Path], None], message: Callable[[str], None]
) -> Path:
    """Return the locked run directory, after the first messages; one in which nothing is written is removed at the end."""
    settings = plan.task.training.run
    run = plan.run or new_run_directory(plan.request.log_root, settings.experiment, settings.run_name)
    closing.callback(_remove_unused, run)
    if Processes.told().several and (told := os.environ.get(RUN_TOLD)):
        Path(told).write_text(str(run))
    started(run)
    if plan.notice:
        message(plan.notice)
    closing.callback(lock_folder(run, CheckpointError).release)
    return run


def _environment(plan: TrainPlan, closing: ExitStack) -> TrainingEnvironment:
    request, settings = plan.request, plan.task.environment
    env = TrainingEnvironment(
        replace(settings, seed=settings.seed + Processes.told().rank),
        backend=plan.backend,
        device=plan.device,
        threads=cpu_threads(request.threads),
        capture=plan.device.startswith("cuda") if request.capture is None else request.capture,
        fuse=request.fuse,
        progress=plan.progress,
    )
    closing.callback(env.close)
    return env


def _runner(
    plan: TrainPlan,
    env: TrainingEnvironment,
    run: Path | None,
    progress: Callable[[Progress], None] | None,
    message: Callable[[str], None] | None,
) -> TrainingRunner:
    """Join the other processes and build the run; ``run`` is the run directory in the first process, None in the others."""
    request, task = plan.request, plan.task
    processes = Processes.join(plan.device)
    scorer = filmer = None
    if run is not None and plan.suite is not None:
        scorer = Scorer(run, suite=plan.suite, threads=request.score_threads)
    if run is not None and (request.film or task.training.run.video_interval > 0):
        stairs = any(tile.name.startswith("stairs") for tile in task.environment.terrain.tiles)
        filmer = Filmer(
            run,
            terrains=("flat", "stairs_fd") if stairs else ("flat",),
            command=_straight(env.contract),
            every=task.training.run.video_interval > 0,
            last=request.film,
        )

    def physics(environment: EnvironmentConfiguration) -> dict[str, Any]:
        return _physics(plan, environment, scored=scorer is not None)

    contract = replace(env.contract, provenance={**env.contract.provenance, PHYSICS: physics(env.configuration)})
    mirror = None
    if task.training.algorithm.symmetry != "none":
        mirror = build_mirror(task.environment.observations, contract=env.contract, robot=env.robot)
    return TrainingRunner(
        env,
        task.training,
        contract=contract,
        task=task.name,
        log_dir=Path(processes.firsts(str(run))),
        device=plan.device,
        processes=processes,
        mirror=mirror,
        scorer=scorer,
        filmer=filmer,
        settings=plan.settings,
        progress=progress,
        physics=physics,
        message=message,
    )


def _straight(contract: PolicyContract) -> tuple[float, float, float] | None:
    """Return the command that a film of a robot that learned to walk straight ahead shows; None for other robots."""
    forward, lateral, yaw = contract.command_limits
    return None if lateral or yaw else (0.75 * forward, 0.0, 0.0)


def _physics(plan: TrainPlan, environment: EnvironmentConfiguration, *, scored: bool) -> dict[str, Any]:
    """Return the physics of a run for the provenance of its policies: the engine that trains them, and the one that scores them."""
    known = versions()
    physics, engine = environment.physics, find_backend(plan.backend, plan.device)
    settings = {name: getattr(physics, name) for name in ("timestep", "substeps", "foot_condim", "self_collision")}
    low, high = environment.randomization.foot_torsion
    settings |= {**engine.solver_settings(physics), "foot_torsion": f"{low:g} to {high:g} times the model's"}
    learned = {"engine": plan.backend, "version": known.get(plan.backend.partition(":")[0]), "settings": settings}
    judge = {"engine": "mujoco", "version": known["mujoco"], "settings": {"suite": str(plan.suite)}}
    return {"trained": [learned], "tuned": [judge] if scored else []}


@contextmanager
def _enough_memory(otherwise: str) -> Iterator[None]:
    """Turn a lack of memory, of the device or of the machine, into one sentence."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, torch.OutOfMemoryError | MemoryError) or "can't allocate memory" in str(error):
            raise ConfigurationError(otherwise) from error
        raise


def _remove_unused(run: Path) -> None:
    """Remove a run directory in which nothing but the lock was written."""
    if run.is_dir() and {path.name for path in run.iterdir()} <= {LOCK}:
        shutil.rmtree(run, ignore_errors=True)


def _describe(plan: TrainPlan, run: Path, env: TrainingEnvironment, began: float) -> None:
    """Write the run's parameters and ``run.json``; a resume is noted there. ``began`` is ``time.monotonic()`` of the command's start."""
    task = plan.task
    start = datetime.now().astimezone() - timedelta(seconds=time.monotonic() - began)
    write_parameters(run, environment=task.environment, agent=task.training)
    description = {
        "task": task.name,
        "backend": plan.backend,
        "num_envs": task.environment.num_envs,
        "seed": task.training.run.seed,
        "began": start.isoformat(timespec="seconds"),
        "started": f"{datetime.now().astimezone():%Y-%m-%dT%H:%M:%S%z}",
        "contract_hash": env.contract.hash,
        **provenance(command=sys.argv, device=plan.device),
        "settings": plan.settings,
    }
    if earlier := read_run_json(run):
        checkpoint = plan.checkpoint.name if plan.checkpoint else ""
        note = {"started": description["started"], "checkpoint": checkpoint, "command": description["command"]}
        description = {k: v for k, v in description.items() if k not in ("began", "started", "date", "command")}
        update_run_json(run, description | {"resumed": [*earlier.get("resumed", []), note]})
        return
    shipped = plan.request.init_from in shipped_policies()  # known by its name wherever it is installed
    begun_with = plan.checkpoint or (plan.request.init_from if shipped else plan.weights)
    update_run_json(run, description | {"begun_with": str(begun_with) if begun_with else None})
