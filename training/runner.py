"""The training loop: rsl_rl's runner with checkpoints that resume exactly, orderly stops, a guard against NaN, and
the gauge in the loop.

Iterations are counted when they are complete: ``model_500.pt`` is the state after 500 updates, and a run resumed from
it goes on with the 501st.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import nn

from ..policy.contract import TERM_WIDTH, PolicyContract
from .algorithms.symmetry import Mirror
from .averaging import WeightAverage
from .checkpoint import copy_checkpoint
from .checkpointed_runner import CheckpointedRunner, TrainingDivergedError
from .configuration import TrainingConfiguration
from .logger import RunLogger
from .run_directory import update_run_json
from .scoring import Scorer, ScoreReport
from .stopping import Progress, StopSignals, TrainingOutcome


class TrainingRunner(CheckpointedRunner):
    """Trains on a vectorized environment.

    An environment with schedules has ``progress``, the fraction of the run that they are at, a scalar tensor; one that can be
    resumed exactly has ``state_dict()`` (tensors and plain data) and
    ``load_state_dict(state)``; afterwards ``get_observations()`` must give what it gave before.
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
        mirror: Mirror | None = None,
        scorer: Scorer | None = None,
        settings: Mapping[str, Any] | None = None,
        progress: Callable[[Progress], None] | None = None,
        message: Callable[[str], None] | None = None,
    ) -> None:
        """Build algorithm and logger.

        Args:
            env: gives the groups ``policy``, ``history`` and ``privileged``.
            configuration: settings of learning.
            contract: of the policy that is trained, one observation frame wide.
            task: name of the task, kept in checkpoints.
            log_dir: run directory, None to leave nothing behind.
            device: where to learn.
            mirror: left-right mirror maps, needed if the algorithm uses symmetry.
            scorer: gauges the student every ``run.gauge_interval`` iterations.
            settings: plain data kept in every checkpoint, so that a resumed run can be built like this one.
            progress: called after every iteration.
            message: called with a sentence now and then.

        Raises:
            ConfigurationError: environment and settings do not fit together.
        """
        arguments = configuration.to_rsl_rl() | {"mirror": mirror, "command_entries": command_entries(contract)}
        super().__init__(env, arguments, str(log_dir) if log_dir else None, device)
        self.configuration = configuration
        self.contract = contract
        self.task = task
        self.log_dir = log_dir
        self.scorer = scorer
        self.settings = dict(settings or {})
        self.logger = RunLogger(
            num_steps=configuration.run.steps_per_iteration,
            student_period=configuration.algorithm.student_period,
            log_dir=self.logger.log_dir,
            cfg=self.cfg,
            env_cfg=env.cfg,
            num_envs=env.num_envs,
            is_distributed=self.is_distributed,
            gpu_world_size=self.gpu_world_size,
            gpu_global_rank=self.gpu_global_rank,
            device=device,
        )
        networks: dict[str, nn.Module] = {"actor_state_dict": self.alg.actor, "critic_state_dict": self.alg.critic}
        self.average = WeightAverage(networks, age=configuration.run.average_age)
        self.best_score: float | None = None
        self.best_iteration: int | None = None
        self._progress = progress or (lambda _: None)
        self._message = message or (lambda _: None)
        self._nonfinite = torch.zeros((), dtype=torch.int64, device=device)
        self._submitted = -1
        self._fresh = True

    # The loop

    def learn(
        self,
        num_learning_iterations: int,
        init_at_random_ep_len: bool | None = None,
        *,
        max_seconds: float | None = None,
    ) -> TrainingOutcome:
        """Train.

        Args:
            num_learning_iterations: how many iterations to add to those done.
            init_at_random_ep_len: start episodes at random ages; None for the configuration's choice. A resumed run
                never does.
            max_seconds: stop in an orderly way after this wall-clock time [s], None for no limit.

        Returns:
            How it ended. A checkpoint has been written.

        Raises:
            TrainingDivergedError: too much of an iteration was not finite.
            CheckpointError: a checkpoint cannot be written.
        """
        run, begin = self.configuration.run, time.monotonic()
        randomize = run.random_episode_start if init_at_random_ep_len is None else init_at_random_ep_len
        if randomize and self._fresh:
            self.env.episode_length_buf = torch.randint_like(
                self.env.episode_length_buf, high=int(self.env.max_episode_length)
            )
        self._fresh = False
        obs = self.env.get_observations().to(self.device)
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        if self.logger.writer is None:
            self.logger.init_logging_writer()
        start = self.current_learning_iteration
        total, reason, written = start + num_learning_iterations, "finished", None
        with StopSignals(self._message) as signals:
            while self.current_learning_iteration < total:
                obs = self._iterate(obs, start, total)
                done = self.current_learning_iteration
                stop = self._agreed_stop(signals, begin, max_seconds)
                gauge_due = run.gauge_interval > 0 and done % run.gauge_interval == 0
                if done % run.save_interval == 0 or gauge_due or stop or done == total:
                    written = self._save_numbered()
                if gauge_due or (done == total and run.gauge_interval > 0):
                    self._submit(written)
                self._take_reports(self.scorer.poll() if self.scorer else [])
                self._progress(self._snapshot(total, time.monotonic() - begin))
                if stop:
                    reason = stop
                    break
        if self.scorer is not None and reason != "signal":
            self._submit(written)
            if self.scorer.pending:
                self._message("Waiting for the gauge.")
            self._take_reports(self.scorer.drain(run.gauge_wait))
        if self.logger.writer is not None:
            self.logger.flush()
        code = 128 + signals.received if reason == "signal" and signals.received else 0
        outcome = TrainingOutcome(
            reason=reason, iteration=self.current_learning_iteration, checkpoint=written, exit_code=code
        )
        self._record(outcome)
        return outcome

    def close(self) -> None:
        """Stop the gauge and close the log."""
        if self.scorer is not None:
            self.scorer.close()
        if self.logger.writer is not None:
            self.logger.close()
        if self.is_distributed and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()

    def _iterate(self, obs: TensorDict, start: int, total: int) -> TensorDict:
        """One rollout and one update; returns the next observations."""
        begin = time.perf_counter()
        self._nonfinite.zero_()
        with torch.inference_mode():
            for _ in range(self.configuration.run.steps_per_iteration):
                actions = self.alg.act(obs)
                obs, rewards, dones, extras = self.env.step(actions.to(self.env.device))
                obs, rewards, dones = self._guard(obs.to(self.device), rewards.to(self.device), dones.to(self.device))
                self.alg.process_env_step(obs, rewards, dones, extras)
                self.logger.process_env_step(rewards, dones, extras)
            if torch.device(self.device).type == "cuda":
                # Only so that the two times below are told apart.
                torch.cuda.synchronize(self.device)
            collected = time.perf_counter()
            self.alg.compute_returns(obs)
        if (progress := getattr(self.env, "progress", None)) is not None:
            self.alg.follow(progress)
        losses = self.alg.update()
        self.average.update()
        finished = time.perf_counter()
        iteration = self.current_learning_iteration
        self.current_learning_iteration += 1
        self.logger.log(
            it=iteration,
            start_it=start,
            total_it=total,
            collect_time=collected - begin,
            learn_time=finished - collected,
            loss_dict=losses,
            learning_rate=self.alg.learning_rate,
            action_std=self.alg.get_policy().output_std,
        )
        self._check_finite(iteration, losses)
        return obs

    def _guard(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor]:
        """Take rows that are not finite out of learning: zeros for their numbers and an end to their episode. They
        are counted.
        """
        broken = ~torch.isfinite(rewards)
        for group in obs.keys():  # noqa: SIM118 (iterating a TensorDict goes over its rows)
            # A sum is finite if its terms are, and costs one pass.
            broken = broken | ~torch.isfinite(obs[group].sum(dim=-1))
        self._nonfinite += broken.sum()
        groups = {name: torch.nan_to_num(obs[name], 0.0, 0.0, 0.0) for name in obs.keys()}  # noqa: SIM118
        clean = TensorDict(groups, batch_size=obs.batch_size)
        return clean, torch.where(broken, 0.0, rewards), torch.where(broken, torch.ones_like(dones), dones)

    def _check_finite(self, iteration: int, losses: Mapping[str, float]) -> None:
        run, algorithm = self.configuration.run, self.configuration.algorithm
        broken = int(self._nonfinite.item())
        samples = run.steps_per_iteration * self.env.num_envs
        minibatches = 2 * algorithm.epochs * algorithm.minibatches
        skipped = losses.get("skipped_minibatches", 0.0)
        self.logger.scalars["Physics/nonfinite_samples"] = float(broken)
        self.logger.write({"Physics/nonfinite_samples": float(broken)}, iteration)
        survives = f" The last checkpoint in '{self.log_dir}' is intact." if self.log_dir else ""
        if broken > run.nonfinite_limit * samples:
            raise TrainingDivergedError(
                f"Iteration {iteration}: {broken} of {samples} environment samples are not finite "
                "(run.nonfinite_limit is "
                f"{run.nonfinite_limit:g}); the physics or a reward has diverged.{survives}"
            )
        if skipped > run.nonfinite_limit * minibatches or not all(map(math.isfinite, losses.values())):
            raise TrainingDivergedError(
                f"Iteration {iteration}: the gradients of {skipped:.0f} of {minibatches} minibatches are not finite "
                f"(run.nonfinite_limit is {run.nonfinite_limit:g}); lower algorithm.learning_rate or look at the "
                f"rewards.{survives}"
            )

    def _agreed_stop(self, signals: StopSignals, begin: float, max_seconds: float | None) -> str:
        """Why to stop now, an empty text to go on; the same answer on every rank, or they would wait for each other
        forever.
        """
        code = 0
        if max_seconds is not None and time.monotonic() - begin >= max_seconds:
            code = 1
        if signals.received is not None:
            code = 2
        if self.is_distributed:
            shared = torch.tensor(code, device=self.device)
            torch.distributed.all_reduce(shared, op=torch.distributed.ReduceOp.MAX)
            code = int(shared.item())
        return ("", "time", "signal")[code]

    # The gauge

    def _submit(self, checkpoint: Path | None) -> None:
        if (
            self.scorer is None
            or checkpoint is None
            or self._submitted == self.current_learning_iteration
            or self.gpu_global_rank
        ):
            return
        self._submitted = self.current_learning_iteration
        self.scorer.submit(checkpoint, self.current_learning_iteration)

    def _take_reports(self, reports: list[ScoreReport]) -> None:
        """Log scores at the iteration they belong to, and keep the best checkpoint."""
        for report in reports:
            assert self.scorer is not None
            if report.failure:
                self._message(f"No gauge score for iteration {report.iteration}: {report.failure}.")
                continue
            scalars = {f"Gauge/{self.scorer.suite}/{name}": value for name, value in report.scores.items()}
            self.logger.write(scalars, report.iteration)
            self.logger.scalars |= scalars
            score = report.scores.get(self.configuration.run.gauge_score)
            if score is None:
                names = ", ".join(report.scores) or "nothing"
                self._message(
                    f"The gauge reports no {self.configuration.run.gauge_score!r} (run.gauge_score) but {names}."
                )
            elif math.isfinite(score) and (self.best_score is None or score > self.best_score):
                self.best_score, self.best_iteration = score, report.iteration
                if report.path.exists():
                    copy_checkpoint(report.path, report.path.with_name("best.pt"))
                if self.log_dir is not None:
                    best = {"best_score": self.best_score, "best_iteration": self.best_iteration}
                    update_run_json(self.log_dir, best)
                self._message(f"Best gauge score so far: {score:.4f} at iteration {report.iteration}.")

    def _snapshot(self, total: int, elapsed: float) -> Progress:
        return Progress(
            iteration=self.current_learning_iteration,
            total_iterations=total,
            elapsed=elapsed,
            scalars=dict(self.logger.scalars),
            best_score=self.best_score,
            best_iteration=self.best_iteration,
        )

    def _record(self, outcome: TrainingOutcome) -> None:
        if self.log_dir is not None and self.gpu_global_rank == 0:
            changes = {
                "outcome": outcome.reason,
                "iteration": outcome.iteration,
                "environment_steps": self.logger.tot_timesteps,
                "training_seconds": float(self.logger.tot_time),
                "best_score": self.best_score,
                "best_iteration": self.best_iteration,
            }
            update_run_json(self.log_dir, changes)

    # Checkpoints

    def _save_numbered(self) -> Path | None:
        if self.log_dir is None:
            return None
        path = self.log_dir / f"model_{self.current_learning_iteration}.pt"
        self.save(str(path))
        return path


def command_entries(contract: PolicyContract) -> tuple[int, ...]:
    """Entries of an observation frame that hold the command."""
    start = 0
    for term in contract.observation:
        width = TERM_WIDTH[term.name] or len(contract.joint_names)
        if term.name == "command":
            return tuple(range(start, start + width))
        start += width
    return ()
