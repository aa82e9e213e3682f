"""Hold a training run in memory: environment, algorithm, log, counters. Checkpoints are written from it and read into it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rsl_rl.env import VecEnv

from ...policy.contract import PolicyContract
from ..algorithms.methods import find_method
from ..algorithms.symmetry import Mirror
from ..configuration import TrainingConfiguration
from ..networks import command_entries
from ..processes import Processes
from .averaging import WeightAverage
from .checkpoint import CheckpointError
from .logger import RunLogger
from .run_directory import update_run_json
from .stopping import TrainingOutcome


class RunState:
    """The parts of a run and the iterations that they have done.

    An environment with schedules has ``progress``, the fraction of the run that they have reached, a scalar tensor; one that can be
    resumed exactly has ``state_dict()`` (tensors and plain data) and ``load_state_dict(state)``; afterwards ``get_observations()`` must
    give what it gave before.
    """

    def __init__(
        self,
        env: VecEnv,
        configuration: TrainingConfiguration,
        *,
        contract: PolicyContract,
        task: str,
        log_dir: Path | None = None,
        device: str = "cpu",
        processes: Processes | None = None,
        mirror: Mirror | None = None,
        settings: Mapping[str, Any] | None = None,
        message: Callable[[str], None] | None = None,
    ) -> None:
        """Build algorithm and logger.

        Args:
            env: gives the groups ``policy``, ``history`` and ``privileged``.
            contract: of the policy that is trained, one observation frame wide.
            log_dir: run directory, None to leave nothing behind.
            mirror: left-right mirror maps, needed if the algorithm uses symmetry.
            settings: plain data kept in every checkpoint, so that a resumed run can be built like this one.

        Raises:
            ConfigurationError: environment and settings do not fit together.
        """
        self.env, self.configuration, self.contract, self.task = env, configuration, contract, task
        self.log_dir, self.device = log_dir, device
        self.processes = processes or Processes()
        self.settings = dict(settings or {})
        self.message = message or (lambda _: None)
        method = find_method(configuration.algorithm.method)
        self.alg = method.build(
            env.get_observations(),
            configuration,
            num_actions=env.num_actions,
            command_entries=command_entries(contract),
            mirror=mirror,
            device=device,
            processes=self.processes,
        )
        networks: dict[str, Any] = {"actor_state_dict": self.alg.actor, "critic_state_dict": self.alg.critic}
        self.average = WeightAverage(networks, age=configuration.run.average_age)
        self.logger = RunLogger(
            configuration,
            num_envs=env.num_envs,
            processes=self.processes.count,
            has_teacher=method.has_teacher,
            device=device,
        )
        self.iteration = 0
        """Completed iterations of the whole run."""
        self.fresh = True
        """True while the environment is at the beginning of its first episodes."""
        self.learning = ""
        """Name of one call of ``learn`` in several processes: files that they write in it belong together."""
        self.best_score: float | None = None
        self.best_iteration: int | None = None

    def learned(self) -> dict[str, Any]:
        """Return networks, optimizers and averages, on the device."""
        return self.alg.save() | {"average": self.average.state_dict()}

    def note(self, outcome: str) -> None:
        """Write an outcome to ``run.json``; a full disk, which may be the cause of it, is ignored."""
        if self.log_dir is not None:
            with suppress(CheckpointError):
                update_run_json(self.log_dir, {"outcome": outcome})

    def record(self, outcome: TrainingOutcome) -> None:
        """Write the end of a call of ``learn`` to ``run.json``: in the first process, or in one that has lost another."""
        if self.log_dir is not None and (self.processes.rank == 0 or outcome.exit_code == 2):
            changes = {
                "outcome": outcome.reason,
                "iteration": outcome.iteration,
                "environment_steps": self.logger.total_steps,
                "training_seconds": float(self.logger.total_time),
                "best_score": self.best_score,
                "best_iteration": self.best_iteration,
            }
            update_run_json(self.log_dir, changes)
