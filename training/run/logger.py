"""Log a run: rsl_rl's scalars under rsl_rl's names, collected on the device, through rsl_rl's writers."""

from __future__ import annotations

import importlib
import importlib.util
import os
import statistics
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import torch

from ..configuration import ConfigurationError, TrainingConfiguration, to_plain

WINDOW = 100
"""Number of finished episodes that ``Train/*`` averages over, as rsl_rl does."""
_SERVICES: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "wandb": ("WandbLogWriter", ()),
    "neptune": ("NeptuneLogWriter", ("NEPTUNE_API_TOKEN", "NEPTUNE_USERNAME")),
}
"""rsl_rl's writer of each service, which write TensorBoard's files too, and the environment variables that it needs."""


def check_logger(name: str) -> None:
    """Refuse a logger that cannot work here. Raises ConfigurationError: its package is not installed, or it has no account to use."""
    if name not in _SERVICES:
        return
    spec = importlib.util.find_spec(name)
    # A mere folder of that name, such as the one that wandb leaves, has no origin.
    if spec is None or spec.origin is None:
        raise ConfigurationError(
            f"--logger {name} needs the package '{name}', which is not installed: pip install {name}"
        )
    for variable in _SERVICES[name][1]:
        if variable not in os.environ:
            raise ConfigurationError(f"--logger {name} needs the environment variable {variable}; set it and try again")


def make_writer(configuration: TrainingConfiguration, log_dir: Path, environment: Any) -> Any:
    """Start the configured writer in a run directory.

    Raises:
        ConfigurationError: the service cannot be reached or refuses the account, or its package does not work.
    """
    name = configuration.run.logger
    if name not in _SERVICES:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(log_dir=str(log_dir), flush_secs=10)  # type: ignore[no-untyped-call]
    refused: tuple[type[Exception], ...] = (OSError, RuntimeError, ValueError, ImportError, AttributeError)
    try:
        service = importlib.import_module(name)
        refused += (getattr(getattr(service, "errors", None), "Error", OSError),)
        module = importlib.import_module(f"rsl_rl.utils.{name}_log_writer")
        writer = getattr(module, _SERVICES[name][0])(
            log_dir=str(log_dir), project_name=configuration.run.logger_project
        )
        if is_dataclass(environment):
            writer.store_config(environment, to_plain(configuration))
    except refused as error:
        reason = " ".join(str(error).split())[:300]
        raise ConfigurationError(f"--logger {name} cannot start: {reason}") from error
    return writer


class RunLogger:
    """Collects on the device until an iteration ends, then writes; prints nothing."""

    def __init__(
        self,
        configuration: TrainingConfiguration,
        *,
        num_envs: int,
        processes: int,
        device: str,
        has_teacher: bool = True,
    ) -> None:
        """Prepare for ``num_envs`` environments of this process; without a writer nothing is written."""
        steps = configuration.run.steps_per_iteration
        self.writer: Any = None
        self.total_steps = 0
        """Environment steps of the run, all processes together."""
        self.total_time = 0.0
        """Time of all iterations [s]."""
        self.returns: deque[float] = deque(maxlen=WINDOW)
        """Sums of rewards of the last episodes."""
        self.lengths: deque[float] = deque(maxlen=WINDOW)
        """Their lengths [control steps]."""
        self.group_returns: dict[str, deque[float]] = {name: deque(maxlen=WINDOW) for name in ("teacher", "student")}
        self.scalars: dict[str, float] = {}
        """Scalars of the last iteration, by key."""
        self.reward_sum = torch.zeros(num_envs, device=device)
        self.episode_length = torch.zeros(num_envs, device=device)
        self._finished = torch.zeros(steps, num_envs, dtype=torch.bool, device=device)
        self._returns = torch.zeros(steps, num_envs, device=device)
        self._lengths = torch.zeros(steps, num_envs, device=device)
        self._step = 0
        self._samples = steps * num_envs * processes
        self._student_period = configuration.algorithm.student_period if has_teacher else 1
        self._entries: list[tuple[tuple[str, ...], torch.Tensor]] = []
        self._latest = 0

    def forget_episodes(self) -> None:
        """Drop the running episodes: the environment has begun new ones."""
        self.reward_sum.zero_()
        self.episode_length.zero_()

    def add_step(self, rewards: torch.Tensor, dones: torch.Tensor, extras: Mapping[str, Any]) -> None:
        """Note one step of all environments, in environment order; ``extras["log"]`` has scalars by name."""
        self.reward_sum += rewards
        self.episode_length += 1
        done = dones > 0
        self._finished[self._step] = done
        self._returns[self._step] = self.reward_sum
        self._lengths[self._step] = self.episode_length
        self.reward_sum.masked_fill_(done, 0.0)
        self.episode_length.masked_fill_(done, 0.0)
        self._step = (self._step + 1) % len(self._finished)
        if entries := extras.get("log"):
            values = [v if isinstance(v, torch.Tensor) else torch.tensor(float(v)) for v in entries.values()]
            values = [v if v.dim() == 0 else v.float().mean() for v in values]
            device = self.reward_sum.device
            self._entries.append((tuple(entries), torch.stack([v.to(device, torch.float32) for v in values])))

    def collect(self) -> dict[str, float]:
        """Take the iteration's finished episodes and mean ``log`` entries to the host; entries that are NaN in a step do not count."""
        rows = self._finished.nonzero()
        finished = torch.stack(
            (self._returns[self._finished], self._lengths[self._finished], rows[:, 1].float()), dim=1
        ).cpu()
        self._finished.zero_()
        # Thousands may have ended, and the device waits meanwhile; a window keeps the last of them.
        values, lengths, index = finished.numpy().T
        student = index % self._student_period == 0
        self.returns.extend(values[-WINDOW:].tolist())
        self.lengths.extend(lengths[-WINDOW:].tolist())
        for name, chosen in (("teacher", ~student), ("student", student)):
            self.group_returns[name].extend(values[chosen][-WINDOW:].tolist())
        groups: dict[tuple[str, ...], list[torch.Tensor]] = {}
        for keys, values in self._entries:
            groups.setdefault(keys, []).append(values)
        self._entries = []
        samples: dict[str, list[float]] = {}
        for keys, stack in groups.items():
            for key, column in zip(keys, torch.stack(stack).cpu().T.tolist(), strict=True):
                samples.setdefault(key, []).extend(v for v in column if v == v)
        # A slash in a name says that it has a section already.
        return {k if "/" in k else f"Episode/{k}": statistics.fmean(v) for k, v in samples.items() if v}

    def log(
        self,
        iteration: int,
        *,
        collect_time: float,
        learn_time: float,
        losses: Mapping[str, float],
        learning_rate: float,
        action_std: torch.Tensor,
    ) -> None:
        """Write one iteration's scalars and keep them in ``scalars``; times in seconds."""
        seconds = collect_time + learn_time
        self.total_steps += self._samples
        self.total_time += seconds
        scalars = self.collect()
        scalars |= {f"Loss/{name}": value for name, value in losses.items()}
        scalars |= {
            "Loss/learning_rate": learning_rate,
            "Policy/mean_std": float(action_std.mean().item()),
            "Perf/total_fps": self._samples / seconds,
            "Perf/collection_time": collect_time,
            "Perf/learning_time": learn_time,
            "Perf/total_steps": float(self.total_steps),
        }
        if self.returns:
            scalars["Train/mean_reward"] = statistics.fmean(self.returns)
            scalars["Train/mean_episode_length"] = statistics.fmean(self.lengths)
        for name, returns in self.group_returns.items():
            if returns:
                scalars[f"Train/mean_reward_{name}"] = statistics.fmean(returns)
        self.scalars = scalars
        self.write(scalars, iteration)
        if self.returns and not self._in_order:
            self.write({"Train/mean_reward/time": scalars["Train/mean_reward"]}, int(self.total_time))

    @property
    def _in_order(self) -> bool:
        """True if the writer's service takes steps in rising order only."""
        return hasattr(self.writer, "save_model")

    def write(self, scalars: Mapping[str, float], iteration: int) -> None:
        """Write scalars if there is a writer. A late figure, such as a score, is written at the present iteration where the service drops
        earlier ones.
        """
        if self._in_order:
            iteration = self._latest = max(iteration, self._latest)
        if self.writer is not None:
            for name, value in scalars.items():
                self.writer.add_scalar(name, value, iteration)

    def send(self, path: Path, iteration: int) -> None:
        """Give a checkpoint (``.pt``) or a video to the writer's service, if it has one."""
        if self._in_order:
            if path.suffix == ".pt":
                self.writer.save_model(str(path), iteration)
            else:
                self.writer.save_video(path, max(iteration, self._latest))

    def flush(self) -> None:
        """Flush the writer to the disk."""
        if self.writer is not None:
            self.writer.flush()

    def close(self) -> None:
        """Close the writer; nothing is written any more."""
        if self.writer is not None:
            self.writer.close()
            if self._in_order:
                self.writer.stop()
        self.writer = None

    def state_dict(self) -> dict[str, Any]:
        """Return the state that continues across a resume: totals, running episodes and the window of finished ones."""
        return {
            "total_steps": self.total_steps,
            "total_time": self.total_time,
            "returns": list(self.returns),
            "lengths": list(self.lengths),
            "group_returns": {name: list(values) for name, values in self.group_returns.items()},
            "reward_sum": self.reward_sum.cpu(),
            "episode_length": self.episode_length.cpu(),
        }

    def load_state_dict(self, state: Mapping[str, Any], *, running: bool) -> None:
        """Take over a ``state_dict``, with that of the environments' episodes where they are ``running`` on. Raises LookupError, TypeError,
        ValueError, AttributeError: it is no such state.
        """
        self.total_steps = int(state["total_steps"])
        self.total_time = float(state["total_time"])
        self.returns = _window(state["returns"])
        self.lengths = _window(state["lengths"])
        self.group_returns = {name: _window(state["group_returns"][name]) for name in self.group_returns}
        if running and state["reward_sum"].shape == self.reward_sum.shape:
            self.reward_sum.copy_(state["reward_sum"])
            self.episode_length.copy_(state["episode_length"])


def _window(values: Iterable[Any]) -> deque[float]:
    """Return the last of some numbers."""
    return deque(map(float, values), maxlen=WINDOW)
