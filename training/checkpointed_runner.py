"""What a training run writes and how it continues: rsl_rl's runner with checkpoints that resume exactly."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner

from ..policy.contract import PolicyContract, difference
from ..policy.native import StoredNetwork
from .algorithms.cts import CTS
from .averaging import WeightAverage
from .checkpoint import (
    TRAINING_VERSION,
    CheckpointError,
    checkpoint_entries,
    learned_networks,
    read_checkpoint,
    student_state,
    write_checkpoint,
)
from .configuration import TrainingConfiguration
from .logger import RunLogger
from .run_directory import read_run_json
from .seeding import random_state, restore_random_state


class TrainingDivergedError(RuntimeError):
    """Too many numbers are not finite for training to go on; the message says which and what survives."""


class CheckpointedRunner(OnPolicyRunner):
    """The part of ``runner.TrainingRunner`` that saves and loads; the attributes are set there."""

    alg: CTS
    average: WeightAverage
    logger: RunLogger
    configuration: TrainingConfiguration
    contract: PolicyContract
    task: str
    log_dir: Path | None
    settings: dict[str, Any]
    best_score: float | None
    best_iteration: int | None
    _message: Callable[[str], None]
    _submitted: int
    _fresh: bool

    def _configure_multi_gpu(self) -> None:
        """Join the processes that torchrun started; on the CPU too, where rsl_rl would ask for a GPU."""
        world = int(os.environ.get("WORLD_SIZE", "1"))
        if world == 1 or torch.device(self.device).type == "cuda":
            super()._configure_multi_gpu()
            return
        self.gpu_world_size, self.is_distributed = world, True
        self.gpu_global_rank, self.gpu_local_rank = int(os.environ["RANK"]), int(os.environ["LOCAL_RANK"])
        ranks = {"global_rank": self.gpu_global_rank, "local_rank": self.gpu_local_rank, "world_size": world}
        self.cfg["multi_gpu"] = ranks
        torch.distributed.init_process_group(backend="gloo", rank=self.gpu_global_rank, world_size=world)

    def stored_network(self) -> StoredNetwork:
        """The student as it is deployed: with averaged weights."""
        return self._stored(self.average.state_dict())

    def _stored(self, average: Mapping[str, Any]) -> StoredNetwork:
        actor = self.alg.get_policy()
        weights = student_state(average["actor_state_dict"])
        return StoredNetwork(architecture=actor.architecture, arguments=actor.arguments, state_dict=weights)

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Write a checkpoint; other ranks than the first write only their own environment and random states beside it.

        Raises:
            TrainingDivergedError: a weight is not finite.
            CheckpointError: the file cannot be written.
        """
        kept = "state_dict" if self.configuration.run.keep_episodes else "progress_dict"
        local = {
            "random": random_state(self.device),
            "environment": getattr(self.env, kept)() if hasattr(self.env, kept) else None,
            "num_envs": self.env.num_envs,
            "log": self.logger.state_dict(),
        }
        if self.gpu_global_rank != 0:
            write_checkpoint(_rank_file(path, self.gpu_global_rank), local)
            return
        learned = self.alg.save()
        for part in ("actor_state_dict", "critic_state_dict"):
            if not all(bool(torch.isfinite(value).all()) for value in learned[part].values()):
                raise TrainingDivergedError(
                    f"A weight in {part} is not finite; '{path}' was not written, earlier checkpoints are intact."
                )
        training = local | {
            "version": TRAINING_VERSION,
            "task": self.task,
            "settings": self.settings,
            "progress": float(getattr(self.env, "progress", 1.0)),
            "world_size": self.gpu_world_size,
            "best_score": self.best_score,
            "best_iteration": self.best_iteration,
        }
        average = self.average.state_dict()
        extra = learned | {"iter": self.current_learning_iteration, "infos": infos}
        extra |= {"average": average, "training": training}
        provenance = dict(self.contract.provenance) | {
            "task": self.task,
            "run": self.log_dir.name if self.log_dir else "",
            "iteration": self.current_learning_iteration,
            "environment_steps": self.logger.tot_timesteps,
        }
        contract = replace(self.contract, provenance=provenance)
        write_checkpoint(path, checkpoint_entries(contract, self._stored(average), extra))
        self.logger.save_model(path, self.current_learning_iteration)

    def load(
        self, path: str, load_cfg: dict[str, Any] | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict[str, Any] | None:
        """Continue from a checkpoint as if the run had never stopped.

        An environment without ``load_state_dict``, or another number of ranks, starts fresh episodes; this is said
        through ``message``.

        Raises:
            CheckpointError: damaged, of another task, contract, network or number of environments.
        """
        entries = read_checkpoint(path)
        training = entries["training"]
        self._check_fits(path, entries)
        try:
            self.alg.load(entries, load_cfg, strict)
        except (RuntimeError, KeyError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise CheckpointError(
                f"Cannot resume from '{path}': its weights do not fit the networks of this run: {reason}"
            ) from error
        self.average.load_state_dict(entries.get("average"))
        if "average" not in entries:
            self._message(f"'{path}' holds no average of weights: it begins here.")
        self.current_learning_iteration = entries["iter"]
        self.best_score, self.best_iteration = training["best_score"], training["best_iteration"]
        # A score may have come back, and best.pt been replaced, after the checkpoint was written.
        noted = read_run_json(self.log_dir) if self.log_dir else {}
        if (score := noted.get("best_score")) is not None and (self.best_score is None or score > self.best_score):
            self.best_score, self.best_iteration = score, noted["best_iteration"]
        self._submitted = self.current_learning_iteration
        local: Mapping[str, Any] | None = training
        if training["world_size"] != self.gpu_world_size:
            local = None
            self._message(
                f"'{path}' was written by {training['world_size']} processes, not {self.gpu_world_size}: episodes "
                "start anew."
            )
        elif self.gpu_global_rank != 0:
            local = torch.load(_rank_file(path, self.gpu_global_rank), map_location="cpu", weights_only=True)
        self.logger.load_state_dict((local or training)["log"])
        if local is not None:
            loaded = self._load_environment(path, local["environment"])
            self._fresh = not loaded or not self.configuration.run.keep_episodes
            restore_random_state(local["random"], self.device)
        return entries.get("infos")

    def load_weights(self, path: str | Path) -> None:
        """Begin with the networks of another run's checkpoint; optimizers, counters and episodes start anew.

        A policy file without training state gives the student alone; the first ``run.bootstrap_iterations`` then find
        a teacher and a critic for it.

        Raises:
            CheckpointError: damaged, of other joints or another observation, or of other networks.
        """
        entries = read_checkpoint(path, training_state=False)
        theirs = PolicyContract.from_json(entries["contract"])
        for name in ("joint_names", "observation", "action_scale", "default_joint_position"):
            if getattr(theirs, name) != getattr(self.contract, name):
                raise CheckpointError(
                    f"Cannot start from '{path}': its {name} is {getattr(theirs, name)}, this run's is "
                    f"{getattr(self.contract, name)}."
                )
        self._check_network(path, entries, "start")
        try:
            if "training" in entries:
                self.alg.load(dict(learned_networks(entries)), {"actor": True, "critic": True}, True)
            else:
                self.alg.actor.student.load_state_dict(entries["state_dict"])
                self.alg.follow_student(self.configuration.run.bootstrap_iterations)
        except (RuntimeError, KeyError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise CheckpointError(
                f"Cannot start from '{path}': its weights do not fit the networks of this run: {reason}"
            ) from error
        self.average.load_state_dict(None)

    def _load_environment(self, path: str, state: Any) -> bool:
        if state is None or not hasattr(self.env, "load_state_dict"):
            self._message(f"'{path}' holds no state of the environment: episodes start anew.")
            return False
        try:
            self.env.load_state_dict(state)
        except (ValueError, KeyError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise CheckpointError(
                f"Cannot resume from '{path}': its environment does not fit this run's settings: {reason}"
            ) from error
        return True

    def _check_fits(self, path: str, entries: Mapping[str, Any]) -> None:
        training = entries["training"]
        if training["task"] != self.task:
            raise CheckpointError(
                f"Cannot resume from '{path}': it is of task '{training['task']}', this run trains '{self.task}'."
            )
        if lines := difference(PolicyContract.from_json(entries["contract"]), self.contract):
            first = lines.splitlines()[0]
            raise CheckpointError(f"Cannot resume from '{path}': its policy contract differs from this task's: {first}")
        self._check_network(path, entries, "resume")
        if training["num_envs"] != self.env.num_envs:
            raise CheckpointError(
                f"Cannot resume from '{path}': it has {training['num_envs']} environments, this run "
                f"{self.env.num_envs}; "
                f"give --num-envs {training['num_envs']}."
            )

    def _check_network(self, path: str | Path, entries: Mapping[str, Any], verb: str) -> None:
        mine = checkpoint_entries(self.contract, self.stored_network(), {})["network"]
        if entries["network"] != mine:
            raise CheckpointError(
                f"Cannot {verb} from '{path}': its network is {entries['network']['architecture']} "
                f"{entries['network']['arguments']}, "
                f"this run's is {mine['architecture']} {mine['arguments']}; give the same training.network.* settings."
            )


def _rank_file(path: str, rank: int) -> str:
    stem, ending = os.path.splitext(path)
    return f"{stem}.rank{rank}{ending}"
