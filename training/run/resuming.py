"""Write a run into checkpoints, continue it from one, or begin a run with the networks of one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ...files.parsing import edited, one_line, shown
from ...policy.comparing import difference
from ...policy.contract import PHYSICS, PolicyContract
from ...policy.finding import latest_checkpoint
from ...policy.native import StoredNetwork
from ...policy.networks.estimators import VELOCITY
from ..algorithms.bootstrap import iterations_left
from ..algorithms.methods import find_method
from ..networks import Widths, command_entries
from ..tasks import Task
from . import checkpoint
from .checkpoint import CheckpointError, RunNumbers
from .keepsake import host_copy
from .run_directory import read_run_json
from .seeding import random_state, restore_random_state
from .state import RunState


class TrainingDivergedError(RuntimeError):
    """Too many numbers are not finite for training to go on; the message names them and the surviving checkpoint."""


def intact_checkpoint(run: Path | None) -> str:
    """Return a sentence on the last checkpoint of a run directory, behind another one; empty where there is none."""
    last = None if run is None else latest_checkpoint(run)
    return "" if last is None else f" The last checkpoint, '{last}', is intact."


def stored_network(run: RunState, average: Mapping[str, Any] | None = None) -> StoredNetwork:
    """Return the student as it is deployed: with averaged weights."""
    actor = run.alg.actor
    weights = checkpoint.student_state((average or run.average.state_dict())["actor_state_dict"])
    return StoredNetwork(architecture=actor.architecture, arguments=actor.arguments, state_dict=weights)


def save_run(run: RunState, path: Path) -> None:
    """Write a checkpoint; other processes than the first write only their own environment and random states beside it.

    Raises:
        TrainingDivergedError: a weight is not finite.
        CheckpointError: the file cannot be written.
    """
    kept = "state_dict" if run.configuration.run.keep_episodes else "progress_dict"
    local = {
        "random": random_state(run.device),
        "environment": getattr(run.env, kept)() if hasattr(run.env, kept) else None,
        "num_envs": run.env.num_envs,
        "log": run.logger.state_dict(),
    }
    if run.processes.several:
        local["written"] = f"{run.learning} {run.iteration}"
    if run.processes.rank != 0:
        checkpoint.write_checkpoint(checkpoint.rank_file(path, run.processes.rank), local)
        return
    learned = host_copy(run.learned(), run.device)
    progress = float(getattr(run.env, "progress", 1.0))
    write_learned(run, path, learned, local | {"world_size": run.processes.count, "progress": progress})
    run.logger.send(path, run.iteration)


def write_learned(run: RunState, path: Path, learned: Mapping[str, Any], local: Mapping[str, Any]) -> None:
    """Write a checkpoint of learned networks, in the host's memory, and of this process's own state with ``progress``.

    Raises:
        TrainingDivergedError: a weight is not finite.
        CheckpointError: the file cannot be written.
    """
    for part in ("actor_state_dict", "critic_state_dict"):
        if not all(bool(torch.isfinite(value).all()) for value in learned[part].values()):
            raise TrainingDivergedError(
                f"A weight in {part} is not finite; '{path}' was not written.{intact_checkpoint(path.parent)}"
            )
    training = {
        **local,
        "version": checkpoint.TRAINING_VERSION,
        "task": run.task,
        "settings": run.settings,
        "progress": float(local["progress"]),
        "best_score": run.best_score,
        "best_iteration": run.best_iteration,
    }
    provenance = dict(run.contract.provenance) | {
        "task": run.task,
        "run": run.log_dir.name if run.log_dir else "",
        "iteration": run.iteration,
        "environment_steps": run.logger.total_steps,
    }
    contract = replace(run.contract, provenance=provenance)
    extra = {**learned, "iter": run.iteration, "infos": None, "training": training}
    checkpoint.write_checkpoint(
        path, checkpoint.checkpoint_entries(contract, stored_network(run, learned["average"]), extra)
    )


def resume_run(run: RunState, path: Path) -> None:
    """Continue from a checkpoint as if the run had never stopped.

    Episodes start anew, at the point of the schedules and on the levels that the checkpoint knows, where the environment has no
    ``load_state_dict``, the number of processes is another one, or a process finds no part of its own beside the checkpoint; this is said
    through the runner's ``message``.

    Raises:
        CheckpointError: damaged, of another task, contract, network or number of environments.
    """
    entries = checkpoint.read_checkpoint(path)
    numbers = checkpoint.run_numbers(entries, path)
    _check_fits(run, path, entries, numbers)
    with edited(f"Cannot resume from '{path}': its training state", CheckpointError, RuntimeError):
        whole = _take_over(run, path, entries, numbers)
        remember_physics(run, PolicyContract.from_json(entries["contract"]))
    if numbers.world_size == run.processes.count and (
        lacking := run.processes.largest(0 if whole else run.processes.rank)
    ):
        run.message(
            f"'{path}' has no part of process {lacking} beside it that was written with it: episodes of such a process "
            "start anew, on the levels of the first."
        )


def _take_over(run: RunState, path: Path, entries: Mapping[str, Any], numbers: RunNumbers) -> bool:
    """Return True if this process had a part of the checkpoint to itself."""
    training = entries["training"]
    try:
        run.alg.load(entries)
    except (RuntimeError, KeyError, ValueError) as error:
        raise _misfit("resume", path, error) from error
    run.average.load_state_dict(entries.get("average"))
    if "average" not in entries:
        run.message(f"'{path}' holds no average of weights: it begins here.")
    run.iteration = numbers.iteration
    run.best_score, run.best_iteration = numbers.best_score, numbers.best_iteration
    # A score may have come back, and best.pt been replaced, after the checkpoint was written.
    noted = read_run_json(run.log_dir) if run.log_dir else {}
    if (score := noted.get("best_score")) is not None and (run.best_score is None or score > run.best_score):
        run.best_score, run.best_iteration = score, noted.get("best_iteration")
    local: Mapping[str, Any] | None = None
    if numbers.world_size == run.processes.count:
        rank = run.processes.rank
        local = checkpoint.read_rank(path, rank, training.get("written")) if rank else training
    if local is not None:
        run.fresh = not (_load_environment(run, path, local["environment"]) and _runs_on(run, local))
        restore_random_state(_table(local["random"]), run.device)
    else:
        where = _begin_anew(run, path, training, numbers)
        run.fresh = True
        if numbers.world_size != run.processes.count:
            run.message(
                f"'{path}' was written by {numbers.world_size or 'what was left of several'} processes, not "
                f"{run.processes.count}: episodes start anew{where}."
            )
    run.logger.load_state_dict(_table((training if local is None else local)["log"]), running=not run.fresh)
    return local is not None


def _table(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{shown(value)} stands in the place of a table")
    return value


def begin_with(run: RunState, path: Path) -> None:
    """Begin with the averaged networks of another run's checkpoint; optimizers, counters and episodes start anew.

    A policy file without training state gives the student alone; the first ``run.bootstrap_iterations`` then find a teacher and a critic
    for it. A checkpoint that was written among them has some of them left, which come first here, too.

    Raises:
        CheckpointError: damaged, of other joints or another observation, or of other networks.
    """
    entries = checkpoint.read_checkpoint(path, training_state=False, purpose="start from")
    with edited(f"Cannot start from '{path}': it", CheckpointError, RuntimeError):
        _begin(run, path, entries)


def _begin(run: RunState, path: Path, entries: Mapping[str, Any]) -> None:
    theirs = PolicyContract.from_json(entries["contract"])
    for name in ("joint_names", "observation", "action_scale", "default_joint_position"):
        if getattr(theirs, name) != getattr(run.contract, name):
            raise CheckpointError(
                f"Cannot start from '{path}': its {name} is {one_line(getattr(theirs, name))}, this run's is "
                f"{one_line(getattr(run.contract, name))}."
            )
    if bare := "training" not in entries:
        left = run.configuration.run.bootstrap_iterations
    else:
        left = iterations_left(entries["bootstrap"]) if "bootstrap" in entries else 0
    try:
        if bare:
            run.alg.actor.student.load_state_dict(entries["state_dict"])
        else:
            run.alg.load(checkpoint.learned_networks(entries), optimizers=False)
        run.alg.follow_student(left)
    except (RuntimeError, KeyError, ValueError) as error:
        raise _misfit("start", path, error) from error
    run.average.load_state_dict(None)
    remember_physics(run, theirs)


def remember_physics(run: RunState, theirs: PolicyContract) -> None:
    """Note the physics of the policy that a run begins or goes on with before the run's own, in the provenance of its policies."""
    own, earlier = (contract.provenance.get(PHYSICS) for contract in (run.contract, theirs))
    if isinstance(own, Mapping):
        before = earlier if isinstance(earlier, Mapping) else {"note": _UNKNOWN_PHYSICS}
        run.contract = replace(
            run.contract, provenance={**run.contract.provenance, PHYSICS: joined_physics(before, own)}
        )


def joined_physics(*each: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the provenances of some policies say of physics as that of one policy that comes from all: every engine once, and the
    first note.
    """
    both = {name: [engine for physics in each for engine in physics.get(name, ())] for name in ("trained", "tuned")}
    joined: dict[str, Any] = {
        name: [e for at, e in enumerate(all_) if e not in all_[:at]] for name, all_ in both.items()
    }
    notes = [physics["note"] for physics in each if physics.get("note")]
    return joined | ({"note": notes[0]} if notes else {})


_UNKNOWN_PHYSICS = "the file of the policy that its training began with does not say in which physics that was trained"


def _misfit(verb: str, path: Path, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"Cannot {verb} from '{path}': its weights do not fit the networks of this run: {one_line(error, 600)}"
    )


def _load_environment(run: RunState, path: Path, state: Any) -> bool:
    if state is None or not hasattr(run.env, "load_state_dict"):
        run.message(f"'{path}' holds no state of the environment: episodes start anew.")
        return False
    try:
        run.env.load_state_dict(_table(state))
    except (ValueError, KeyError, RuntimeError) as error:
        raise CheckpointError(
            f"Cannot resume from '{path}': its environment does not fit this run's settings: {one_line(error)}"
        ) from error
    return True


def _runs_on(run: RunState, local: Mapping[str, Any]) -> bool:
    """Return True if a checkpoint holds running episodes, which end where a stretch of the schedule begins; for an environment of another
    kind, the settings tell.
    """
    state = local["environment"]
    if state.get("stretch", 0) != getattr(run.env, "stretch", 0):
        return False
    return "memory" in state if "bodies" in state else run.configuration.run.keep_episodes


def _begin_anew(run: RunState, path: Path, training: Mapping[str, Any], numbers: RunNumbers) -> str:
    """Begin new episodes where the run was: at its point of the schedules, on the levels of its first process: the worlds of every
    process have the same kinds of tiles.

    Returns:
        Where that is, the rest of a sentence; empty for an environment that has neither.
    """
    env: Any = run.env
    own = env.progress_dict() if hasattr(env, "progress_dict") else {}
    if not own.keys() >= {"step", "level"}:
        return ""
    state = _table(training["environment"]) if training.get("environment") is not None else {}
    reached = _table(state.get("memory", state))
    done = numbers.iteration * run.configuration.run.steps_per_iteration
    if "step" in reached:
        own["step"] = reached["step"]
    elif "progress" in training:
        own["step"] = torch.tensor(round(training["progress"] * env.cfg.schedule.horizon_steps))
    else:
        own["step"] = own["step"] + done
    own["level"] = reached.get("level", own["level"])
    own["common_step_counter"] = state.get("common_step_counter", done)
    _load_environment(run, path, own)
    levels = "on the levels reached and " if "level" in reached else ""
    return f", {levels}at {100.0 * float(env.progress):.0f} % of the schedules"


def _check_fits(run: RunState, path: Path, entries: Mapping[str, Any], numbers: RunNumbers) -> None:
    if numbers.task != run.task:
        raise CheckpointError(
            f"Cannot resume from '{path}': it is of task '{numbers.task}', this run trains '{run.task}'."
        )
    if lines := difference(PolicyContract.from_json(entries["contract"]), run.contract):
        first = lines.splitlines()[0]
        raise CheckpointError(f"Cannot resume from '{path}': its policy contract differs from this task's: {first}")
    check_environments(path, numbers.num_envs, run.env.num_envs)


def check_environments(path: Path, theirs: int, mine: int) -> None:
    """Refuse to resume a checkpoint of another number of environments in each process. Raises CheckpointError: it is."""
    if theirs != mine:
        raise CheckpointError(
            f"Cannot resume from '{path}': it has {theirs} environments in each process, this run {mine}; leave --num-envs and "
            f"environment.num_envs out, or begin a new run with --init-from {path}."
        )


def check_network(path: Path, entries: Mapping[str, Any], task: Task, verb: str) -> None:
    """Refuse to ``resume`` or ``start`` from a file with another network than a task trains; nothing is built for it.

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
        privileged=VELOCITY + contract.frame_width,  # seen by the teacher and the critic alone
        actions=len(contract.joint_names),
        command_entries=command_entries(contract),
    )
    with torch.device("meta"):
        mine, _ = find_method(training.algorithm.method).networks(training, widths)
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
