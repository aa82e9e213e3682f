"""From a request to a training run: checks everything first, builds the parts, joins them, runs."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from ..backends.registry import find_backend, list_backends
from ..gauge.suite import load_suite
from ..policy.loading import find_policy
from .algorithms.symmetry import build_mirror
from .checkpoint import CheckpointError, reached, read_checkpoint
from .configuration import ConfigurationError
from .environment import TrainingEnvironment
from .gauging import gauge_scorer
from .run_directory import (
    LOG_ROOT,
    describe_run,
    find_checkpoint,
    new_run_directory,
    read_run_json,
    update_run_json,
    write_parameters,
)
from .runner import TrainingRunner
from .scoring import Scorer
from .seeding import seed_everything
from .stopping import Progress, TrainingOutcome
from .tasks import Task, find_task

DEFAULT_BACKEND = "mujoco-warp"
QUICK_SUITE = "quick"
_HORIZON = "environment.schedule.horizon_steps"
_WAIT = "training.run.gauge_wait"
_GOING_ON_RATE, _GOING_ON_KL, _GOING_ON_STD = 3e-4, 0.006, 0.3
"""First learning rate, wanted change of the policy in an update, and exploration noise of a run that begins with trained networks."""


@dataclass(frozen=True, kw_only=True)
class TrainRequest:
    """What is to be trained. None stands for the resumed run's choice, or else for the task's."""

    task: str
    overrides: Sequence[str] = ()
    """``environment.…=value`` and ``training.…=value``."""
    backend: str | None = None
    """Physics engine; None for mujoco-warp."""
    device: str | None = None
    """None for the GPU if the engine is made for one, else the CPU."""
    threads: int = 1
    """CPU threads of engines that use them."""
    num_envs: int | None = None
    """Worlds, in each process of a run on several GPUs."""
    seed: int | None = None
    iterations: int | None = None
    """Of the whole run, what a resumed run has done before included."""
    seconds: float | None = None
    """Wall-clock limit [s] since ``began``."""
    resume: str | None = None
    """``latest``, a run directory or a checkpoint to continue."""
    init_from: str | None = None
    """Checkpoint or policy whose networks a new run begins with."""
    run_name: str | None = None
    log_root: Path = LOG_ROOT
    capture: bool | None = None
    """CUDA graphs in the environment; None: on a GPU."""
    fuse: bool = False
    """Compile the environment's torch parts."""
    score_suite: str | None = QUICK_SUITE
    """Suite that scores checkpoints in a side process, None for no scores."""
    score_every: int | None = None
    """Iterations between two scores."""
    score_threads: int | None = None
    """CPU threads of the side process, None for half of the machine."""


@dataclass(frozen=True, kw_only=True)
class TrainPlan:
    """A checked request."""

    request: TrainRequest
    task: Task
    backend: str
    device: str
    checkpoint: Path | None
    """What is continued, None for a new run."""
    run: Path | None
    """Run directory that is continued, None to make a new one."""
    settings: Mapping[str, Any]
    """What a later resume needs to build the same run: backend and overrides, kept in every checkpoint."""


def prepare(request: TrainRequest) -> TrainPlan:
    """Check a request; nothing is built or written.

    Raises:
        TaskError, ConfigurationError, BackendError, SuiteError, CheckpointError: one sentence on what is wrong.
    """
    if request.resume is not None and request.init_from is not None:
        raise ConfigurationError(
            "--resume continues a run and --init-from begins a new one with its networks; give one of them"
        )
    own = _own_overrides(request)
    task = find_task(request.task, own)
    stored: Mapping[str, Any] = {}
    checkpoint, run, training = None, None, None
    if request.resume is not None:
        checkpoint = find_checkpoint(
            request.resume, experiment=task.training.run.experiment, root=request.log_root
        ).absolute()
        training = read_checkpoint(checkpoint)["training"]
        if training["task"] != request.task:
            raise CheckpointError(
                f"Cannot resume from '{checkpoint}': it is of task '{training['task']}', this run trains "
                f"'{request.task}'; write gaitgauge train {training['task']}."
            )
        stored = training.get("settings", {})
        # A checkpoint carried here without its run directory continues in a new one.
        run = checkpoint.parent if read_run_json(checkpoint.parent).get("task") == request.task else None
        own = [
            *stored.get("overrides", ()),
            f"environment.num_envs={training['num_envs']}",
            *([f"{_HORIZON}={stored['horizon_steps']}"] if "horizon_steps" in stored else []),
            *own,
        ]
        own = _last_of_each(own)
    elif request.init_from is not None:
        own = [*_going_on(task, read_checkpoint(_first_weights(request, task), training_state=False)), *own]
    backend = request.backend or stored.get("backend", DEFAULT_BACKEND)
    if request.seconds is not None:
        # The limit is for the whole command: by default nothing is waited for beyond it.
        task = find_task(request.task, [f"{_WAIT}=0", *own])
    else:
        task = find_task(request.task, own)
    if training is not None and task.environment.num_envs != training["num_envs"]:
        raise CheckpointError(
            f"Cannot resume from '{checkpoint}': it has {training['num_envs']} environments, this run "
            f"{task.environment.num_envs}; leave --num-envs out, or begin a new run with --init-from."
        )
    if request.score_suite is None:
        task = replace(task, training=replace(task.training, run=replace(task.training.run, gauge_interval=0)))
    else:
        load_suite(request.score_suite)
    device = _device(request.device, backend)
    find_backend(backend, device)
    if request.capture and not device.startswith("cuda"):
        raise ConfigurationError(f"--capture replays CUDA graphs and the device is '{device}'; leave it out")
    settings = {
        "backend": backend,
        "overrides": own,
        "horizon_steps": task.environment.schedule.horizon_steps,
    }
    return TrainPlan(
        request=request, task=task, backend=backend, device=device, checkpoint=checkpoint, run=run, settings=settings
    )


def _going_on(task: Task, entries: Mapping[str, Any]) -> list[str]:
    """Settings of a run that begins with trained networks, before those of the request: schedules go on where that
    training left them, robots that can walk start on all levels, steps are smaller, and a policy without its
    exploration noise gets little.
    """
    return [
        f"environment.schedule.begin={reached(entries):g}",
        f"environment.terrain.highest_start_level={task.environment.terrain.levels - 1}",
        f"training.algorithm.desired_kl={_GOING_ON_KL}",
        f"training.algorithm.learning_rate={_GOING_ON_RATE}",
        f"training.network.initial_std={_GOING_ON_STD}",
    ]


def _first_weights(request: TrainRequest, task: Task) -> Path:
    """The file whose networks a new run begins with: what ``--resume`` takes, or the policy that ships with the
    project.

    Raises:
        CheckpointError: there is none.
    """
    assert request.init_from is not None
    if request.init_from == "pretrained":
        return find_policy(request.init_from)
    return find_checkpoint(request.init_from, experiment=task.training.run.experiment, root=request.log_root)


def _own_overrides(request: TrainRequest) -> list[str]:
    """The request's options and settings as overrides, options first, so that a setting spelled out wins."""
    options: list[tuple[str, Any]] = [
        ("environment.num_envs", request.num_envs),
        ("environment.seed", request.seed),
        ("training.run.seed", request.seed),
        ("training.run.iterations", request.iterations),
        ("training.run.run_name", request.run_name),
        ("training.run.gauge_interval", request.score_every),
    ]
    return [f"{key}={value}" for key, value in options if value is not None] + list(request.overrides)


def _last_of_each(overrides: Sequence[str]) -> list[str]:
    """Overrides without those that a later one of the same key replaces."""
    return list({override.partition("=")[0].strip(): override for override in overrides}.values())


def _device(asked: str | None, backend: str) -> str:
    """The torch device of this process.

    Raises:
        ConfigurationError: there is no such device here.
    """
    engine = backend.partition(":")[0]
    gpu_engine = any(each.name == engine and each.device == "GPU" for each in list_backends())
    if asked is None:
        if gpu_engine and not torch.cuda.is_available():
            raise ConfigurationError(
                f"backend '{backend}' wants a GPU and this machine has none; add --device cpu (slow), or use "
                "--backend mujoco"
            )
        asked = "cuda" if gpu_engine else "cpu"
    if asked != "cpu" and not torch.cuda.is_available():
        raise ConfigurationError(
            f"device '{asked}' was asked for and this machine has no CUDA device; use --device cpu"
        )
    # rsl_rl wants each process of a run on several GPUs to name its own.
    return f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if asked == "cuda" else asked


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
        plan: what ``prepare`` made.
        began: value of ``time.monotonic()`` from which the wall-clock limit counts.
        started: called with the run directory before anything slow.
        progress: called after every iteration.
        message: called with a sentence now and then.

    Returns:
        How it ended, and the run directory.

    Raises:
        ConfigurationError, BackendError, CheckpointError, TrainingDivergedError: one sentence on what went wrong.
    """
    request, task, device = plan.request, plan.task, plan.device
    rank = int(os.environ.get("RANK", "0"))
    run_settings = task.training.run
    run: Path | None = None
    if rank == 0:
        run = plan.run or new_run_directory(request.log_root, run_settings.experiment, run_settings.run_name)
        started(run)
    seed_everything(run_settings.seed + rank)
    environment = replace(task.environment, seed=task.environment.seed + rank)
    try:
        env = TrainingEnvironment(
            environment,
            backend=plan.backend,
            device=device,
            threads=request.threads,
            capture=device.startswith("cuda") if request.capture is None else request.capture,
            fuse=request.fuse,
        )
        if run is not None:
            _describe(plan, run, env)
        symmetric = task.training.algorithm.symmetry != "none"
        scorer: Scorer | None = None
        if request.score_suite is not None and run_settings.gauge_interval > 0 and run is not None:
            scorer = gauge_scorer(run, suite=request.score_suite, threads=request.score_threads)
        runner = TrainingRunner(
            env,
            task.training,
            contract=env.contract,
            task=task.name,
            log_dir=run,
            device=device,
            mirror=build_mirror(env.contract, env.robot, history_length=5) if symmetric else None,
            scorer=scorer,
            settings=plan.settings,
            progress=progress if rank == 0 else None,
            message=message if rank == 0 else None,
        )
    except torch.OutOfMemoryError as error:
        raise ConfigurationError(
            f"{environment.num_envs} environments do not fit into the memory of {device}; use a smaller --num-envs"
        ) from error
    run = runner.log_dir = _shared_directory(runner, run)
    try:
        if plan.checkpoint is not None:
            runner.load(str(plan.checkpoint))
        elif request.init_from is not None:
            runner.load_weights(_first_weights(request, task))
        left = run_settings.iterations - runner.current_learning_iteration
        if left <= 0:
            raise ConfigurationError(
                f"the run has done {runner.current_learning_iteration} of {run_settings.iterations} iterations; to go "
                "on, give a larger --iterations"
            )
        seconds = None if request.seconds is None else max(request.seconds - (time.monotonic() - began), 0.0)
        outcome = runner.learn(left, max_seconds=seconds)
    except torch.OutOfMemoryError as error:
        raise ConfigurationError(
            f"learning with {environment.num_envs} environments does not fit into the memory of {device}; use a "
            "smaller --num-envs, or more training.algorithm.minibatches"
        ) from error
    finally:
        runner.close()
        env.close()
    return outcome, run


def _describe(plan: TrainPlan, run: Path, env: TrainingEnvironment) -> None:
    """Write what the run is made with, and note a resume in ``run.json``."""
    task = plan.task
    write_parameters(run, environment=task.environment, agent=task.training)
    description = describe_run(
        task=task.name,
        backend=plan.backend,
        num_envs=task.environment.num_envs,
        seed=task.training.run.seed,
        device=plan.device,
        contract=env.contract,
    )
    earlier = read_run_json(run)
    if earlier:
        now = f"{datetime.now().astimezone():%Y-%m-%dT%H:%M:%S%z}"
        note = {
            "started": now,
            "checkpoint": plan.checkpoint.name if plan.checkpoint else "",
            "argv": description["argv"],
        }
        update_run_json(run, {"resumed": [*earlier.get("resumed", []), note]})
        return
    begun_with = plan.checkpoint or plan.request.init_from
    update_run_json(
        run, description | {"settings": plan.settings, "begun_with": str(begun_with) if begun_with else None}
    )


def _shared_directory(runner: TrainingRunner, run: Path | None) -> Path:
    """The first process's run directory, in every process."""
    shared: list[str | None] = [str(run) if run is not None else None]
    if runner.is_distributed:
        torch.distributed.broadcast_object_list(shared, src=0, device=torch.device(runner.device))
    assert shared[0] is not None
    return Path(shared[0])
