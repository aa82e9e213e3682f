"""Velocity commands: the curriculum of ranges, and the dynamic, extreme, opposite and stationary draws (paper,
command design).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from .configuration import ConfigurationError
from .environment_configuration import CommandConfiguration
from .schedules import RampTable

COMMAND_COLUMNS = {"command_magnitude": 3, "command_sign": 2, "command_kind": 4, "command_corner": 3, "command_side": 1}
"""Uniform numbers that one draw takes, by name."""


@dataclass(frozen=True, kw_only=True)
class CommandDraw:
    """One new command per world; the caller decides which worlds take theirs."""

    command: torch.Tensor
    """Forward, lateral [m/s] and yaw [rad/s] speed, (N, 3)."""
    steps: torch.Tensor
    """Control steps for which the command holds, (N,) int64, at least 1."""
    extreme: torch.Tensor
    """Whether the command is an extreme one, (N,) bool."""


class CommandGenerator:
    """Draws commands for all worlds at once."""

    def __init__(
        self,
        configuration: CommandConfiguration,
        *,
        terrain_limits: Sequence[tuple[float, float, float]],
        control_period: float,
        max_episode_length: int,
        device: torch.device | str,
    ) -> None:
        """Put ranges on the device.

        Args:
            configuration: what to draw.
            terrain_limits: largest forward, lateral and yaw speed of each kind of terrain.
            control_period: [s].
            max_episode_length: control steps in the longest episode.
            device: where draws happen.

        Raises:
            ConfigurationError: the stages are not in order, or the first does not begin at 0.
        """
        begins = [stage.begin for stage in configuration.stages]
        if not begins or begins[0] != 0.0 or begins != sorted(begins):
            raise ConfigurationError(
                f"command stages begin at {begins} of the run; the first must begin at 0 and the others follow in order"
            )
        self._configuration = configuration
        ranges = [(s.forward, s.lateral, s.yaw) for s in configuration.stages]
        self._begins = torch.tensor(begins, dtype=torch.float32, device=device)
        self._ranges = torch.tensor(ranges, dtype=torch.float32, device=device)
        self._limits = torch.tensor(terrain_limits, dtype=torch.float32, device=device)
        self._stationary = RampTable([configuration.stationary_probability], device)
        # A number below the first bound sets an axis to zero, else one below the second bound to its lower limit.
        zero = configuration.extreme_zero_probability
        self._zero_below = torch.tensor((zero, zero, 1.0 / 3.0), device=device)
        self._low_below = 0.5 * (1.0 + self._zero_below)
        self._period = control_period
        self._length = max_episode_length
        self.interval_steps = max(round(configuration.interval / control_period), 1)
        self._stationary_steps = round(configuration.stationary_longest / control_period)

    def ranges(self, kind: torch.Tensor, progress: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Lowest and highest command of each world, (N, 3) each: the stage's range capped by the terrain's limits."""
        stage = (progress >= self._begins).sum() - 1
        present = self._ranges.index_select(0, stage.reshape(1)).squeeze(0)
        limit = self._limits[kind]
        return torch.maximum(present[:, 0], -limit), torch.minimum(present[:, 1], limit)

    def draw(
        self,
        uniform: dict[str, torch.Tensor],
        *,
        kind: torch.Tensor,
        progress: torch.Tensor,
        episode_length: torch.Tensor,
        issued: torch.Tensor,
        command: torch.Tensor,
        extreme: torch.Tensor,
    ) -> CommandDraw:
        """Draw one command per world.

        Args:
            uniform: numbers in [0, 1) by the names of ``COMMAND_COLUMNS``.
            kind: kind of terrain, (N,) int64.
            progress: fraction of the run, scalar.
            episode_length: control steps of the present episode, (N,) int64.
            issued: sum of all linear commands of this episode, (N, 2) [m/s].
            command: the present command, (N, 3).
            extreme: whether the present command is an extreme one, (N,) bool; False at the start of an episode.
        """
        settings = self._configuration
        low, high = self.ranges(kind, progress)
        remaining = (self._length - episode_length).clamp_min(1)
        way = (settings.required_distance - issued.norm(dim=1) * settings.interval).clamp_min(0.0)
        uniform_command = self._uniform(uniform, low, high, way, remaining)
        kinds = uniform["command_kind"]
        no_yaw = kinds[:, 1] < settings.straight_probability

        # Extreme: every axis at a limit or zero. Opposite: what the gauge does halfway through each of its diagonal
        # commands.
        corner = uniform["command_corner"]
        zero = corner < self._zero_below
        extremes = torch.where(corner < self._low_below, low, high).masked_fill(zero, 0.0)
        all_zero = zero.all(dim=1)
        forward = torch.where(uniform["command_side"][:, 0] < 0.5, low[:, 0], high[:, 0])
        extremes[:, 0] = torch.where(all_zero, forward, extremes[:, 0])
        opposite = torch.minimum(torch.maximum(-command, low), high)
        is_opposite = extreme & (kinds[:, 2] < settings.flip_probability)
        is_extreme = (kinds[:, 0] < settings.extreme_probability) | is_opposite

        # Stationary: as long as the rest of the episode still allows the required way at 80 % of the highest speed.
        fastest = torch.maximum(-low[:, :2], high[:, :2]).amax(dim=1).clamp_min(1e-3)
        spare = remaining - (way / (0.8 * self._period * fastest)).ceil().long()
        stationary_steps = spare.clamp(max=self._stationary_steps)
        stationary_probability = self._stationary.at(progress)[0]
        is_stationary = ~is_extreme & (stationary_steps > 0)
        is_stationary &= kinds[:, 0] < settings.extreme_probability + stationary_probability

        drawn = uniform_command.clone()
        drawn[:, 2] = torch.where(no_yaw, torch.zeros_like(drawn[:, 2]), drawn[:, 2])
        turning = kinds[:, 3] < settings.stationary_yaw_probability
        halt = torch.zeros_like(drawn)
        halt[:, 2] = torch.where(turning, uniform_command[:, 2], halt[:, 2])
        drawn = torch.where(is_stationary[:, None], halt, drawn)
        drawn = torch.where(is_extreme[:, None], extremes, drawn)
        drawn = torch.where(is_opposite[:, None], opposite, drawn)
        steps = torch.where(is_stationary, stationary_steps, torch.full_like(stationary_steps, self.interval_steps))
        return CommandDraw(command=drawn, steps=steps.clamp_min(1), extreme=is_extreme)

    def _uniform(
        self,
        uniform: dict[str, torch.Tensor],
        low: torch.Tensor,
        high: torch.Tensor,
        way: torch.Tensor,
        remaining: torch.Tensor,
    ) -> torch.Tensor:
        """Uniform commands whose linear speeds are at least what the rest of the episode needs, (N, 3)."""
        magnitude = uniform["command_magnitude"]
        command = low + magnitude * (high - low)
        if not self._configuration.dynamic:
            return command
        low, high, magnitude = low[:, :2], high[:, :2], magnitude[:, :2]
        # The published code lets the least speed exceed the range and then always commands the positive end.
        needed = (way / (remaining * self._period))[:, None]
        needed = torch.minimum(needed, torch.minimum(-low, high).clamp_min(0.0))
        below, above = (-low - needed).clamp_min(0.0), (high - needed).clamp_min(0.0)
        negative = uniform["command_sign"] * (below + above + 2e-6) < below + 1e-6
        linear = torch.where(negative, -needed - magnitude * below, needed + magnitude * above)
        return torch.cat((linear, command[:, 2:]), dim=1)
