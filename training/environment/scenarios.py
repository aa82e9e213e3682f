"""Play scenarios (``gaitgauge worst`` writes them) in a share of the training worlds: their ground, start, commands, pushes, patches,
load and latency, each varied a little from episode to episode.

Worlds of scenarios are the last ones; each plays one scenario for good, since a load belongs to a world's body. Everything here has static
shapes and no branch on data, as the rest of a step.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from ...backends.base import PhysicsBackend, PhysicsState, Randomization
from ...files.parsing import one_line
from ...robots.anatomy.body_plan import base_mass
from ...robots.base import Robot
from ...robots.rotation import from_heading
from ...studies.trials.scenario import Failure, Scenario, ScenarioError, load_scenario
from ..configuration import ConfigurationError
from .configuration import EnvironmentConfiguration
from .curriculum import TrainingPalette
from .policy_interface import largest_told
from .terrain_configuration import SCENARIOS, TileConfiguration

_log = logging.getLogger(__name__)

_SIGMA = 0.25
"""Tracking sigma of these worlds."""
_GRID = 0.1
"""Distance between the points at which the ground beyond the height rasters is looked at [m]."""
_LEVEL = 1e-3
"""Largest difference of height that counts as level [m]."""
_ROUNDING = 1e-4
"""Time that single precision may be off by [s]."""
_SIDES = {"forward": (1.0, 0.0), "backward": (-1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0), "side": (0.0, 1.0)}
_COMMAND, _MOMENT, _FRICTION, _LATENCY, _OWN = range(5)
"""Columns of the numbers that an episode draws, and their count; those of its pulls follow."""
_PULL = 5
"""Numbers that a pull draws: begin, length, size, variation, side."""


def read_scenarios(configuration: EnvironmentConfiguration) -> tuple[Scenario, ...]:
    """Return the scenarios of ``environment.scenarios``; a folder stands for its TOML files.

    Raises:
        ConfigurationError: a file that is no scenario, or one that a training world cannot play.
    """
    found: list[Scenario] = []
    for name in configuration.scenarios:
        folder = Path(name)
        names = sorted(map(str, folder.glob("*.toml"))) if folder.is_dir() else [name]
        if not names:
            raise ConfigurationError(
                f"environment.scenarios has the folder {one_line(name, 80)}, which holds no .toml file; give scenario files"
            )
        for each in names:
            try:
                found.append(load_scenario(each))
            except ScenarioError as error:
                raise ConfigurationError(f"environment.scenarios: {error}") from error
    limits = largest_told(configuration)
    for scenario in found:
        for problem in _problems(scenario, configuration, limits):
            raise ConfigurationError(f"environment.scenarios: scenario '{scenario.name}' {problem}")
        for left_out in _left_out(scenario, configuration):
            _log.warning("scenario '%s' %s", scenario.name, left_out)
    return tuple(found)


def _problems(
    scenario: Scenario, configuration: EnvironmentConfiguration, limits: tuple[float, float, float]
) -> Iterator[str]:
    """Yield what a training world cannot play, in sentence parts."""
    for number, leg in enumerate(scenario.commands):
        if leg.until_x is not None or leg.steer:
            yield (
                f"has commands[{number}].{'steer' if leg.steer else 'until_x'}, which depends on where the robot is; training "
                "plays commands by the clock alone, so give seconds and a velocity"
            )
        for axis, told, limit in zip(("forward", "lateral", "turning"), leg.velocity, limits, strict=True):
            if abs(told) > limit + 1e-6:
                yield (
                    f"commands {told:g} {axis} (commands[{number}]), and this training commands at most {limit:g}; raise "
                    "environment.commands.stages and the tiles' command_limits, or leave the scenario out"
                )
    if scenario.seconds > configuration.episode_length:
        yield (
            f"lasts {scenario.seconds:g} s, longer than environment.episode_length, {configuration.episode_length:g} s; raise "
            "that, or leave the scenario out"
        )
    seen, terrain = configuration.observations, configuration.terrain
    edge = (terrain.leave_distance or terrain.promotion_distance) + math.hypot(seen.scan_length, seen.scan_width) / 2
    reach = _reach(scenario)
    if reach > edge:
        along = np.arange(-reach, reach + _GRID, _GRID)
        x, y = np.meshgrid(along, along)
        ground = scenario.terrain()
        change = ground.height(x, y) - ground.height(np.clip(x, -edge, edge), np.clip(y, -edge, edge))
        if np.abs(change).max() > _LEVEL:
            yield (
                f"has ground that changes more than {edge:.1f} m from x = y = 0, where its commands lead to; training knows "
                "no heights there, so bring the ground nearer, or raise environment.terrain.leave_distance"
            )


def _reach(scenario: Scenario) -> float:
    """Return the distance from x = y = 0 that the commands can lead to [m]."""
    start = scenario.start
    way = sum(leg.seconds * math.hypot(*leg.velocity[:2]) for leg in scenario.commands)
    return max(abs(start.x), abs(start.y)) + max(start.spread[:2]) + way


def _left_out(scenario: Scenario, configuration: EnvironmentConfiguration) -> Iterator[str]:
    """Yield what training does not take over, in sentence parts."""
    if scenario.torque_speed_limit != configuration.physics.torque_speed_limit:
        on = "on" if configuration.physics.torque_speed_limit else "off"
        yield f"asks for the opposite of environment.physics.torque_speed_limit, which stays {on} in training"
    if scenario.success.beyond is not None or scenario.success.speed is not None or scenario.failure != Failure():
        yield "says what success or a fall is; training has rewards and ends of its own (environment.termination) instead"


def with_scenarios(
    palette: TrainingPalette, scenarios: Sequence[Scenario], configuration: EnvironmentConfiguration
) -> TrainingPalette:
    """Return the palette with a last kind of ground, ``SCENARIOS``, that has the scenarios' grounds, and its share of the worlds."""
    share = configuration.scenario_share
    others = sum(tile.share for tile in palette.tiles)
    kind = TileConfiguration(
        name=SCENARIOS,
        share=others * share / (1.0 - share),
        command_limits=largest_told(configuration),
        sigma=_SIGMA,
        ends=False,
        stuck=False,
    )
    place = torch.full((1, *palette.index.shape[1:]), len(palette.terrains), dtype=torch.int64)
    return TrainingPalette(
        terrains=(*palette.terrains, *(scenario.terrain() for scenario in scenarios)),
        tiles=(*palette.tiles, kind),
        index=torch.cat((palette.index, place)),
    )


class ScenarioWorlds:
    """The last M worlds, which play S scenarios.

    Attributes:
        first: number of the first of them.
        steps: control steps of each one's episodes, (M,) int64.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        configuration: EnvironmentConfiguration,
        *,
        robot: Robot,
        num_worlds: int,
        terrains: int,
        device: torch.device | str,
    ) -> None:
        """Put the scenarios on the device.

        Args:
            num_worlds: M.
            terrains: number of terrains in the palette, with those of the scenarios at its end.

        Raises:
            ConfigurationError: fewer worlds than scenarios.
        """
        if num_worlds < len(scenarios):
            raise ConfigurationError(
                f"environment.scenarios has {len(scenarios)} scenarios, but environment.scenario_share, "
                f"{configuration.scenario_share:g}, of {configuration.num_envs} worlds is {num_worlds}; raise the share or num_envs"
            )
        self.count, self.first, self.device = num_worlds, configuration.num_envs - num_worlds, device
        self._variation = configuration.scenario_variation
        self._period, self._timestep = configuration.physics.control_period, configuration.physics.timestep
        self._substeps = configuration.physics.substeps
        # in blocks: worlds of teacher and student take turns
        which = torch.arange(num_worlds) * len(scenarios) // num_worlds
        self._own_mass = base_mass(robot)

        def rows(values: Sequence[object]) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32)[which].to(device)

        legs, patches = max(len(s.commands) for s in scenarios), max(len(s.patches) for s in scenarios)
        self._velocity = rows([_padded([leg.velocity for leg in s.commands], legs) for s in scenarios])
        lengths = [_padded([(leg.seconds,) for leg in s.commands], legs, (0.0,)) for s in scenarios]
        self._ends = (rows(lengths)[..., 0].cumsum(dim=1) / self._period).round().long()
        self.steps = self._ends[:, -1]
        self._limits = torch.tensor(largest_told(configuration), device=device)
        self._terrain = (which + terrains - len(scenarios)).to(device)
        self._start = rows([(s.start.x, s.start.y, s.start.yaw) for s in scenarios])
        self._spread = rows([s.start.spread for s in scenarios])
        self._friction = rows([s.friction for s in scenarios])
        spans = [_padded([(p.begin, p.begin + p.seconds, p.friction) for p in s.patches], patches) for s in scenarios]
        self._patches = rows(spans).view(num_worlds, patches, 3)
        loads = [(s.payload.kilograms, *s.payload.place) if s.payload else (0.0, 0.0, 0.0, 0.0) for s in scenarios]
        self._load = rows(loads)
        pulls = [list(_pulls(s)) for s in scenarios]
        self._most = max(map(len, pulls))
        self._pull = rows([_padded(p, self._most, (0.0,) * 9) for p in pulls]).view(num_worlds, self._most, 9)
        late = rows([-1.0 if s.latency is None else s.latency for s in scenarios])
        self._is_late = late >= 0.0 if any(s.latency is not None for s in scenarios) else None
        self._latency = late.clamp_min(0.0)
        longest = max((s.latency or 0.0) for s in scenarios) * (1.0 + self._variation)
        self._periods = 1 + round(longest / self._timestep) // self._substeps if self._is_late is not None else 0
        self._pose = torch.tensor(robot.default_joint_position, device=device)
        self._now = self._friction.clone()
        self._force = torch.zeros(configuration.num_envs, 3, device=device)
        self._row = torch.arange(num_worlds, device=device)
        self._drawn = torch.full((num_worlds, self.columns), 0.5, device=device)
        self._targets = self._pose.repeat(num_worlds, max(self._periods, 1), 1)
        self._finished = torch.zeros(2, device=device)

    @property
    def columns(self) -> int:
        """Return how many uniform numbers a world needs for an episode."""
        return _OWN + _PULL * self._most

    def by_name(self) -> dict[str, torch.Tensor]:
        """Return what must be saved."""
        return {"drawn": self._drawn, "targets": self._targets, "finished": self._finished}

    def load(self, bodies: dict[str, torch.Tensor], generator: torch.Generator) -> None:
        """Add the payloads to drawn bodies, in place; each world's load differs from the file's by a factor of its own."""
        factor = torch.empty(self.count, device=self.device).uniform_(-1.0, 1.0, generator=generator)
        mass = self._load[:, 0] * (1.0 + self._variation * factor)
        bodies["base_mass_offset"][self.first :] += mass
        bodies["base_com_offset"][self.first :] += (mass / (mass + self._own_mass))[:, None] * self._load[:, 1:]

    # ---- inside a step: static shapes, no branch on data ----------------------------------------------------------

    def begin(self, worlds: torch.Tensor, terrain_index: torch.Tensor, uniform: torch.Tensor) -> None:
        """Begin the masked worlds' next episode, in place: (N,) bool, (N,) int64, numbers in [0, 1), (N, columns)."""
        begun = worlds[self.first :]
        torch.where(begun[:, None], uniform[self.first :], self._drawn, out=self._drawn)
        torch.where(begun[:, None, None], self._pose, self._targets, out=self._targets)
        terrain_index[self.first :].copy_(self._terrain)

    def count_ends(self, done: torch.Tensor, failed: torch.Tensor) -> None:
        """Add up ends and falls of episodes, (N,) bool each."""
        self._finished.add_(torch.stack((done[self.first :].sum(), failed[self.first :].sum())))

    def place(self, xy: torch.Tensor, yaw: torch.Tensor, uniform: torch.Tensor) -> None:
        """Write the starts, in place: ``xy`` (N, 2) [m], ``yaw`` (N,) [rad]; ``uniform`` in [−1, 1), (N, 3)."""
        start = self._start + uniform[self.first :] * self._spread
        xy[self.first :], yaw[self.first :] = start[:, :2], start[:, 2]

    def rest(self, joints: torch.Tensor, twist: torch.Tensor) -> None:
        """Let robots begin at rest in their standing pose, in place: (N, J), (N, 6)."""
        joints[self.first :], twist[self.first :] = self._pose, 0.0

    def tell(
        self, command: torch.Tensor, due: torch.Tensor, holds_heading: torch.Tensor, episode_length: torch.Tensor
    ) -> None:
        """Write the commands of the present time, (N, 3), where they are new, (N,) bool, and that no heading is held, in place."""
        steps = episode_length[self.first :, None]
        phase = (steps >= self._ends).sum(dim=1).clamp(max=self._ends.shape[1] - 1)
        told = self._velocity[self._row, phase] * (1.0 + self._signed(_COMMAND))[:, None]
        command[self.first :] = torch.clamp(told, -self._limits, self._limits)
        due[self.first :] = ((steps == self._ends) | (steps == 0)).any(dim=1)
        holds_heading[self.first :] = False

    def prepare(self, state: PhysicsState, episode_length: torch.Tensor) -> None:
        """Compute the friction and the external forces of the next control step; ``episode_length`` is (N,) int64."""
        time = (episode_length[self.first :] * self._period - self._signed(_MOMENT))[:, None] + _ROUNDING
        begin, end, slippery = self._patches.unbind(2)
        now = self._friction
        for number in range(self._patches.shape[1]):
            on = (time[:, 0] >= begin[:, number]) & (time[:, 0] < end[:, number])
            now = torch.where(on, slippery[:, number], now)
        self._now.copy_(now * (1.0 + self._signed(_FRICTION)))
        drawn = self._drawn[:, _OWN:].view(self.count, self._most, _PULL)
        low, high, way = self._pull[..., 0:3], self._pull[..., 3:6], self._pull[..., 6:8]
        begin, seconds, newtons = (low + drawn[..., :3] * (high - low)).unbind(2)
        newtons = newtons * (1.0 + self._variation * (2.0 * drawn[..., 3] - 1.0))
        turned = torch.where((self._pull[..., 8] > 0.0) & (drawn[..., 4] < 0.5), -newtons, newtons)
        acts = (time >= begin) & (time < begin + seconds)
        forward, left = (way * (turned * acts)[..., None]).sum(dim=1).unbind(-1)
        self._force[self.first :].copy_(from_heading(state.base_quaternion_w[self.first :], forward, left))

    # ---- around the physics ---------------------------------------------------------------------------------------

    def apply(self, backend: PhysicsBackend, friction: torch.Tensor) -> None:
        """Write what was prepared into the physics; ``friction`` is that of the other worlds, (N,)."""
        backend.randomize(Randomization(friction=torch.cat((friction[: self.first], self._now))))
        if self._most:
            backend.apply_force(self._force)

    def late(self, targets: torch.Tensor, delay: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the targets that act in this control step, (N, J), and the substeps for which those before them still act, (N,); remembers
        ``targets``.
        """
        if self._is_late is None:
            return targets, delay
        self._targets.copy_(torch.cat((targets[self.first :, None], self._targets[:, :-1]), dim=1))
        return self.acting(targets), self._delay(delay)

    def acting(self, targets: torch.Tensor) -> torch.Tensor:
        """Return the targets that act, (N, J), where ``targets`` are the policy's last."""
        if self._is_late is None:
            return targets
        whole = self._late() // self._substeps
        old = self._targets[self._row, whole]
        return torch.cat((targets[: self.first], torch.where(self._is_late[:, None], old, targets[self.first :])))

    def _delay(self, delay: torch.Tensor | None) -> torch.Tensor:
        assert self._is_late is not None
        drawn = torch.zeros(self.first + self.count, dtype=torch.int64, device=self.device) if delay is None else delay
        rest = self._late() % self._substeps
        return torch.cat((drawn[: self.first], torch.where(self._is_late, rest, drawn[self.first :])))

    def _late(self) -> torch.Tensor:
        return (self._latency * (1.0 + self._signed(_LATENCY)) / self._timestep).round().long()

    def _signed(self, column: int) -> torch.Tensor:
        """Return each world's deviation of this episode, within ± the variation, (M,)."""
        return self._variation * (2.0 * self._drawn[:, column] - 1.0)

    def log(self) -> dict[str, torch.Tensor]:
        """Return the share of the scenarios that ended with a fall since the last log that had any; sums start anew."""
        episodes, falls = self._finished.clone().unbind()
        self._finished.zero_()
        return {"Scenarios/falls": falls / episodes.clamp_min(1.0), "Scenarios/episodes": episodes}


def _padded(
    rows: Sequence[tuple[float, ...]], count: int, filling: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> list[tuple[float, ...]]:
    """Return rows, repeated fillings behind them."""
    return [*rows, *[filling] * (count - len(rows))]


def _pulls(scenario: Scenario) -> Iterator[tuple[float, ...]]:
    """Yield every pull: earliest begin, shortest time, least force, the largest of these; forward, left, and 1 for either side."""
    for force in scenario.forces:
        later = 0.0
        while force.begin[0] + later < scenario.seconds:
            begin = (force.begin[0] + later, force.begin[1] + later)
            low, high = zip(begin, force.seconds, force.newtons, strict=True)
            yield (*low, *high, *_SIDES[force.direction], float(force.direction == "side"))
            if force.every is None:
                break
            later += force.every
