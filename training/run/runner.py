"""The training loop, with checkpoints that resume exactly, orderly stops, a guard against NaN, and the gauge in the loop.

Iterations are counted when they are complete: ``model_500.pt`` is the state after 500 updates, and a run resumed from
it goes on with the 501st.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from ...policy.contract import PolicyContract
from ..algorithms.methods import METHODS
from ..algorithms.symmetry import Mirror
from ..configuration import TrainingConfiguration
from ..networks import command_entries
from .averaging import WeightAverage
from .checkpoint import CheckpointError, copy_checkpoint
from .filming import Filmer
from .keepsake import Keepsake
from .logger import RunLogger, make_writer
from .processes import Processes, ProcessLostError
from .resuming import TrainingDivergedError, save_run, what_is_left, write_learned
from .run_directory import read_run_json, update_run_json
from .scoring import Scorer
from .stopping import Progress, StopSignals, TrainingOutcome


class TrainingRunner:
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
        processes: Processes | None = None,
        mirror: Mirror | None = None,
        scorer: Scorer | None = None,
        filmer: Filmer | None = None,
        settings: Mapping[str, Any] | None = None,
        progress: Callable[[Progress], None] | None = None,
        message: Callable[[str], None] | None = None,
    ) -> None:
        """Build algorithm and logger.

        Args:
            env: gives the groups ``policy``, ``history`` and ``privileged``.
            contract: of the policy that is trained, one observation frame wide.
            task: name of the task, kept in checkpoints.
            log_dir: run directory, None to leave nothing behind.
            processes: of the run, None for this one alone.
            mirror: left-right mirror maps, needed if the algorithm uses symmetry.
            scorer: gauges the student every ``run.gauge_interval`` iterations.
            filmer: makes a video every ``run.video_interval`` iterations.
            settings: plain data kept in every checkpoint, so that a resumed run can be built like this one.
            progress: called after every iteration.
            message: called with a sentence now and then.

        Raises:
            ConfigurationError: environment and settings do not fit together.
        """
        self.env = env
        self.configuration = configuration
        self.contract = contract
        self.task = task
        self.log_dir = log_dir
        self.device = device
        self.processes = processes or Processes()
        self.scorer = scorer
        self.filmer = filmer
        self.settings = dict(settings or {})
        self.message = message or (lambda _: None)
        method = METHODS[configuration.algorithm.method]
        self.alg = method.build(
            env.get_observations(),
            configuration,
            num_actions=env.num_actions,
            command_entries=command_entries(contract),
            mirror=mirror,
            device=device,
            processes=self.processes,
        )
        networks: dict[str, torch.nn.Module] = {
            "actor_state_dict": self.alg.actor,
            "critic_state_dict": self.alg.critic,
        }
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
        """Whether the environment is at the beginning of its first episodes."""
        self.learning = ""
        """One call of ``learn`` in several processes: what they write in it belongs together."""
        self.best_score: float | None = None
        self.best_iteration: int | None = None
        self._progress = progress or (lambda _: None)
        self._nonfinite = torch.zeros((), dtype=torch.int64, device=device)
        self._submitted = -1
        self._kept = Keepsake()

    # The loop

    def learn(self, iterations: int, *, max_seconds: float | None = None) -> TrainingOutcome:
        """Train.

        Args:
            iterations: how many to add to those done.
            max_seconds: stop in an orderly way after this wall-clock time [s], None for no limit.

        Returns:
            How it ended. A checkpoint has been written.

        Raises:
            TrainingDivergedError: too much of an iteration was not finite.
            CheckpointError: a checkpoint cannot be written.
            ProcessLostError: another process of the run has gone; a checkpoint of the last iteration has been written.
            ConfigurationError: the logger cannot start.
        """
        run, begin = self.configuration.run, time.monotonic()
        speaks = self.processes.rank == 0
        if run.random_episode_start and self.fresh:
            ages = torch.randint_like(self.env.episode_length_buf, high=int(self.env.max_episode_length))
            self.env.episode_length_buf = ages
        self.fresh = False
        obs = self.env.get_observations().to(self.device)
        self.alg.share()
        if self.processes.several:
            self.learning = self.processes.firsts(secrets.token_hex(8))
        if self.logger.writer is None and self.log_dir is not None and speaks:
            self.logger.writer = make_writer(self.configuration, self.log_dir, self.env.cfg)
        self._submitted = self.iteration
        if self.log_dir is not None and speaks:
            update_run_json(self.log_dir, {"outcome": "running"})
        total, reason, written = self.iteration + iterations, "finished", None
        with StopSignals(self.message) as signals:
            try:
                while self.iteration < total:
                    obs = self._iterate(obs, lambda: signals.received is not None)
                    stop = self._agreed_stop(signals, begin, max_seconds)
                    written = self._save_and_show(written, last=bool(stop) or self.iteration == total)
                    self._progress(self._snapshot(total, time.monotonic() - begin))
                    if stop:
                        reason = stop
                        break
            except ProcessLostError as error:
                raise self._rescue(error, begin) from error
            except BaseException as error:
                # of several processes, those that are left may yet say better; there may be none
                self._note("diverged" if isinstance(error, TrainingDivergedError) else "failed")
                raise
            if reason != "signal":
                self._submit(written)
                self._wait(run.gauge_wait, lambda: signals.received is not None)
        self.logger.flush()
        code = 128 + signals.received if reason == "signal" and signals.received else 0
        outcome = TrainingOutcome(reason=reason, iteration=self.iteration, checkpoint=written, exit_code=code)
        self._record(outcome)
        return outcome

    def close(self) -> None:
        """Stop what runs beside and close the log."""
        for side in (self.scorer, self.filmer):
            if side is not None:
                side.close()
        self.logger.close()

    def _iterate(self, obs: TensorDict, stopping: Callable[[], bool]) -> TensorDict:
        """One rollout and one update; returns the next observations."""
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
        losses = self.alg.update(lambda: self.processes.wait_for(self.device, stopping=stopping))
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
        if self.processes.several:
            self._kept.keep(self.learned(), self.iteration, self.device)
        return obs

    def rollout_step(self, obs: TensorDict) -> TensorDict:
        """Act, step and store; returns the next observations. Nothing in it waits for the device."""
        actions = self.alg.act(obs)
        obs, rewards, dones, extras = self.env.step(actions.to(self.env.device))
        obs, rewards, dones = self._guard(obs.to(self.device), rewards.to(self.device), dones.to(self.device))
        self.alg.store_outcome(rewards, dones, extras)
        self.logger.add_step(rewards, dones, extras)
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

    def _check_finite(self, losses: Mapping[str, float]) -> None:
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
                f"reward has diverged.{what_is_left(self.log_dir)}"
            )
        if skipped > run.nonfinite_limit * minibatches or not all(map(math.isfinite, losses.values())):
            raise TrainingDivergedError(
                f"Iteration {iteration}: {skipped:.0f} of {minibatches} minibatches had gradients that are not finite ({limit}); "
                f"lower training.algorithm.learning_rate or look at the rewards.{what_is_left(self.log_dir)}"
            )

    def _agreed_stop(self, signals: StopSignals, begin: float, max_seconds: float | None) -> str:
        """Why to stop now, an empty text to go on; the same answer in every process, or they would wait for each other
        forever.
        """
        code = 0
        if max_seconds is not None and time.monotonic() - begin >= max_seconds:
            code = 1
        if signals.received is not None:
            code = 2
        return ("", "time", "signal")[self.processes.largest(code)]

    # Checkpoints

    def learned(self) -> dict[str, Any]:
        """What has been learned: networks, optimizers and averages, on the device."""
        return self.alg.save() | {"average": self.average.state_dict()}

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
            self._submit(written)
        self._take_reports()
        if self.filmer is not None and written is not None and due(run.video_interval):
            self.filmer.submit(written, self.iteration)
        self._take_videos()
        return written

    def _wait(self, seconds: float, stop: Callable[[], bool]) -> None:
        """Wait for pending scores and videos, at most ``seconds`` [s] each, until ``stop`` says so."""
        names = (("gauge", self.scorer), ("video", self.filmer))
        if waiting := [name for name, side in names if side is not None and side.pending and seconds > 0.0]:
            self.message(f"Waiting for the {' and the '.join(waiting)}.")
        self._take_reports(seconds, stop)
        self._take_videos(seconds, stop)

    def _take_videos(self, seconds: float = 0.0, stop: Callable[[], bool] = lambda: False) -> None:
        """Log finished videos, after a wait of at most ``seconds``."""
        if self.filmer is not None:
            videos, sentence = self.filmer.take(seconds, stop)
            for video, iteration in videos:
                self.logger.send(video, iteration)
            if sentence:
                self.message(sentence)

    def _rescue(self, error: ProcessLostError, begin: float) -> ProcessLostError:
        """Write what the last complete iteration had learned; the first process that is left does it and speaks, unless the one
        that is gone diverged and has said so.
        """
        time.sleep(float(self.processes.rank))
        learned = self._kept.take()
        known = None if self.log_dir is None else read_run_json(self.log_dir).get("outcome")
        if learned is None or self.log_dir is None:
            if known == "running":
                self._record_loss(None)
            return ProcessLostError(f"{error}; no iteration was complete, so there is no new checkpoint")
        self.iteration = self._kept.iteration
        path = self.log_dir / f"model_{self.iteration}.pt"
        sentence = f"{error}; iteration {self.iteration} is in '{path}', go on with --resume {self.log_dir}"
        if known not in ("running", "failed", "diverged"):
            raise SystemExit(2)  # another one has done it
        if known != "diverged":
            self._record_loss(path)
        if not (path.exists() and time.time() - path.stat().st_mtime < time.monotonic() - begin):
            try:
                self._write_kept(path, learned)
            except TrainingDivergedError as diverged:
                self._note("diverged")
                sentence = f"{error}; {diverged}"
        if known == "diverged":
            raise SystemExit(2)
        return ProcessLostError(sentence)

    def _write_kept(self, path: Path, learned: Mapping[str, Any]) -> None:
        # The device's own stream may wait for the lost process forever; the environment is not touched by that.
        on_gpu = torch.device(self.device).type == "cuda"
        aside = torch.cuda.stream(torch.cuda.Stream(self.device)) if on_gpu else nullcontext()
        with aside:
            local = {"num_envs": self.env.num_envs, "log": self.logger.state_dict(), "world_size": 0}
            if hasattr(self.env, "progress_dict"):
                local["environment"] = self.env.progress_dict()
            write_learned(self, path, learned, local)

    def _note(self, outcome: str) -> None:
        if self.log_dir is not None:
            with suppress(CheckpointError):  # a full disk may be what it failed of
                update_run_json(self.log_dir, {"outcome": outcome})

    # The gauge

    def _submit(self, checkpoint: Path | None) -> None:
        if self.scorer is None or checkpoint is None or self._submitted == self.iteration or self.processes.rank:
            return
        self._submitted = self.iteration
        self.scorer.submit(checkpoint, self.iteration)

    def _take_reports(self, seconds: float = 0.0, stop: Callable[[], bool] = lambda: False) -> None:
        """Log scores at the iteration they belong to, after a wait of at most ``seconds``, and keep the best checkpoint."""
        if self.scorer is None:
            return
        for report in self.scorer.drain(seconds, stop):
            if report.failure:
                self.message(f"No gauge score for iteration {report.iteration}: {report.failure}.")
                continue
            scalars = {f"Gauge/{self.scorer.suite}/{name}": value for name, value in report.scores.items()}
            self.logger.write(scalars, report.iteration)
            self.logger.scalars |= scalars
            score = report.scores.get(self.configuration.run.gauge_score)
            if score is None:
                names = ", ".join(report.scores) or "nothing"
                self.message(
                    f"The gauge reports no {self.configuration.run.gauge_score!r} (training.run.gauge_score) but {names}."
                )
            elif math.isfinite(score) and (self.best_score is None or score > self.best_score):
                self.best_score, self.best_iteration = score, report.iteration
                if report.path.exists():
                    copy_checkpoint(report.path, report.path.with_name("best.pt"))
                if self.log_dir is not None:
                    best = {"best_score": self.best_score, "best_iteration": self.best_iteration}
                    update_run_json(self.log_dir, best)
                self.message(f"Best gauge score so far: {score:.4f} at iteration {report.iteration}.")

    def _snapshot(self, total: int, elapsed: float) -> Progress:
        return Progress(
            iteration=self.iteration,
            total_iterations=total,
            elapsed=elapsed,
            scalars=dict(self.logger.scalars),
            best_score=self.best_score,
            best_iteration=self.best_iteration,
        )

    def _record_loss(self, checkpoint: Path | None) -> None:
        self._record(
            TrainingOutcome(reason="lost a process", iteration=self.iteration, checkpoint=checkpoint, exit_code=2)
        )

    def _record(self, outcome: TrainingOutcome) -> None:
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
