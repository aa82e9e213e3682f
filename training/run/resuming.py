"""What of a run goes into its checkpoints, and how a run continues from one or begins with its networks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ...files.parsing import edited, one_line, shown
from ...policy.contract import PolicyContract, difference
from ...policy.finding import latest_checkpoint
from ...policy.native import StoredNetwork
from ...policy.networks.estimators import VELOCITY
from ..algorithms.bootstrap import iterations_left
from ..algorithms.methods import METHODS
from ..networks import Widths, command_entries
from .checkpoint import (
    TRAINING_VERSION,
    CheckpointError,
    RunNumbers,
    checkpoint_entries,
    learned_networks,
    rank_file,
    read_checkpoint,
    read_rank,
    run_numbers,
    student_state,
    write_checkpoint,
)
from .keepsake import host_copy
from .run_directory import read_run_json
from .seeding import random_state, restore_random_state

if TYPE_CHECKING:
    from ..tasks import Task
    from .runner import TrainingRunner


class TrainingDivergedError(RuntimeError):
    """Too many numbers are not finite for training to go on; the message says which and what survives."""


def what_is_left(run: Path | None) -> str:
    """A sentence on the last checkpoint of a run directory, behind another one; empty where there is none."""
    last = None if run is None else latest_checkpoint(run)
    return "" if last is None else f" The last checkpoint, '{last}', is intact."


def stored_network(runner: TrainingRunner, average: Mapping[str, Any] | None = None) -> StoredNetwork:
    """The student as it is deployed: with averaged weights."""
    actor = runner.alg.actor
    weights = student_state((average or runner.average.state_dict())["actor_state_dict"])
    return StoredNetwork(architecture=actor.architecture, arguments=actor.arguments, state_dict=weights)


def save_run(runner: TrainingRunner, path: Path) -> None:
    """Write a checkpoint; other processes than the first write only their own environment and random states beside it.

    Raises:
        TrainingDivergedError: a weight is not finite.
        CheckpointError: the file cannot be written.
    """
    kept = "state_dict" if runner.configuration.run.keep_episodes else "progress_dict"
    local = {
        "random": random_state(runner.device),
        "environment": getattr(runner.env, kept)() if hasattr(runner.env, kept) else None,
        "num_envs": runner.env.num_envs,
        "log": runner.logger.state_dict(),
    }
    if runner.processes.several:
        local["written"] = f"{runner.learning} {runner.iteration}"
    if runner.processes.rank != 0:
        write_checkpoint(rank_file(path, runner.processes.rank), local)
        return
    learned = host_copy(runner.learned(), runner.device)
    write_learned(runner, path, learned, local | {"world_size": runner.processes.count})
    runner.logger.send(path, runner.iteration)


def write_learned(runner: TrainingRunner, path: Path, learned: Mapping[str, Any], local: Mapping[str, Any]) -> None:
    """Write a checkpoint of what was learned, in the host's memory, and of what this process holds beside it.

    Raises:
        TrainingDivergedError: a weight is not finite.
        CheckpointError: the file cannot be written.
    """
    for part in ("actor_state_dict", "critic_state_dict"):
        if not all(bool(torch.isfinite(value).all()) for value in learned[part].values()):
            raise TrainingDivergedError(
                f"A weight in {part} is not finite; '{path}' was not written.{what_is_left(path.parent)}"
            )
    training = {
        **local,
        "version": TRAINING_VERSION,
        "task": runner.task,
        "settings": runner.settings,
        "progress": float(getattr(runner.env, "progress", 1.0)),
        "best_score": runner.best_score,
        "best_iteration": runner.best_iteration,
    }
    provenance = dict(runner.contract.provenance) | {
        "task": runner.task,
        "run": runner.log_dir.name if runner.log_dir else "",
        "iteration": runner.iteration,
        "environment_steps": runner.logger.total_steps,
    }
    contract = replace(runner.contract, provenance=provenance)
    extra = {**learned, "iter": runner.iteration, "infos": None, "training": training}
    write_checkpoint(path, checkpoint_entries(contract, stored_network(runner, learned["average"]), extra))


def resume_run(runner: TrainingRunner, path: Path) -> None:
    """Continue from a checkpoint as if the run had never stopped.

    Episodes start anew, at the point of the schedules and on the levels that the checkpoint knows, where the environment has no
    ``load_state_dict``, the number of processes is another one, or a process finds no part of its own beside the checkpoint; this
    is said through the runner's ``message``.

    Raises:
        CheckpointError: damaged, of another task, contract, network or number of environments.
    """
    entries = read_checkpoint(path)
    numbers = run_numbers(entries, path)
    _check_fits(runner, path, entries, numbers)
    with edited(f"Cannot resume from '{path}': its training state", CheckpointError, RuntimeError):
        whole = _take_over(runner, path, entries, numbers)
    if numbers.world_size == runner.processes.count and (
        lacking := runner.processes.largest(0 if whole else runner.processes.rank)
    ):
        runner.message(
            f"'{path}' has no part of process {lacking} beside it that was written with it: episodes of such a process "
            "start anew, on the levels of the first."
        )


def _take_over(runner: TrainingRunner, path: Path, entries: Mapping[str, Any], numbers: RunNumbers) -> bool:
    """Returns whether this process had a part of the checkpoint to itself."""
    training = entries["training"]
    try:
        runner.alg.load(entries)
    except (RuntimeError, KeyError, ValueError) as error:
        raise _misfit("resume", path, error) from error
    runner.average.load_state_dict(entries.get("average"))
    if "average" not in entries:
        runner.message(f"'{path}' holds no average of weights: it begins here.")
    runner.iteration = numbers.iteration
    runner.best_score, runner.best_iteration = numbers.best_score, numbers.best_iteration
    # A score may have come back, and best.pt been replaced, after the checkpoint was written.
    noted = read_run_json(runner.log_dir) if runner.log_dir else {}
    if (score := noted.get("best_score")) is not None and (runner.best_score is None or score > runner.best_score):
        runner.best_score, runner.best_iteration = score, noted.get("best_iteration")
    local: Mapping[str, Any] | None = None
    if numbers.world_size == runner.processes.count:
        rank = runner.processes.rank
        local = read_rank(path, rank, training.get("written")) if rank else training
    if local is not None:
        runner.fresh = not (_load_environment(runner, path, local["environment"]) and _runs_on(runner, local))
        restore_random_state(_table(local["random"]), runner.device)
    else:
        where = _begin_anew(runner, path, training, numbers)
        runner.fresh = True
        if numbers.world_size != runner.processes.count:
            runner.message(
                f"'{path}' was written by {numbers.world_size or 'what was left of several'} processes, not "
                f"{runner.processes.count}: episodes start anew{where}."
            )
    runner.logger.load_state_dict(_table((training if local is None else local)["log"]), running=not runner.fresh)
    return local is not None


def _table(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{shown(value)} stands in the place of a table")
    return value


def begin_with(runner: TrainingRunner, path: Path) -> None:
    """Begin with the averaged networks of another run's checkpoint; optimizers, counters and episodes start anew.

    A policy file without training state gives the student alone; the first ``run.bootstrap_iterations`` then find
    a teacher and a critic for it. A checkpoint that was written among them has some of them left, which come first here, too.

    Raises:
        CheckpointError: damaged, of other joints or another observation, or of other networks.
    """
    entries = read_checkpoint(path, training_state=False, purpose="start from")
    with edited(f"Cannot start from '{path}': it", CheckpointError, RuntimeError):
        _begin(runner, path, entries)


def _begin(runner: TrainingRunner, path: Path, entries: Mapping[str, Any]) -> None:
    theirs = PolicyContract.from_json(entries["contract"])
    for name in ("joint_names", "observation", "action_scale", "default_joint_position"):
        if getattr(theirs, name) != getattr(runner.contract, name):
            raise CheckpointError(
                f"Cannot start from '{path}': its {name} is {one_line(getattr(theirs, name))}, this run's is "
                f"{one_line(getattr(runner.contract, name))}."
            )
    if bare := "training" not in entries:
        left = runner.configuration.run.bootstrap_iterations
    else:
        left = iterations_left(entries["bootstrap"]) if "bootstrap" in entries else 0
    try:
        if bare:
            runner.alg.actor.student.load_state_dict(entries["state_dict"])
        else:
            runner.alg.load(learned_networks(entries), optimizers=False)
        runner.alg.follow_student(left)
    except (RuntimeError, KeyError, ValueError) as error:
        raise _misfit("start", path, error) from error
    runner.average.load_state_dict(None)


def _misfit(verb: str, path: Path, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"Cannot {verb} from '{path}': its weights do not fit the networks of this run: {one_line(error, 600)}"
    )


def _load_environment(runner: TrainingRunner, path: Path, state: Any) -> bool:
    if state is None or not hasattr(runner.env, "load_state_dict"):
        runner.message(f"'{path}' holds no state of the environment: episodes start anew.")
        return False
    try:
        runner.env.load_state_dict(_table(state))
    except (ValueError, KeyError, RuntimeError) as error:
        raise CheckpointError(
            f"Cannot resume from '{path}': its environment does not fit this run's settings: {one_line(error)}"
        ) from error
    return True


def _runs_on(runner: TrainingRunner, local: Mapping[str, Any]) -> bool:
    """Whether a checkpoint holds running episodes; of an environment of another kind, the settings tell."""
    state = local["environment"]
    return "memory" in state if "bodies" in state else runner.configuration.run.keep_episodes


def _begin_anew(runner: TrainingRunner, path: Path, training: Mapping[str, Any], numbers: RunNumbers) -> str:
    """Begin new episodes where the run was: at its point of the schedules, on the levels of its first process, whose worlds
    have the same kinds of tiles as any other's.

    Returns:
        Where that is, the rest of a sentence; empty for an environment that has neither.
    """
    env: Any = runner.env
    own = env.progress_dict() if hasattr(env, "progress_dict") else {}
    if not own.keys() >= {"step", "level"}:
        return ""
    state = _table(training["environment"]) if training.get("environment") is not None else {}
    reached = _table(state.get("memory", state))
    done = numbers.iteration * runner.configuration.run.steps_per_iteration
    if "step" in reached:
        own["step"] = reached["step"]
    elif "progress" in training:
        own["step"] = torch.tensor(round(training["progress"] * env.cfg.schedule.horizon_steps))
    else:
        own["step"] = own["step"] + done
    own["level"] = reached.get("level", own["level"])
    own["common_step_counter"] = state.get("common_step_counter", done)
    _load_environment(runner, path, own)
    levels = "on the levels reached and " if "level" in reached else ""
    return f", {levels}at {100.0 * float(env.progress):.0f} % of the schedules"


def _check_fits(runner: TrainingRunner, path: Path, entries: Mapping[str, Any], numbers: RunNumbers) -> None:
    if numbers.task != runner.task:
        raise CheckpointError(
            f"Cannot resume from '{path}': it is of task '{numbers.task}', this run trains '{runner.task}'."
        )
    if lines := difference(PolicyContract.from_json(entries["contract"]), runner.contract):
        first = lines.splitlines()[0]
        raise CheckpointError(f"Cannot resume from '{path}': its policy contract differs from this task's: {first}")
    check_environments(path, numbers.num_envs, runner.env.num_envs)


def check_environments(path: Path, theirs: int, mine: int) -> None:
    """Refuse to resume a checkpoint of another number of environments in each process.

    Raises:
        CheckpointError: it is.
    """
    if theirs != mine:
        raise CheckpointError(
            f"Cannot resume from '{path}': it has {theirs} environments in each process, this run {mine}; leave --num-envs and "
            f"environment.num_envs out, or begin a new run with --init-from {path}."
        )


def check_network(path: Path, entries: Mapping[str, Any], task: Task, verb: str) -> None:
    """Refuse to ``resume`` or ``start`` from a file whose network is not the one that a task trains; nothing is built for it.

    Raises:
        CheckpointError: it is not.
        ConfigurationError: the task's settings of the network do not fit together.
    """
    training, cannot = task.training, f"Cannot {verb} from '{path}': its network"
    contract = PolicyContract.from_json(entries["contract"])
    widths = Widths(
        environments=1,
        frame=contract.frame_width,
        history=task.environment.observations.history_length,
        privileged=VELOCITY + contract.frame_width,  # seen by what only training has
        actions=len(contract.joint_names),
        command_entries=command_entries(contract),
    )
    with torch.device("meta"):
        mine, _ = METHODS[training.algorithm.method].networks(training, widths)
    with edited(cannot, CheckpointError):
        its, given = str(entries["network"]["architecture"]), dict(json.loads(entries["network"]["arguments"]))
    own = mine.arguments
    other = [name for name in {**own, **given} if given.get(name) != own.get(name)]
    if its != mine.architecture:
        what = f"is {one_line(its, 80)}, this run's is {mine.architecture}"
        change = f"begin with a file of {mine.architecture}, or with none"
    elif other:
        pairs = [f"{one_line(n, 80)} {shown(given.get(n))} (this run's {shown(own.get(n))})" for n in other[:8]]
        same = "environment.observations" if other == ["history_length"] else "training.network"
        what, change = f"has {', '.join(pairs)}", f"give the same {same}.* settings"
    else:
        return
    if verb == "resume":
        change = (
            "a resumed run keeps its network: leave training.algorithm.method, training.network.* and "
            "environment.observations.history_length out"
        )
    raise CheckpointError(f"{cannot} {what}; {change}.")
