"""From a request to a training run: checks everything first, builds the parts, joins them, runs."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ...files.parsing import build, shown
from ...files.writing import LOCK, lock_folder
from ...gauge.suite import load_suite
from ...policy.contract import PolicyContract
from ...policy.finding import find_policy, latest_checkpoint, shipped_policies
from ...policy.robot_of import robot_for
from ...robots.registry import lasting
from ..algorithms.methods import METHODS
from ..algorithms.storage import check_minibatches, split_sizes
from ..algorithms.symmetry import build_mirror
from ..configuration import ConfigurationError, TrainingConfiguration, to_plain
from ..environment.configuration import EnvironmentConfiguration
from ..environment.environment import TrainingEnvironment
from ..environment.own_terms import foreign_functions, policy_observations
from ..environment.terrain_configuration import FLAT_TILE
from ..tasks import TASKS, Task, find_task
from .checkpoint import CheckpointError, reached, read_checkpoint, run_numbers
from .filming import Filmer
from .logger import check_logger
from .processes import Processes, ProcessLostError, idle_gpus, own_device
from .request import TrainRequest
from .resuming import begin_with, check_environments, check_network, resume_run
from .run_directory import (
    describe_run,
    find_checkpoint,
    new_run_directory,
    read_run_json,
    refuse_links,
    update_run_json,
    write_parameters,
)
from .runner import TrainingRunner
from .scoring import Scorer
from .seeding import seed_everything
from .stopping import Progress, TrainingOutcome

DEFAULT_BACKEND = "mujoco-warp"
_WAIT = "training.run.gauge_wait"
_GOING_ON = {
    "training.algorithm.learning_rate": 3e-4,
    "training.algorithm.student_learning_rate": 3e-4,
    "training.algorithm.desired_kl": 0.003,
    "training.network.initial_std": 0.3,
}
"""Settings of a run that begins with trained networks: small steps, of the policy and of the student's encoder, and little noise."""


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
    weights: Path | None
    """What a new run's networks begin with, None for nothing."""
    needs_trust: bool
    """Whether a later resume imports functions that the task does not name, and wants ``trust`` or their names again."""
    settings: Mapping[str, Any]
    """What a later resume needs to build the same run, kept in every checkpoint: backend and the resolved configuration."""
    notice: str = ""
    """A sentence to say before the run begins, empty for none."""


def prepare(request: TrainRequest) -> TrainPlan:
    """Check a request; nothing is built or written.

    Raises:
        TaskError, ConfigurationError, BackendError, SuiteError, CheckpointError: one sentence on what is wrong.
    """
    if request.resume is not None and request.init_from is not None:
        raise ConfigurationError(
            "--resume continues a run and --init-from begins a new one with its networks; give one of them"
        )
    if request.resume is not None and request.robot is not None:
        raise ConfigurationError(
            "a resumed run keeps its robot; leave --robot out, or begin a new run with --init-from"
        )
    own = own_overrides(request)
    robot = None if request.robot is None else lasting(request.robot)
    known, task = find_task(request.task), find_task(request.task, own, robot=robot)
    policy_observations(task.environment.observations)  # contracts that are read from here on may name them
    checkpoint, run, weights, notice = None, None, None, ""
    if request.resume is not None:
        checkpoint = find_checkpoint(
            request.resume, experiment=task.training.run.experiment, task=request.task, root=request.log_root
        ).absolute()
        # A checkpoint carried here without its run directory continues in a new one.
        run = checkpoint.parent if read_run_json(checkpoint.parent).get("task") == request.task else None
        if run is not None:
            refuse_links(run)
        branched = ""
        entries = read_checkpoint(checkpoint)
        kept, kept_backend, iteration = _kept(entries, checkpoint, request.task)
        if run is not None and (last := _last_iteration(run)) > iteration:
            # Two branches in one folder would be one run: whoever asks for its last checkpoint would get the other's.
            branched = (
                f"'{run}' has gone on to iteration {last}: what comes of {iteration} has a run directory of its own"
            )
            run = None
        backend = request.backend or kept_backend
        named, task = task, kept.with_overrides(own)
        task, notice = _own_logger(task, named, checkpoint)
        notice = "; ".join(filter(None, (branched, notice)))
        if (foreign := foreign_functions([task.environment, task.training], [named.environment, named.training])) and (
            not request.trust
        ):
            raise CheckpointError(
                f"Cannot resume from '{checkpoint}': its settings would import {shown(foreign[0])}, code that neither this "
                "package nor the task nor this command names; if you know whose it is, add --trust"
            )
        check_environments(checkpoint, kept.environment.num_envs, task.environment.num_envs)
        check_network(checkpoint, entries, task, "resume")
        if (wanted := task.training.run.iterations) <= iteration:
            raise ConfigurationError(
                f"the run has done {iteration} of {wanted} iterations; to go on, give a larger --iterations"
            )
    else:
        backend = request.backend or DEFAULT_BACKEND
        begun: list[str] = []
        if request.init_from is not None:
            weights = _first_weights(request, task).absolute()
            entries = read_checkpoint(weights, training_state=False, purpose="start from")
            check_network(weights, entries, task, "start")
            begun = _going_on(task, entries)
            if "training" not in entries:
                notice = (
                    f"'{request.init_from}' holds no teacher and no critic: the first "
                    f"{task.training.run.bootstrap_iterations} iterations find them for it (training.run.bootstrap_iterations)"
                )
        task = find_task(request.task, [*begun, *own], robot=robot)
    _check_rollout(task)
    check_logger(task.training.run.logger)
    device = own_device(request.device, backend)
    if request.capture and not device.startswith("cuda"):
        raise ConfigurationError(f"--capture replays CUDA graphs and the device is '{device}'; leave it out")
    settings = {
        "backend": backend,
        "environment": to_plain(task.environment),
        "training": to_plain(task.training),
    }
    # What is for this command alone is not kept.
    run_settings = task.training.run
    if request.seconds is not None and not any(o.startswith(f"{_WAIT}=") for o in own):
        # The limit is for the whole command: nothing is waited for beyond it.
        run_settings = replace(run_settings, gauge_wait=0.0)
    if request.score_suite is None:
        run_settings = replace(run_settings, gauge_interval=0)
    else:
        load_suite(request.score_suite)
    return TrainPlan(
        request=request,
        task=replace(task, training=replace(task.training, run=run_settings)),
        backend=backend,
        device=device,
        checkpoint=checkpoint,
        run=run,
        weights=weights,
        needs_trust=bool(foreign_functions(settings, to_plain([known.environment, known.training]))),
        settings=settings,
        notice=notice,
    )


def _check_rollout(task: Task) -> None:
    """Refuse worlds, steps and minibatches with which nothing can be learned.

    Raises:
        ConfigurationError: they do not fit together.
    """
    algorithm, run = task.training.algorithm, task.training.run
    period = algorithm.student_period if METHODS[algorithm.method].has_teacher else 1
    teachers, students = split_sizes(task.environment.num_envs, period)
    check_minibatches(algorithm.minibatches, steps=run.steps_per_iteration, teachers=teachers, students=students)
    if run.steps_per_iteration * task.environment.num_envs < 2:
        raise ConfigurationError(
            "one step of one environment is no rollout to learn from; give more --num-envs or training.run.steps_per_iteration"
        )


def _own_logger(task: Task, named: Task, checkpoint: Path) -> tuple[Task, str]:
    """A resumed task with the logger that the task of today and the command line name, and a sentence if its own was another:
    a file, perhaps a stranger's, never decides where data are sent.
    """
    chosen, kept = named.training.run, task.training.run
    run = replace(kept, logger=chosen.logger, logger_project=chosen.logger_project)
    notice = ""
    if kept.logger != chosen.logger:
        notice = (
            f"the run of '{checkpoint}' logged with {kept.logger}; only a command says where data go: add --logger "
            f"{kept.logger} to go on with that"
        )
    return replace(task, training=replace(task.training, run=run)), notice


def _last_iteration(run: Path) -> int:
    """Iteration in the name of the last checkpoint in a run directory, 0 where there is none."""
    last = latest_checkpoint(run)
    return 0 if last is None else int(last.stem.rpartition("_")[2])


def _kept(entries: Mapping[str, Any], checkpoint: Path, name: str) -> tuple[Task, str, int]:
    """The task as a checkpoint's run has it, its backend, and how many iterations the run had done.

    Raises:
        CheckpointError: it is of another task, or its settings are not those of this version.
    """
    training = entries["training"]
    numbers = run_numbers(entries, checkpoint)
    if (its := numbers.task) != name:
        hint = f"write gaitgauge train {its}" if its in TASKS else "give that task's name"
        raise CheckpointError(
            f"Cannot resume from '{checkpoint}': it is of task {shown(its)}, this run trains '{name}'; {hint}."
        )
    stored, source = training.get("settings"), f"Cannot resume from '{checkpoint}'"
    if not isinstance(stored, Mapping) or not {"environment", "training", "backend"} <= stored.keys():
        raise CheckpointError(
            f"{source}: an earlier version wrote it, without all of its settings; begin a new run with its networks: "
            f"--init-from {checkpoint}"
        )
    robot_for(PolicyContract.from_json(entries["contract"]))  # says where it is not what the run began with
    task = replace(
        find_task(name),
        environment=build(EnvironmentConfiguration, stored["environment"], source, CheckpointError),
        training=build(TrainingConfiguration, stored["training"], source, CheckpointError),
    )
    return task, str(stored["backend"]), numbers.iteration


def _going_on(task: Task, entries: Mapping[str, Any]) -> list[str]:
    """Settings of a run that begins with the trained networks of a file, before those of the request: schedules go on where that
    training left them, robots that can walk start on all levels, steps are smaller, and a policy without its
    exploration noise gets little.
    """
    return [
        f"environment.schedule.begin={reached(entries):g}",
        f"environment.terrain.highest_start_level={task.environment.terrain.levels - 1}",
        *(f"{key}={value}" for key, value in _GOING_ON.items()),
    ]


def _first_weights(request: TrainRequest, task: Task) -> Path:
    """The file whose networks a new run begins with: what ``--resume`` takes, or the policy that ships with the
    project.

    Raises:
        CheckpointError: there is none.
    """
    assert request.init_from is not None
    shipped = shipped_policies()
    if request.init_from in shipped:
        return find_policy(request.init_from)
    return find_checkpoint(
        request.init_from, experiment=task.training.run.experiment, root=request.log_root, others=tuple(shipped)
    )


def own_overrides(request: TrainRequest) -> list[str]:
    """The request's options and settings as overrides, options first, so that a setting spelled out wins."""
    options: list[tuple[str, Any]] = [
        ("environment.num_envs", request.num_envs),
        ("environment.seed", request.seed),
        ("training.run.seed", request.seed),
        ("training.run.iterations", request.iterations),
        ("training.run.run_name", request.run_name),
        ("training.run.gauge_interval", request.score_every),
        ("training.run.video_interval", request.video_every),
        ("training.run.logger", request.logger),
    ]
    return [f"{key}={value}" for key, value in options if value is not None] + list(request.overrides)


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
        ConfigurationError, BackendError, CheckpointError, TrainingDivergedError, ProcessLostError: one sentence on what
        went wrong.
    """
    request, task, device = plan.request, plan.task, plan.device
    rank = Processes.told().rank
    run_settings = task.training.run
    run: Path | None = None
    seed_everything(run_settings.seed + rank)
    environment = replace(task.environment, seed=task.environment.seed + rank)
    with ExitStack() as closing:
        if rank == 0:
            run = plan.run or new_run_directory(request.log_root, run_settings.experiment, run_settings.run_name)
            closing.callback(_remove_unused, run)
            started(run)
            for sentence in filter(None, (plan.notice, idle_gpus(device))):
                message(sentence)
            closing.callback(lock_folder(run, CheckpointError).release)
        worlds = f"{environment.num_envs} environments"
        with _enough_memory(f"{worlds} do not fit into the memory of {device}; use a smaller --num-envs"):
            env = TrainingEnvironment(
                environment,
                backend=plan.backend,
                device=device,
                threads=request.threads,
                capture=device.startswith("cuda") if request.capture is None else request.capture,
                fuse=request.fuse,
            )
            closing.callback(env.close)
            if run is not None and env.unfused:
                message(env.unfused)
            processes = Processes.join(device)
            scorer = filmer = None
            if run is not None and request.score_suite is not None and run_settings.gauge_interval > 0:
                scorer = Scorer(run, suite=request.score_suite, threads=request.score_threads)
            if run is not None and run_settings.video_interval > 0:
                level_ground = all(tile.name == FLAT_TILE.name for tile in environment.terrain.tiles)
                filmer = Filmer(run, terrain="flat" if level_ground else "stairs_fd")
            run = Path(processes.firsts(str(run)))
            mirrored = task.training.algorithm.symmetry != "none"
            runner = TrainingRunner(
                env,
                task.training,
                contract=env.contract,
                task=task.name,
                log_dir=run,
                device=device,
                processes=processes,
                mirror=build_mirror(environment.observations, contract=env.contract, robot=env.robot)
                if mirrored
                else None,
                scorer=scorer,
                filmer=filmer,
                settings=plan.settings,
                progress=progress if rank == 0 else None,
                message=message if rank == 0 else None,
            )
            closing.callback(runner.close)
        too_much = f"learning with {worlds} does not fit into the memory of {device}"
        try:
            with _enough_memory(f"{too_much}; use a smaller --num-envs, or more training.algorithm.minibatches"):
                if plan.checkpoint is not None:
                    resume_run(runner, plan.checkpoint)
                elif plan.weights is not None:
                    begin_with(runner, plan.weights)
                if rank == 0:  # not before all that may refuse: what is refused changes no run
                    _describe(plan, run, env)
                seconds = None if request.seconds is None else max(request.seconds - (time.monotonic() - began), 0.0)
                outcome = runner.learn(run_settings.iterations - runner.iteration, max_seconds=seconds)
        except ProcessLostError:
            closing.pop_all()  # closing would wait for the lost process
            raise
        processes.leave()
    return outcome, run


@contextmanager
def _enough_memory(otherwise: str) -> Iterator[None]:
    """Around what the memory of the device, or on a CPU of the machine, may not suffice for; then that is a sentence.

    Raises:
        ConfigurationError: it does not suffice.
    """
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
        note = {
            "started": description["started"],
            "checkpoint": plan.checkpoint.name if plan.checkpoint else "",
            "command": description["command"],
        }
        of_its_begin = ("started", "date", "command")
        update_run_json(
            run,
            {k: v for k, v in description.items() if k not in of_its_begin}
            | {"settings": plan.settings, "resumed": [*earlier.get("resumed", []), note]},
        )
        return
    shipped = plan.request.init_from in shipped_policies()  # known by its name wherever it is installed
    begun_with = plan.checkpoint or (plan.request.init_from if shipped else plan.weights)
    update_run_json(
        run, description | {"settings": plan.settings, "begun_with": str(begun_with) if begun_with else None}
    )
