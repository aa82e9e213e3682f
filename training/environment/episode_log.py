"""Log episodes: rewards and ends by name, tracking errors, levels."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from .curriculum import TrainingPalette
from .memory import EnvironmentMemory
from .step_inputs import StepInputs
from .terminations import Ends
from .terrain_configuration import SCENARIOS

METRICS = ("linear_velocity_error", "yaw_rate_error")
"""Averages over all worlds and steps, in the order of ``EnvironmentMemory.metric_sums``."""


class EpisodeLog:
    """Adds up on the device, and hands out means now and then."""

    def __init__(
        self,
        *,
        rewards: Sequence[str],
        terminations: Sequence[str],
        palette: TrainingPalette,
        kind: torch.Tensor,
        control_period: float,
    ) -> None:
        """Name the columns by reward terms and rules that end episodes; ``kind`` is the kind of tile of every world, (N,) int64, and the
        period in seconds. Worlds of scenarios, the last ones, have no level.
        """
        self._names = [f"Episode_Reward/{name}" for name in rewards]
        self._names += [f"Episode_Termination/{name}" for name in terminations]
        self._names += [f"Metrics/{name}" for name in METRICS]
        self._kinds = [f"Curriculum/{tile.name}" for tile in palette.tiles if tile.name != SCENARIOS]
        of_kind = (kind[None, :] == torch.arange(len(self._kinds), device=kind.device)[:, None]).float()
        self._levelled = int((kind < len(self._kinds)).sum())
        self._kind_share = of_kind / of_kind.sum(dim=1, keepdim=True).clamp_min(1.0)
        self._one = torch.ones(len(kind), 1, device=kind.device)
        self._period = control_period

    def record(
        self, memory: EnvironmentMemory, inputs: StepInputs, rewards: torch.Tensor, ends: Ends, done: torch.Tensor
    ) -> None:
        """Add a step: weighted rewards (N, terms), and a mask of the episodes that are over, (N,) bool."""
        memory.episode_rewards.add_(rewards)
        memory.episode_steps.add_(1.0)
        linear = (inputs.command[:, :2] - inputs.base_linear_velocity_b[:, :2]).norm(dim=1)
        yaw = (inputs.command[:, 2] - inputs.base_angular_velocity_b[:, 2]).abs()
        errors = torch.stack((linear, yaw), dim=1).masked_fill(inputs.diverged[:, None], 0.0)
        finished = torch.cat((memory.episode_rewards, memory.episode_steps[:, None]), dim=1) * done[:, None]
        # In the order of ``SUMS``.
        memory.sums.add_(torch.cat((finished, ends.by_rule, errors, self._one), dim=1).sum(dim=0))
        memory.diverged_total.add_(inputs.diverged.sum())

    def read(self, memory: EnvironmentMemory, progress: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return means since the last reading, as tensors on the device; sums start anew."""
        values = torch.cat(
            (
                memory.finished_rewards / (memory.finished_steps * self._period),
                memory.finished_ends / memory.finished_ends.sum(),
                memory.metric_sums / memory.metric_steps,
            )
        )
        memory.last_log.copy_(torch.where(torch.isfinite(values), values, memory.last_log))
        memory.sums.zero_()
        log = dict(zip(self._names, memory.last_log.clone().unbind(), strict=True))
        level = memory.level.float()
        log |= dict(zip(self._kinds, (self._kind_share * level).sum(dim=1).unbind(), strict=True))
        log["Curriculum/mean_level"] = level[: self._levelled].mean()
        log["Curriculum/progress"] = progress
        log["Physics/nan_resets"] = memory.diverged_total.float()
        return log
