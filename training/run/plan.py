"""Check a request for a training before anything is built or written.

A run begins with untrained networks, or in one of two other ways, each a pure function from the request to a ``TrainPlan``:
``run_with_weights`` (``--init-from``) and ``resumed_run`` (``--resume``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...files.parsing import build, shown
from ...gauge.goals import check_goals
from ...gauge.suite import load_suite
from ...policy.contract import PolicyContract
from ...policy.finding import find_policy, latest_checkpoint, shipped_policies
from ...policy.robot_of import robot_for
from ...robots.registry import lasting
from ..algorithms.methods import find_method
from ..algorithms.storage import check_minibatches, split_sizes
from ..configuration import ConfigurationError, RunConfiguration, TrainingConfiguration, to_plain
from ..environment.configuration import EnvironmentConfiguration
from ..environment.own_terms import foreign_functions, policy_observations
from ..processes import own_device
from ..tasks import TASKS, Task, find_task, named_robot, settled_name
from .checkpoint import CheckpointError, reached, read_checkpoint, run_numbers
from .logger import check_logger
from .request import TrainRequest
from .resuming import check_environments, check_network
from .run_directory import find_checkpoint, read_run_json, refuse_links

_GAUGE_WAIT = "training.run.gauge_wait"
_SMALL_STEPS = (
    "training.algorithm.learning_rate=0.0003",
    "training.algorithm.student_learning_rate=0.0003",
    "training.algorithm.desired_kl=0.003",
    "training.network.initial_std=0.3",
)
"""Settings of a run that begins with trained networks: small steps of the policy and of the student's encoder, and little noise."""


@dataclass(frozen=True, kw_only=True)
class TrainPlan:
    """A checked request."""

    request: TrainRequest
    task: Task
    backend: str
    device: str
    needs_trust: bool
    """True if a later resume imports functions that the task does not name: it needs ``trust`` or their names again."""
    settings: Mapping[str, Any]
    """Backend and resolved configuration, kept in every checkpoint: a later resume builds the same run from them."""
    checkpoint: Path | None = None
    """Checkpoint that the run continues; None for a new run."""
    progress: float | None = None
    """Fraction of the run that the checkpoint has reached; None for a new run."""
    run: Path | None = None
    """Run directory that the run continues; None to make a new one."""
    weights: Path | None = None
    """File with the first networks of a new run; None for untrained ones."""
    notice: str = ""
    """Sentence to print before the run begins, empty for none."""

    @property
    def suite(self) -> str | None:
        """Return the suite that scores checkpoints; None for no scores."""
        scored = self.request.score and self.task.training.run.gauge_interval > 0
        return (self.request.score_suite or self.task.suite) if scored else None


def prepare(request: TrainRequest) -> TrainPlan:
    """Check a request; nothing is built or written.

    Raises:
        TaskError, ConfigurationError, BackendError, SuiteError, CheckpointError: one sentence on what is wrong.
    """
    if request.resume is not None and request.init_from is not None:
        raise ConfigurationError(
            "--resume continues a run and --init-from begins a new one with its networks; give one of them"
        )
    if request.fit and (request.seconds is None or request.resume is not None):
        lacks = "a resumed run keeps its length" if request.resume else "there is no limit to fit into"
        raise ConfigurationError(
            f"--fit fits a new run into --time, and {lacks}; {'leave --fit out' if request.resume else 'add --time'}"
        )
    robot = request.robot or named_robot(request.own_overrides())
    request = replace(request, task=settled_name(request.task, robot))
    if request.resume is not None:
        return resumed_run(request, request.resume)
    if request.init_from is not None:
        return run_with_weights(request, request.init_from)
    task = _named_task(request)
    return _checked_plan(request, task, request.backend or task.backend)


def run_with_weights(request: TrainRequest, choice: str) -> TrainPlan:
    """Plan a new run that begins with the networks of a checkpoint or a policy file."""
    named = _named_task(request)
    weights = _first_weights(request, choice, named).absolute()
    entries = read_checkpoint(weights, training_state=False, purpose="start from")
    check_network(weights, entries, named, "start")
    # Schedules go on where the earlier training stopped, robots that can walk start on all levels, steps are smaller, and a policy
    # without its exploration noise gets little. Settings of the request come after these.
    highest = f"environment.terrain.highest_start_level={named.environment.terrain.levels - 1}"
    first = (f"environment.schedule.begin={reached(entries):g}", highest, *_SMALL_STEPS)
    # A number in the place of a ramp would hide the parts that the request sets.
    given = [override.lstrip() for override in request.own_overrides()]
    kept = [s for s in first if not any(o.startswith(f"{s.partition('=')[0]}.") for o in given)]
    task = _named_task(request, kept)
    notice = ""
    if "training" not in entries:
        notice = (
            f"'{choice}' holds no teacher and no critic: the first {named.training.run.bootstrap_iterations} iterations find "
            "them for it (training.run.bootstrap_iterations)"
        )
    plan = _checked_plan(request, task, request.backend or task.backend)
    return replace(plan, weights=weights, notice=notice)


def resumed_run(request: TrainRequest, choice: str) -> TrainPlan:
    """Plan the continuation of a run from one of its checkpoints."""
    if request.robot is not None:
        raise ConfigurationError(
            "a resumed run keeps its robot; leave --robot out, or begin a new run with --init-from"
        )
    named = _named_task(request)
    experiment = named.training.run.experiment
    checkpoint = find_checkpoint(choice, experiment=experiment, task=request.task, root=request.log_root).absolute()
    run = _own_directory(checkpoint, request.task)
    entries = read_checkpoint(checkpoint)
    stored, backend, iteration = _stored_task(entries, checkpoint, request.task)
    run, branched = _last_of_its_run(run, iteration)
    task, moved = _with_logger_of(named, stored.with_overrides(request.own_overrides()), checkpoint)
    _check_trust(request, task, named, checkpoint)
    check_environments(checkpoint, stored.environment.num_envs, task.environment.num_envs)
    check_network(checkpoint, entries, task, "resume")
    if (wanted := task.training.run.iterations) <= iteration:
        raise ConfigurationError(
            f"the run has done {iteration} of {wanted} iterations; to go on, give a larger --iterations"
        )
    plan = _checked_plan(request, task, request.backend or backend)
    notice = "; ".join(filter(None, (branched, moved)))
    return replace(plan, checkpoint=checkpoint, progress=reached(entries), run=run, notice=notice)


def _checked_plan(request: TrainRequest, task: Task, backend: str) -> TrainPlan:
    """Check the parts that all three beginnings share."""
    _check_rollout(task)
    check_logger(task.training.run.logger)
    device = own_device(request.device, backend)
    if request.capture and not device.startswith("cuda"):
        raise ConfigurationError(f"--capture replays CUDA graphs and the device is '{device}'; leave it out")
    if request.score:
        suite = load_suite(request.score_suite or task.suite)
        check_goals(suite, searched=any(name != "flat" for name in suite.matrix.terrains), judged=True)
    settings = {"backend": backend, "environment": to_plain(task.environment), "training": to_plain(task.training)}
    known = find_task(request.task)
    foreign = foreign_functions(settings, to_plain([known.environment, known.training]))
    return TrainPlan(
        request=request,
        task=replace(task, training=replace(task.training, run=_of_this_command(request, task.training.run))),
        backend=backend,
        device=device,
        needs_trust=bool(foreign),
        settings=settings,
    )


def _named_task(request: TrainRequest, first: Iterable[str] = ()) -> Task:
    """Return the task that the request names, with its settings after those in ``first``."""
    robot = None if request.robot is None else lasting(request.robot)
    task = find_task(request.task, [*first, *request.own_overrides()], robot=robot)
    policy_observations(task.environment.observations)  # contracts that are read from here on may name them
    return task


def _of_this_command(request: TrainRequest, run: RunConfiguration) -> RunConfiguration:
    """Return the run's settings with those changed that belong to this command alone and are not kept."""
    if request.seconds is not None and _GAUGE_WAIT not in {o.split("=", 1)[0].strip() for o in request.own_overrides()}:
        run = replace(run, gauge_wait=0.0)  # the limit holds for the whole command
    if not request.score:
        return replace(run, gauge_interval=0)
    return run


def _check_rollout(task: Task) -> None:
    """Refuse numbers of worlds, steps and minibatches from which nothing can be learned."""
    algorithm, run = task.training.algorithm, task.training.run
    period = algorithm.student_period if find_method(algorithm.method).has_teacher else 1
    teachers, students = split_sizes(task.environment.num_envs, period)
    check_minibatches(algorithm.minibatches, steps=run.steps_per_iteration, teachers=teachers, students=students)
    if run.steps_per_iteration * task.environment.num_envs < 2:
        raise ConfigurationError(
            "one step of one environment is no rollout to learn from; give more --num-envs or training.run.steps_per_iteration"
        )


def _first_weights(request: TrainRequest, choice: str, task: Task) -> Path:
    """Return the file with the first networks: a policy that ships with the project, or a choice as of ``--resume``."""
    shipped = shipped_policies()
    if choice in shipped:
        return find_policy(choice)
    experiment = task.training.run.experiment
    return find_checkpoint(choice, experiment=experiment, root=request.log_root, others=tuple(shipped))


def _own_directory(checkpoint: Path, task: str) -> Path | None:
    """Return the run directory of a checkpoint; None for a file that was carried away from its run directory."""
    run = checkpoint.parent
    if read_run_json(run).get("task") != task:
        return None
    refuse_links(run)
    return run


def _last_of_its_run(run: Path | None, iteration: int) -> tuple[Path | None, str]:
    """Return the run directory to continue and an empty text; None and a sentence if the run has gone on without this iteration: two
    branches in one folder would be one run, and its last checkpoint could be either's.
    """
    last = None if run is None else latest_checkpoint(run)
    reached = 0 if last is None else int(last.stem.rpartition("_")[2])
    if reached <= iteration:
        return run, ""
    return None, f"'{run}' has gone on to iteration {reached}: what comes of {iteration} has a run directory of its own"


def _stored_task(entries: Mapping[str, Any], checkpoint: Path, name: str) -> tuple[Task, str, int]:
    """Return the task with the settings of a checkpoint's run, its backend, and the iterations that the run had done."""
    numbers = run_numbers(entries, checkpoint)
    if (its := numbers.task) != name:
        hint = f"write gaitgauge train {its}" if its in TASKS else "give that task's name"
        raise CheckpointError(
            f"Cannot resume from '{checkpoint}': it is of task {shown(its)}, this run trains '{name}'; {hint}."
        )
    stored, source = entries["training"].get("settings"), f"Cannot resume from '{checkpoint}'"
    if not isinstance(stored, Mapping) or not {"environment", "training", "backend"} <= stored.keys():
        raise CheckpointError(
            f"{source}: an earlier version wrote it, without all of its settings; begin a new run with its networks: "
            f"--init-from {checkpoint}"
        )
    robot_for(
        PolicyContract.from_json(entries["contract"])
    )  # raises if the robot is not the one that the run began with
    task = replace(
        find_task(name),
        environment=build(EnvironmentConfiguration, stored["environment"], source, CheckpointError),
        training=build(TrainingConfiguration, stored["training"], source, CheckpointError),
    )
    return task, str(stored["backend"]), numbers.iteration


def _with_logger_of(named: Task, stored: Task, checkpoint: Path) -> tuple[Task, str]:
    """Return the stored task with the logger of the named one, and a sentence if that is another: a checkpoint, perhaps a stranger's,
    never decides where data are sent.
    """
    chosen, kept = named.training.run, stored.training.run
    run = replace(kept, logger=chosen.logger, logger_project=chosen.logger_project)
    notice = ""
    if kept.logger != chosen.logger:
        notice = (
            f"the run of '{checkpoint}' logged with {kept.logger}; only a command says where data go: add --logger "
            f"{kept.logger} to go on with that"
        )
    return replace(stored, training=replace(stored.training, run=run)), notice


def _check_trust(request: TrainRequest, task: Task, named: Task, checkpoint: Path) -> None:
    """Refuse stored settings that import code which neither the package nor the named task names, unless they are trusted."""
    foreign = foreign_functions([task.environment, task.training], [named.environment, named.training])
    if foreign and not request.trust:
        raise CheckpointError(
            f"Cannot resume from '{checkpoint}': its settings would import {shown(foreign[0])}, code that neither this "
            "package nor the task nor this command names; if you know whose it is, add --trust"
        )
