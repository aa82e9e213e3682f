"""Run the training loop: rollouts, updates, checkpoints, orderly stops, and a guard against NaN.

Iterations are counted when they are complete: ``model_500.pt`` is the state after 500 updates, and a run resumed from it goes on with the
501st.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from ...policy.contract import PHYSICS
from ..configuration import TrainingConfiguration
from ..processes import ProcessLostError
from .beside import Scores, Videos
from .filming import Filmer
from .fitting import Fit
from .logger import make_writer
from .rescue import Rescue
from .resuming import TrainingDivergedError, intact_checkpoint, remember_physics, save_run
from .run_directory import update_run_json
from .scoring import Scorer
from .seeding import random_state, restore_random_state
from .state import RunState
from .stopping import Progress, StopSignals, TrainingOutcome


class TrainingRunner(RunState):
    """Trains on a vectorized environment."""

    def __init__(
        self,
        env: VecEnv,
        configuration: TrainingConfiguration,
        *,
        scorer: Scorer | None = None,
        filmer: Filmer | None = None,
        progress: Callable[[Progress], None] | None = None,
        physics: Callable[[Any], Mapping[str, Any]] | None = None,
        **parts: Any,
    ) -> None:
        """Build the run.

        Args:
            scorer: gauges the student every ``run.gauge_interval`` iterations.
            filmer: makes videos every ``run.video_interval`` iterations, and at the end.
            physics: describes an environment's settings for the provenance of the policies, where a stretch changes them.

        Raises:
            ConfigurationError: environment and settings do not fit together.
        """
        super().__init__(env, configuration, **parts)
        self.scores, self.videos, self.rescue = Scores(self, scorer), Videos(self, filmer), Rescue(self)
        self._progress = progress or (lambda _: None)
        self._physics = physics
        self._nonfinite = torch.zeros((), dtype=torch.int64, device=self.device)

    def learn(self, iterations: int, *, max_seconds: float | None = None, fit: bool = False) -> TrainingOutcome:
        """Train.

        Args:
            max_seconds: stop in an orderly way after this wall-clock time [s], None for no limit.
            fit: shorten a new run, with all of its schedules, so that it ends with ``max_seconds``.

        Returns:
            How it ended. A checkpoint has been written.

        Raises:
            TrainingDivergedError: too much of an iteration was not finite.
            CheckpointError: a checkpoint cannot be written.
            ProcessLostError: another process of the run has gone; a checkpoint of the last iteration has been written.
            ConfigurationError: the logger cannot start.
        """
        begin = time.monotonic()
        obs = self._begin()
        total, reason, written = self.iteration + iterations, "finished", None
        fitted = Fit(self, total, max_seconds) if fit and max_seconds is not None else None
        with StopSignals(self.message) as signals, self.rescue.on_watch(begin):
            try:
                while self.iteration < total:
                    obs = self._iterate(obs)
                    if fitted is not None and max_seconds is not None:
                        total = fitted.total(total, begin + max_seconds - time.monotonic())
                    stop = self._agreed_stop(signals, begin, max_seconds)
                    ends = bool(getattr(self.env, "stretch_ends", False))
                    written = self._save_and_show(written, last=bool(stop) or ends or self.iteration == total)
                    self._progress(self._snapshot(total, time.monotonic() - begin))
                    if stop:
                        reason = stop
                        break
                    if ends and self.iteration < total:
                        obs = self._next_stretch()
            except ProcessLostError as error:
                raise self.rescue.write(error) from error
            except BaseException as error:
                # Other processes that are left may report better; there may be none.
                self.note("diverged" if isinstance(error, TrainingDivergedError) else "failed")
                raise
            if reason != "signal":
                self.scores.submit(written)
                self.videos.finish(written, self.configuration.run.gauge_wait)
                self._wait(self.configuration.run.gauge_wait, lambda: signals.received is not None)
        self.logger.flush()
        code = 128 + signals.received if reason == "signal" and signals.received else 0
        outcome = TrainingOutcome(reason=reason, iteration=self.iteration, checkpoint=written, exit_code=code)
        self.record(outcome)
        return outcome

    def close(self) -> None:
        """Stop the side processes and close the log."""
        self.scores.close()
        self.videos.close()
        self.logger.close()

    def rollout_step(self, obs: TensorDict) -> TensorDict:
        """Return act, step and store; returns the next observations. Nothing in it waits for the device."""
        actions = self.alg.act(obs)
        obs, rewards, dones, extras = self.env.step(actions.to(self.env.device))
        obs, rewards, dones = self._guard(obs.to(self.device), rewards.to(self.device), dones.to(self.device))
        self.alg.store_outcome(rewards, dones, extras)
        self.logger.add_step(rewards, dones, extras)
        return obs

    def _begin(self) -> TensorDict:
        """Bring environment, networks, log and run directory to the start of the loop; returns the first observations."""
        speaks = self.log_dir is not None and self.processes.rank == 0
        obs = self._first_observations()
        self.alg.share()
        if self.processes.several:
            self.learning = self.processes.firsts(secrets.token_hex(8))
        if self.log_dir is not None and speaks:
            if self.logger.writer is None:
                self.logger.writer = make_writer(self.configuration, self.log_dir, self.env.cfg)
            update_run_json(self.log_dir, {"outcome": "running"})
        self.scores.begin()
        return obs

    def _first_observations(self) -> TensorDict:
        """Return the present observations, after new episodes were given random ages."""
        if self.configuration.run.random_episode_start and self.fresh:
            ages = torch.randint_like(self.env.episode_length_buf, high=int(self.env.max_episode_length))
            self.env.episode_length_buf = ages
        self.fresh = False
        return self.env.get_observations().to(self.device)

    def _next_stretch(self) -> TensorDict:
        """Begin the next stretch of the environment's schedule as resuming from the checkpoint just written does; returns its first
        observations.
        """
        env: Any = self.env
        random = random_state(self.device)
        stretch = env.next_stretch()
        restore_random_state(random, self.device)
        self.fresh = True
        self.logger.forget_episodes()
        if self._physics is not None:
            earlier, own = self.contract, {PHYSICS: self._physics(env.configuration)}
            self.contract = replace(earlier, provenance={**earlier.provenance, **own})
            remember_physics(self, earlier)
        self.message(
            f"Stretch '{stretch.name}' begins after iteration {self.iteration}: {stretch.settings or 'nothing changes'}"
        )
        return self._first_observations()

    def _iterate(self, obs: TensorDict) -> TensorDict:
        """Do one rollout and one update; returns the next observations."""
        begin = time.perf_counter()
        self._nonfinite.zero_()
        with torch.inference_mode():
            for _ in range(self.configuration.run.steps_per_iteration):
                obs = self.rollout_step(obs)
            if torch.device(self.device).type == "cuda":
                # Only so that the two times below are told apart.
                torch.cuda.synchronize(self.device)
            collected = time.perf_counter()
            self.alg.compute_returns(obs)
        if (progress := getattr(self.env, "progress", None)) is not None:
            self.alg.follow(progress)
        losses = self.rescue.watched(self.alg.update)
        self.average.update()
        finished = time.perf_counter()
        self.iteration += 1
        self.logger.log(
            self.iteration - 1,
            collect_time=collected - begin,
            learn_time=finished - collected,
            losses=losses,
            learning_rate=self.alg.learning_rate,
            action_std=self.alg.action_std,
        )
        self._check_finite(losses)
        self.rescue.keep()
        return obs

    def _guard(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor]:
        """Take rows that are not finite out of learning: zeros for their numbers and an end to their episode. They are counted."""
        broken = ~torch.isfinite(rewards)
        for group in obs.keys():  # noqa: SIM118 (iterating a TensorDict goes over its rows)
            # A sum is finite if its terms are, and costs one pass.
            broken = broken | ~torch.isfinite(obs[group].sum(dim=-1))
        self._nonfinite += broken.sum()
        groups = {name: torch.nan_to_num(obs[name], 0.0, 0.0, 0.0) for name in obs.keys()}  # noqa: SIM118
        clean = TensorDict(groups, batch_size=obs.batch_size)
        return clean, torch.where(broken, 0.0, rewards), torch.where(broken, torch.ones_like(dones), dones)

    def _check_finite(self, losses: Mapping[str, float]) -> None:
        """Log the number of samples that are not finite."""
        run, iteration = self.configuration.run, self.iteration - 1
        broken = int(self._nonfinite.item())
        samples = run.steps_per_iteration * self.env.num_envs
        skipped, minibatches = losses.get("skipped_minibatches", 0.0), self.alg.steps
        self.logger.scalars["Physics/nonfinite_samples"] = float(broken)
        self.logger.write({"Physics/nonfinite_samples": float(broken)}, iteration)
        limit = f"training.run.nonfinite_limit is {run.nonfinite_limit:g}"
        if broken > run.nonfinite_limit * samples:
            raise TrainingDivergedError(
                f"Iteration {iteration}: {broken} of {samples} environment samples are not finite ({limit}); the physics or a "
                f"reward has diverged.{intact_checkpoint(self.log_dir)}"
            )
        if skipped > run.nonfinite_limit * minibatches or not all(map(math.isfinite, losses.values())):
            raise TrainingDivergedError(
                f"Iteration {iteration}: {skipped:.0f} of {minibatches} minibatches had gradients that are not finite ({limit}); "
                f"lower training.algorithm.learning_rate or look at the rewards.{intact_checkpoint(self.log_dir)}"
            )

    def _agreed_stop(self, signals: StopSignals, begin: float, max_seconds: float | None) -> str:
        """Return the reason to stop now, an empty text to go on; it is the same in every process, or they would wait for each other
        forever.
        """
        late = max_seconds is not None and time.monotonic() - begin >= max_seconds
        code = 2 if signals.received is not None else int(late)
        return ("", "time", "signal")[self.processes.largest(code)]

    def _save_and_show(self, written: Path | None, *, last: bool) -> Path | None:
        """Write a checkpoint where one is due, have it gauged and filmed; returns the last one."""
        run = self.configuration.run

        def due(interval: int) -> bool:
            return interval > 0 and self.iteration % interval == 0

        if self.log_dir is not None and (
            last or any(map(due, (run.save_interval, run.gauge_interval, run.video_interval)))
        ):
            written = self.log_dir / f"model_{self.iteration}.pt"
            save_run(self, written)
        if due(run.gauge_interval):
            self.scores.submit(written)
        self.scores.take()
        if due(run.video_interval):
            self.videos.submit(written)
        self.videos.take()
        return written

    def _wait(self, seconds: float, stop: Callable[[], bool]) -> None:
        """Wait for pending scores and videos, at most ``seconds`` [s] each, until ``stop`` returns True."""
        names = (("score", self.scores), ("film", self.videos))
        if waiting := [name for name, side in names if side.pending and seconds > 0.0]:
            self.message(f"Waiting for the {' and the '.join(waiting)}.")
        self.scores.take(seconds, stop)
        self.videos.take(seconds, stop)
        if self.scores.pending and not stop():
            self.message(
                "The last checkpoint has no score: a training waits training.run.gauge_wait for it, with --time not at all."
            )

    def _snapshot(self, total: int, elapsed: float) -> Progress:
        interval, ahead = self.configuration.run.gauge_interval, total - self.iteration
        return Progress(
            next_score=min(interval - self.iteration % interval, ahead) if self.scores.made and ahead else None,
            iteration=self.iteration,
            total_iterations=total,
            elapsed=elapsed,
            scalars=dict(self.logger.scalars),
            best_score=self.best_score,
            best_iteration=self.best_iteration,
        )
