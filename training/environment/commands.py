"""Velocity commands: the curriculum of ranges, and the dynamic, extreme, opposite and stationary draws (paper, command design); and
crossings, which last an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ..configuration import ConfigurationError
from .configuration import CommandConfiguration
from .schedules import RampTable
from .terrain_configuration import TileConfiguration

COMMAND_COLUMNS = {
    "command_magnitude": 3,
    "command_sign": 2,
    "command_kind": 4,
    "command_corner": 3,
    "command_side": 1,
    "command_crossing": 3,
}
"""Uniform numbers that one draw takes, by name."""


@dataclass(frozen=True, kw_only=True)
class CommandDraw:
    """One new command per world; the caller decides which worlds take theirs."""

    command: torch.Tensor
    """Forward, lateral [m/s] and yaw [rad/s] speed, (N, 3)."""
    steps: torch.Tensor
    """Control steps for which the command holds, (N,) int64, at least 1."""
    extreme: torch.Tensor
    """True for extreme commands, (N,) bool."""
    holds_heading: torch.Tensor
    """True for straight commands, during which the heading is held, (N,) bool."""


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """Range of commands for each world: the stage's, capped by the terrain's limits."""

    low: torch.Tensor
    """Lowest command of every axis, (N, 3)."""
    high: torch.Tensor
    """Highest command of every axis, (N, 3)."""
    downward: torch.Tensor
    """Largest backward and rightward speeds [m/s], (N, 2)."""
    either: torch.Tensor
    """Linear speed that is allowed in both directions [m/s], (N, 2)."""
    reach: torch.Tensor
    """Way of a control step at 80 % of the highest speed [m], (N,)."""
    interval: torch.Tensor
    """Time between two draws [s], (N,); as the rest, the tile's own."""
    interval_steps: torch.Tensor
    """The same in control steps, (N,) float32."""
    stationary: torch.Tensor
    """Factor on the share of stationary commands, (N,)."""
    reversal: torch.Tensor
    """Chance of a reversal, (N,)."""
    shares: torch.Tensor
    """Shares of extreme and of straight draws, of flips, and of stationary commands that turn on the spot, (N, 4)."""


_RANGE_WIDTHS = (3, 3, 2, 2, 1, 1, 1, 1, 1, 4)
"""Columns of ``Ranges``, in order."""
_MOVES = 0.01
"""Square of the commanded speed from which there is something to reverse [m²/s² and rad²/s²]."""


def _range_table(
    configuration: CommandConfiguration, tiles: Sequence[TileConfiguration], period: float
) -> torch.Tensor:
    """Return ``Ranges`` of every stage and kind of terrain, (stages, kinds, columns): looked up, not computed, in every step."""
    stages = [(s.forward, s.lateral, s.yaw) for s in configuration.drawn_stages]
    bounds = torch.tensor(stages, dtype=torch.float32)[:, None]
    limit = torch.tensor([tile.command_limits for tile in tiles], dtype=torch.float32)
    low, high = torch.maximum(bounds[..., 0], -limit), torch.minimum(bounds[..., 1], limit)
    downward = -low[..., :2]
    either = torch.minimum(downward, high[..., :2]).clamp_min(0.0)
    fastest = torch.maximum(downward, high[..., :2]).amax(dim=-1, keepdim=True).clamp_min(1e-3)
    own = [
        (
            interval := tile.interval or configuration.interval,
            max(round(interval / period), 1),
            tile.stationary_probability,
            tile.reversal_probability,
            configuration.extreme_probability,
            configuration.straight_probability,
            configuration.flip_probability,
            configuration.stationary_yaw_probability * tile.stationary_yaw_probability,
        )
        for tile in tiles
    ]
    rest = torch.tensor(own, dtype=torch.float32).expand(len(stages), -1, -1)
    return torch.cat((low, high, downward, either, 0.8 * period * fastest, rest), dim=-1)


def largest_commands(
    configuration: CommandConfiguration, terrain_limits: Sequence[tuple[float, float, float]]
) -> tuple[float, float, float]:
    """Return the largest forward, lateral [m/s] and yaw [rad/s] speed that any stage draws on any kind of terrain."""
    ranges = [(stage.forward, stage.lateral, stage.yaw) for stage in configuration.drawn_stages]
    drawn = [max(abs(bound) for stage in ranges for bound in stage[axis]) for axis in range(3)]
    allowed = [max(limits[axis] for limits in terrain_limits) for axis in range(3)]
    forward, lateral, yaw = (min(pair) for pair in zip(drawn, allowed, strict=True))
    return forward, lateral, yaw


class CommandGenerator:
    """Draws commands for all worlds at once."""

    def __init__(
        self,
        configuration: CommandConfiguration,
        *,
        tiles: Sequence[TileConfiguration],
        control_period: float,
        max_episode_length: int,
        device: torch.device | str,
    ) -> None:
        """Put ranges on the device.

        Args:
            tiles: kinds of terrain, in the order of their numbers.
            control_period: [s].
            max_episode_length: control steps in the longest episode.

        Raises:
            ConfigurationError: the stages are not in order, or the first does not begin at 0.
        """
        begins = [stage.begin for stage in configuration.stages]
        if not begins or begins[0] != 0.0 or begins != sorted(begins):
            raise ConfigurationError(
                f"command stages begin at {begins} of the run; the first must begin at 0 and the others follow in order"
            )
        self._configuration = configuration
        begins = [stage.begin for stage in configuration.drawn_stages]
        self._begins = torch.tensor(begins, dtype=torch.float32, device=device)
        self._table = _range_table(configuration, tiles, control_period).to(device)
        self._ends = torch.tensor([tile.ends for tile in tiles], device=device)
        self._stationary = RampTable([configuration.stationary_probability], device)
        self._reverses = any(tile.reversal_probability > 0 for tile in tiles)
        # A number below the first bound sets an axis to zero, else one below the second bound to its lower limit.
        self._zero_below = torch.tensor(configuration.extreme_zero_probability, device=device)
        self._low_below = 0.5 * (1.0 + self._zero_below)
        self._period, self._length = control_period, max_episode_length
        self._stationary_steps = round(configuration.stationary_longest / control_period)

    def ranges(self, kind: torch.Tensor, progress: torch.Tensor) -> Ranges:
        """Return the range that the present stage allows each world."""
        stage = (progress >= self._begins).sum() - 1
        rows = self._table.index_select(0, stage.reshape(1)).squeeze(0)[kind]
        low, high, downward, either, *others, shares = rows.split(_RANGE_WIDTHS, dim=1)
        reach, interval, interval_steps, stationary, reversal = (column.squeeze(1) for column in others)
        return Ranges(
            low=low,
            high=high,
            downward=downward,
            either=either,
            reach=reach,
            interval=interval,
            interval_steps=interval_steps,
            stationary=stationary,
            reversal=reversal,
            shares=shares,
        )

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
        holds_heading: torch.Tensor,
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
            holds_heading: whether its yaw rate only leads back to a heading, (N,) bool.
        """
        settings, ranges = self._configuration, self.ranges(kind, progress)
        low, high = ranges.low, ranges.high
        if self._reverses:  # alone makes opposites of commands that hold a heading
            command = torch.cat((command[:, :2], command[:, 2:].masked_fill(holds_heading[:, None], 0.0)), dim=1)
        remaining = (self._length - episode_length).clamp_min(1)
        way = (settings.required_distance - issued.norm(dim=1) * ranges.interval).clamp_min(0.0)
        linear, yaw = self._uniform(uniform, ranges, way, remaining)
        kind_number = uniform["command_kind"]
        extreme_drawn, straight, flipped, turning = (kind_number < ranges.shares).unbind(1)

        # Extreme: every axis at a limit or zero. Opposite: what the gauge does halfway through each of its diagonal commands.
        corner = uniform["command_corner"]
        zero = corner < self._zero_below
        extremes = torch.where(corner < self._low_below, low, high).masked_fill(zero, 0.0)
        all_zero = zero.all(dim=1)
        forward = torch.where(uniform["command_side"][:, 0] < 0.5, low[:, 0], high[:, 0])
        extremes[:, 0] = torch.where(all_zero, forward, extremes[:, 0])
        opposite = torch.clamp(-command, low, high)
        is_opposite = extreme & flipped
        is_extreme = extreme_drawn | is_opposite

        # Stationary: as long as the rest of the episode still allows the required way at 80 % of the highest speed.
        spare = remaining - (way / ranges.reach).ceil()
        stationary_steps = spare.clamp(max=self._stationary_steps)
        stationary_below = torch.addcmul(ranges.shares[:, 0], self._stationary.at(progress)[0], ranges.stationary)
        is_stationary = ~is_extreme & (stationary_steps > 0)
        is_stationary &= kind_number[:, 0] < stationary_below

        linear = linear.masked_fill(is_stationary[:, None], 0.0)
        yaw = yaw.masked_fill(torch.where(is_stationary, ~turning, straight)[:, None], 0.0)
        drawn = torch.where(is_extreme[:, None], extremes, torch.cat((linear, yaw), dim=1))
        drawn = torch.where(is_opposite[:, None], opposite, drawn)
        steps = torch.where(is_stationary, stationary_steps, ranges.interval_steps).long()
        holds = straight & ~is_stationary & ~is_extreme

        # Crossing: straight on or back for the whole episode, on ground that has an edge to come to.
        if settings.crossing_probability > 0.0:
            chance, side, speed = uniform["command_crossing"].unbind(1)
            crosses = (episode_length == 0) & (chance < settings.crossing_probability) & self._ends[kind]
            least, most = low[:, 0], high[:, 0]
            back = (most <= 0.0) | ((side < 0.5) & (least < 0.0))
            straight_on = torch.zeros_like(drawn)
            straight_on[:, 0] = torch.clamp(torch.where(back, least, most) * (0.5 + 0.5 * speed), least, most)
            drawn = torch.where(crosses[:, None], straight_on, drawn)
            steps = torch.where(crosses, remaining, steps)
            is_extreme, holds = is_extreme & ~crosses, holds | crosses

        # Reversal: back at once. Crossings are drawn at the start of an episode alone, so their numbers are free later.
        if self._reverses:
            chance, straight_back, _ = uniform["command_crossing"].unbind(1)
            squares = command.square()
            moves, walks = squares.sum(dim=1) > _MOVES, squares[:, :2].sum(dim=1) > _MOVES
            reverses = (episode_length > 0) & (chance < ranges.reversal) & moves
            back = (straight_back < 0.5) & walks
            reversed_ = torch.cat((opposite[:, :2], opposite[:, 2:].masked_fill(back[:, None], 0.0)), dim=1)
            drawn = torch.where(reverses[:, None], reversed_, drawn)
            steps = torch.where(reverses, ranges.interval_steps.long(), steps)
            is_extreme = torch.where(reverses, extreme, is_extreme)
            holds = torch.where(reverses, back, holds)
        return CommandDraw(command=drawn, steps=steps, extreme=is_extreme, holds_heading=holds)

    def held_yaw_rate(self, off: torch.Tensor, *, kind: torch.Tensor, progress: torch.Tensor) -> torch.Tensor:
        """Return yaw rates that lead back to the commanded heading [rad/s], (N,), from its angle to the robot's own [rad], (N,), the kind
        of terrain, (N,) int64, and the fraction of the run, a scalar.
        """
        ranges = self.ranges(kind, progress)
        return torch.clamp(off * self._configuration.heading_gain, ranges.low[:, 2], ranges.high[:, 2])

    def _uniform(
        self, uniform: dict[str, torch.Tensor], ranges: Ranges, way: torch.Tensor, remaining: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return uniform linear speeds that are at least as fast as the rest of the episode needs, (N, 2), and yaw rates, (N, 1)."""
        magnitude, low, high = uniform["command_magnitude"], ranges.low, ranges.high
        command = low + magnitude * (high - low)
        if not self._configuration.dynamic:
            return command[:, :2], command[:, 2:]
        # The published code lets the least speed exceed the range and then always commands the positive end.
        needed = torch.minimum((way / (remaining * self._period))[:, None], ranges.either)
        below, above = (ranges.downward - needed).clamp_min(0.0), (high[:, :2] - needed).clamp_min(0.0)
        negative = uniform["command_sign"] * (below + above + 2e-6) < below + 1e-6
        speed = needed + magnitude[:, :2] * torch.where(negative, below, above)
        return torch.where(negative, -speed, speed), command[:, 2:]
