"""rsl_rl's logger without a wait for the device in every step, and with teacher and student told apart."""

from __future__ import annotations

import contextlib
import io
import statistics
from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.utils.logger import Logger

WINDOW = 100
"""Number of finished episodes that ``Train/*`` averages over, as rsl_rl does."""


class RunLogger(Logger):
    """Writes the scalars that users of rsl_rl know, under the same names, and prints nothing.

    rsl_rl's own logger copies finished episodes to the host in every step and every ``log`` entry of every step on
    its own. Here both stay on the device until the iteration ends.
    """

    writer: Any

    def __init__(self, *, num_steps: int, student_period: int, **arguments: Any) -> None:
        """See rsl_rl's logger for ``arguments``.

        Args:
            num_steps: environment steps per iteration.
            student_period: environment i is a student's if i is a multiple of it.
            arguments: of rsl_rl's logger.
        """
        super().__init__(**arguments)
        device = self.device
        self._finished = torch.zeros(num_steps, self.num_envs, dtype=torch.bool, device=device)
        self._returns = torch.zeros(num_steps, self.num_envs, device=device)
        self._lengths = torch.zeros(num_steps, self.num_envs, device=device)
        self._step = 0
        self._student_period = student_period
        self._entries: list[tuple[tuple[str, ...], torch.Tensor]] = []
        self.group_returns: dict[str, deque[float]] = {name: deque(maxlen=WINDOW) for name in ("teacher", "student")}
        self.scalars: dict[str, float] = {}
        """What the last iteration wrote, by key."""

    def process_env_step(
        self,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        extras: dict[str, Any],
        intrinsic_rewards: torch.Tensor | None = None,
    ) -> None:
        """Note one step of all environments, in environment order."""
        self.cur_reward_sum += rewards
        self.cur_episode_length += 1
        done = dones > 0
        self._finished[self._step] = done
        self._returns[self._step] = self.cur_reward_sum
        self._lengths[self._step] = self.cur_episode_length
        self.cur_reward_sum.masked_fill_(done, 0.0)
        self.cur_episode_length.masked_fill_(done, 0.0)
        self._step = (self._step + 1) % len(self._finished)
        if entries := extras.get("log", extras.get("episode")):
            values = [v if isinstance(v, torch.Tensor) else torch.tensor(float(v)) for v in entries.values()]
            values = [v if v.dim() == 0 else v.float().mean() for v in values]
            self._entries.append((tuple(entries), torch.stack([v.to(self.device, torch.float32) for v in values])))

    def collect(self) -> dict[str, float]:
        """Take the iteration's finished episodes and mean ``log`` entries to the host; entries that are NaN in a step
        do not count.
        """
        rows = self._finished.nonzero()
        finished = torch.stack(
            (self._returns[self._finished], self._lengths[self._finished], rows[:, 1].float()), dim=1
        ).cpu()
        self._finished.zero_()
        for value, length, index in finished.tolist():
            self.rewbuffer.append(value)
            self.lenbuffer.append(length)
            self.group_returns["student" if int(index) % self._student_period == 0 else "teacher"].append(value)
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
        it: int,
        start_it: int,
        total_it: int,
        collect_time: float,
        learn_time: float,
        loss_dict: dict[str, float],
        learning_rate: float,
        action_std: torch.Tensor,
        rnd_weight: float | None = None,
        print_minimal: bool = False,
        width: int = 80,
        pad: int = 40,
    ) -> None:
        """Write one iteration's scalars and keep them in ``scalars``."""
        samples = self.cfg["num_steps_per_env"] * self.num_envs * self.gpu_world_size
        seconds = collect_time + learn_time
        self.tot_timesteps += samples
        self.tot_time += seconds
        scalars = self.collect()
        scalars |= {f"Loss/{name}": value for name, value in loss_dict.items()}
        scalars |= {
            "Loss/learning_rate": learning_rate,
            "Policy/mean_std": float(action_std.mean().item()),
            "Perf/total_fps": samples / seconds,
            "Perf/collection_time": collect_time,
            "Perf/learning_time": learn_time,
            "Perf/total_steps": float(self.tot_timesteps),
        }
        if self.rewbuffer:
            scalars["Train/mean_reward"] = statistics.fmean(self.rewbuffer)
            scalars["Train/mean_episode_length"] = statistics.fmean(self.lenbuffer)
        for name, returns in self.group_returns.items():
            if returns:
                scalars[f"Train/mean_reward_{name}"] = statistics.fmean(returns)
        self.scalars = scalars
        self.write(scalars, it)
        if self.writer is not None and self.rewbuffer:
            self.writer.add_scalar("Train/mean_reward/time", scalars["Train/mean_reward"], int(self.tot_time))

    def write(self, scalars: Mapping[str, float], iteration: int) -> None:
        """Write scalars if there is a writer."""
        if self.writer is not None:
            for name, value in scalars.items():
                self.writer.add_scalar(name, value, iteration)

    def flush(self) -> None:
        """Bring what was written to the disk, as far as the writer can."""
        flush = getattr(self.writer, "flush", None)
        if flush is not None:
            flush()

    def close(self) -> None:
        """Close the writer; nothing is written any more."""
        # rsl_rl stops its own writers only, TensorBoard's has to be closed.
        self.stop_logging_writer()
        close = getattr(self.writer, "close", None)
        if close is not None:
            close()
        self.writer = None

    def _store_code_state(self) -> list[str]:
        # rsl_rl reports on standard output, which belongs to the command line.
        with contextlib.redirect_stdout(io.StringIO()):
            return super()._store_code_state()

    def state_dict(self) -> dict[str, Any]:
        """What continues across a resume: totals, running episodes and the window of finished ones."""
        return {
            "total_steps": self.tot_timesteps,
            "total_time": float(self.tot_time),
            "returns": list(self.rewbuffer),
            "lengths": list(self.lenbuffer),
            "group_returns": {name: list(values) for name, values in self.group_returns.items()},
            "reward_sum": self.cur_reward_sum.cpu(),
            "episode_length": self.cur_episode_length.cpu(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take over what ``state_dict`` returned; running episodes only if the number of environments is the same."""
        self.tot_timesteps = state["total_steps"]
        self.tot_time = state["total_time"]
        self.rewbuffer = deque(state["returns"], maxlen=WINDOW)
        self.lenbuffer = deque(state["lengths"], maxlen=WINDOW)
        self.group_returns = {name: deque(values, maxlen=WINDOW) for name, values in state["group_returns"].items()}
        if state["reward_sum"].shape == self.cur_reward_sum.shape:
            self.cur_reward_sum.copy_(state["reward_sum"])
            self.cur_episode_length.copy_(state["episode_length"])
