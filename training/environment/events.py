"""Change the physics from outside: starts of episodes, pushes, and late actions.

Differences between worlds are drawn in ``domain_randomization.py``. All draws are functions of uniform numbers, without branches on data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ...backends.base import PhysicsOptions, PhysicsState, ResetState
from ...robots.anatomy.body_plan import joint_ranges
from ...robots.base import Robot
from ...robots.rotation import from_yaw
from ...terrains.height_scan import HeightRasters, place_pattern, scan_pattern
from .configuration import PushConfiguration, RandomizationConfiguration, ResetConfiguration
from .memory import EnvironmentMemory
from .randomness import UniformColumns
from .scenarios import ScenarioWorlds
from .terrain_configuration import TerrainConfiguration


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """Start of the masked worlds' next episode."""

    worlds: torch.Tensor
    """(N,) bool."""
    state: ResetState
    """Poses and velocities."""
    heading_xy: torch.Tensor
    """Unit vector of the base's x axis in the world's xy plane, (N, 2)."""


@dataclass(frozen=True, kw_only=True)
class Push:
    """New velocities of pushed bases, the arguments of ``PhysicsBackend.push``."""

    worlds: torch.Tensor
    """(N,) bool."""
    linear_velocity_w: torch.Tensor
    """World frame, NaN where it stays [m/s], (N, 3)."""
    angular_velocity_b: torch.Tensor
    """Body frame [rad/s], (N, 3)."""


class EpisodeStarts:
    """Draws where and how episodes begin."""

    def __init__(
        self,
        reset: ResetConfiguration,
        terrain: TerrainConfiguration,
        *,
        robot: Robot,
        rasters: HeightRasters,
        device: torch.device | str,
        scenarios: ScenarioWorlds | None = None,
    ) -> None:
        self._reset, self._terrain, self._rasters, self._scenarios = reset, terrain, rasters, scenarios
        self._footprint = scan_pattern(*reset.footprint, 0.1, device)
        self._clearance = robot.stand_height if reset.clearance is None else reset.clearance
        self._default_pose = torch.tensor(robot.default_joint_position, device=device)
        self._lower, self._upper = torch.from_numpy(joint_ranges(robot)).float().to(device).unbind(1)
        self._spread, self._jitter = (
            torch.tensor(distance, device=device) for distance in (terrain.spread_distance, terrain.spawn_jitter)
        )

    def __call__(self, worlds: torch.Tensor, memory: EnvironmentMemory, uniform: UniformColumns) -> EpisodeStart:
        """Return a start for the masked worlds, above the highest ground below the robot; the memory learns whether their episode counts
        for the curriculum.
        """
        spread = uniform["spread"][:, 0] < self._terrain.spread_probability
        counts = ~spread if self._terrain.curriculum else worlds
        torch.where(worlds, counts, memory.moves_level, out=memory.moves_level)
        xy = uniform.signed("place") * torch.where(spread, self._spread, self._jitter)[:, None]
        yaw = uniform.between("yaw", -math.pi, math.pi)[:, 0]
        if self._scenarios is not None:
            self._scenarios.place(xy, yaw, uniform.signed("scenario_start"))
            memory.moves_level[self._scenarios.first :] = False
        direction = torch.stack((torch.cos(yaw), torch.sin(yaw)), dim=1)
        footprint = place_pattern(self._footprint, xy, direction)
        ground = self._rasters.height(memory.terrain_index, footprint).amax(dim=1)
        joints = self._default_pose * uniform.between("joints", *self._reset.joint_scale)
        twist = uniform.signed("twist") * self._reset.velocity
        if self._scenarios is not None:
            self._scenarios.rest(joints, twist)
        state = ResetState(
            base_position=torch.cat((xy, ground[:, None] + self._clearance), dim=1),
            base_quaternion=from_yaw(yaw),
            base_linear_velocity=twist[:, :3],
            base_angular_velocity=twist[:, 3:],
            joint_position=torch.clamp(joints, self._lower, self._upper),
        )
        return EpisodeStart(worlds=worlds, state=state, heading_xy=direction)


class Pushes:
    """Sudden changes of the base's velocity, each world on a clock of its own."""

    def __init__(
        self, configuration: PushConfiguration, num_envs: int, *, control_period: float, device: torch.device | str
    ) -> None:
        self._stays = torch.full((num_envs, 1), math.nan, device=device)
        self._add = configuration.add
        self.steps = round(configuration.interval / control_period)
        linear, angular = configuration.linear, configuration.angular
        self._size = torch.tensor((linear, linear, angular, angular, angular), device=device)

    def __call__(
        self, done: torch.Tensor, state: PhysicsState, memory: EnvironmentMemory, uniform: UniformColumns
    ) -> Push | None:
        """Return the pushes of worlds that are due and go on; None where no world is ever pushed."""
        if self.steps == 0:
            return None
        due = ((memory.episode_length + memory.push_phase) % self.steps == 0) & ~done
        linear, angular = (uniform.signed("push") * self._size).split((2, 3), dim=1)
        if self._add:
            linear = linear + state.base_linear_velocity_w[:, :2]
            angular = angular + state.base_angular_velocity_b
        return Push(worlds=due, linear_velocity_w=torch.cat((linear, self._stays), dim=1), angular_velocity_b=angular)


class Latency:
    """For how long the previous target still acts."""

    def __init__(self, configuration: RandomizationConfiguration, physics: PhysicsOptions) -> None:
        self._first, self._last = (min(round(t / physics.timestep), physics.substeps) for t in configuration.delay)

    def __call__(self, uniform: UniformColumns) -> torch.Tensor | None:
        """Return substeps, (N,) int64; None if there is no latency."""
        if self._last == 0:
            return None
        spread = self._last - self._first
        drawn = (uniform["delay"][:, 0] * (spread + 1)).long().clamp(max=spread)
        return drawn if self._first == 0 else self._first + drawn
