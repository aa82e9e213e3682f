"""The torch part of an environment step, as a list of its parts: inputs, ends, rewards, log, levels, pushes, the next
episodes; and observing.

Two functions without arguments, ``after_physics`` and ``observe``, read fixed tensors (inputs, memory, uniform numbers) and have static
shapes, no random state and no branch on data, so that each can be captured in a CUDA graph. Between them the environment resets,
randomizes and pushes the physics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ...backends.base import PhysicsState
from ...policy.contract import PolicyContract
from ...policy.ground import Ground
from ...policy.observation import ObservationBuilder
from ...robots.base import JointParameters, Robot
from ...studies.trials.scenario import Scenario
from ...terrains.height_scan import HeightRasters, scan_pattern
from .commands import COMMAND_COLUMNS, CommandGenerator
from .configuration import EnvironmentConfiguration
from .curriculum import Levels, TrainingPalette
from .domain_randomization import MOTOR_COLUMNS, MotorParameters
from .episode_log import METRICS, EpisodeLog
from .events import EpisodeStart, EpisodeStarts, Latency, Push, Pushes
from .memory import EnvironmentMemory
from .observations import Observations, Observer
from .own_terms import resolve_class
from .randomness import UniformColumns
from .rewards import RewardFunction
from .scenarios import ScenarioWorlds
from .step_reader import StepReader
from .terminations import Terminations


@dataclass(frozen=True, kw_only=True)
class StepResult:
    """Results of a step."""

    reward: torch.Tensor
    """(N,)."""
    done: torch.Tensor
    """(N,) bool."""
    time_out: torch.Tensor
    """Ends that are no failure, (N,) bool."""
    start: EpisodeStart
    """Starts of the next episodes, for worlds at the end of one."""
    push: Push | None
    """Pushed bases, None where there are no pushes."""


class EnvironmentStep:
    """All tensors and formulas of the training environment that are not physics."""

    def __init__(
        self,
        configuration: EnvironmentConfiguration,
        *,
        robot: Robot,
        parameters: JointParameters,
        contract: PolicyContract,
        palette: TrainingPalette,
        kind: torch.Tensor,
        inputs: PhysicsState,
        generator: torch.Generator,
        scenarios: Sequence[Scenario] = (),
    ) -> None:
        """Allocate everything.

        Args:
            kind: kind of tile of every world, (N,) int64.
            inputs: tensors that the physics state is copied into before each part.
            scenarios: those that the worlds of the palette's last kind play.

        Raises:
            ConfigurationError: a setting that makes no sense, or a term of one's own that is not there.
        """
        self.configuration, self.inputs, self.kind = configuration, inputs, kind
        device, num_envs, joints = kind.device, len(kind), robot.num_joints
        seen, terrain, period = configuration.observations, configuration.terrain, configuration.physics.control_period
        self.max_episode_length = round(configuration.episode_length / period)
        self.rate = torch.tensor(1.0 / configuration.schedule.horizon_steps, device=device)
        """Fraction of the run that a step is; on the device, since compiled and recorded functions read it."""
        self.default_pose = torch.tensor(robot.default_joint_position, device=device)
        self.action = torch.zeros(num_envs, contract.num_joints, device=device)
        self.scan = scan_pattern(seen.scan_length, seen.scan_width, seen.scan_spacing, device)
        reach = math.hypot(seen.scan_length, seen.scan_width) / 2
        edge = terrain.leave_distance or terrain.promotion_distance
        rasters = HeightRasters(palette.terrains, half_size=edge + reach, cell=seen.scan_cell, device=device)
        longest = torch.full((num_envs,), self.max_episode_length, device=device)
        self.scenarios = None
        if scenarios:
            self.scenarios = ScenarioWorlds(
                scenarios,
                configuration,
                robot=robot,
                num_worlds=int((kind == len(palette.tiles) - 1).sum()),
                terrains=len(palette.terrains),
                device=device,
            )
            longest[self.scenarios.first :] = self.scenarios.steps

        self.read = StepReader(
            configuration,
            robot=robot,
            parameters=parameters,
            palette=palette,
            kind=kind,
            scan=self.scan,
            rasters=rasters,
            longest=longest if scenarios else self.max_episode_length,
        )
        self.rewards = RewardFunction(configuration.rewards, period, kind, palette.tiles)
        self.terminations = Terminations(configuration.termination)
        drawn, where = configuration.commands, "environment.commands.generator"
        self.commands = resolve_class(drawn.generator, where, CommandGenerator, "draw", "held_yaw_rate")(
            drawn,
            tiles=palette.tiles,
            control_period=period,
            max_episode_length=self.max_episode_length,
            device=device,
        )
        self.levels = Levels(terrain, palette, kind)
        self.latency = Latency(configuration.randomization, configuration.physics)
        self.motors = MotorParameters(
            configuration.randomization, num_envs, joints, device, offset=parameters.target_offset
        )
        self.starts = EpisodeStarts(
            configuration.reset, terrain, robot=robot, rasters=rasters, device=device, scenarios=self.scenarios
        )
        self.pushes = Pushes(configuration.push, num_envs, control_period=period, device=device)
        self.log = EpisodeLog(
            rewards=self.rewards.names,
            terminations=self.terminations.names,
            palette=palette,
            kind=kind,
            control_period=period,
        )
        self.memory = EnvironmentMemory.allocate(
            num_envs,
            joints=joints,
            actions=contract.num_joints,
            feet=len(robot.foot_names),
            history=seen.history_length,
            frame=contract.frame_width,
            terms=len(self.rewards.names),
            ends=len(self.terminations.names),
            metrics=len(METRICS),
            clocks=len(contract.observation) if configuration.gait.period else 0,
            device=device,
        )
        ground = Ground(rasters, self.memory.terrain_index, delay=seen.scan_delay)
        self._builder = ObservationBuilder(contract, robot, num_envs, device, ground)
        if configuration.gait.period:
            self._builder.clocks = self.memory.clocks
        self.observer = Observer(
            seen,
            contract=contract,
            builder=self._builder,
            scan=self.scan,
            rasters=rasters,
            torque_limit=torch.tensor(parameters.torque_limit, device=device),
        )
        self.uniform = UniformColumns(
            {
                **{"noise": contract.frame_width, "delay": 1, "place": 2, "spread": 1, "yaw": 1, "joints": joints},
                **{"twist": 6, "push": 5, "level": 1, "variant": 1},
                **dict.fromkeys(MOTOR_COLUMNS, joints),
                **COMMAND_COLUMNS,
                **({"scenario": self.scenarios.columns, "scenario_start": 3} if self.scenarios else {}),
            },
            num_envs,
            generator,
        )

    def seen_before(self) -> dict[str, torch.Tensor]:
        """Return what the policy's later frames take from earlier ones, beside ``memory``; the tensors themselves, by name."""
        return self._builder.by_name()

    def targets(self) -> torch.Tensor:
        """Return the joint targets of the present action [rad], (N, J)."""
        return self._builder.targets(self.action)

    def delay(self) -> torch.Tensor | None:
        """Return substeps for which the previous target still acts, (N,) int64; None if there is no latency."""
        return self.latency(self.uniform)

    def progress(self) -> torch.Tensor:
        """Return the fraction of the run, scalar."""
        return self.memory.step.float() * self.rate

    def after_physics(self) -> StepResult:
        """Judge the step, update the memory, and prepare the next episode of worlds at the end of one."""
        memory = self.memory
        memory.step.add_(1)
        memory.episode_length.add_(1)
        memory.turn_commanded_heading(self.configuration.physics.control_period)
        progress = self.progress()
        inputs = self.read(self.inputs, memory, self.action, progress)
        ends = self.terminations(inputs)
        done = ends.failed | ends.time_out
        rewards = self.rewards(inputs, progress).masked_fill(inputs.diverged[:, None], 0.0)
        self.log.record(memory, inputs, rewards, ends, done)
        memory.remember(inputs)
        self.levels.follow(memory, inputs)
        push = self.pushes(done, self.inputs, memory, self.uniform)
        if self.scenarios is not None:
            self.scenarios.count_ends(done, ends.failed)
            if push is not None:
                push.worlds[self.scenarios.first :] = False  # they have pushes of their own
        # A diverged world is the engine's failure: it moves no level, wherever it was flung.
        memory.moves_level.logical_and_(~inputs.diverged)
        start = self.begin_episodes(done, ends.failed, progress, inputs.heading_xy)
        return StepResult(reward=rewards.sum(dim=1), done=done, time_out=ends.time_out, start=start, push=push)

    def begin_episodes(
        self, worlds: torch.Tensor, failed: torch.Tensor, progress: torch.Tensor, heading_xy: torch.Tensor
    ) -> EpisodeStart:
        """Draw the next episode of the masked worlds, and new commands where they are due; the memory is updated in place. ``heading_xy``
        are the headings at which the other worlds' episodes go on, (N, 2).
        """
        memory, uniform = self.memory, self.uniform
        self.levels.move(memory, uniform, worlds, failed)
        memory.begin_episode(worlds)
        if self.scenarios is not None:
            self.scenarios.begin(worlds, memory.terrain_index, uniform["scenario"])
        due = self._new_commands(worlds, progress)
        self.motors.redraw(uniform.span(MOTOR_COLUMNS[0], MOTOR_COLUMNS[-1]), worlds)
        start = self.starts(worlds, memory, uniform)
        own = torch.where(worlds[:, None], start.heading_xy, heading_xy)
        torch.where(due[:, None], own, memory.commanded_heading, out=memory.commanded_heading)
        if self.configuration.commands.heading_gain > 0:
            self._hold_heading(own, progress)
        return start

    def _hold_heading(self, own: torch.Tensor, progress: torch.Tensor) -> None:
        """Write the command yaw rates that lead straight commands back to their heading; ``own`` are the robots' headings, (N, 2)."""
        memory, wanted = self.memory, self.memory.commanded_heading
        off = torch.atan2(own[:, 0] * wanted[:, 1] - own[:, 1] * wanted[:, 0], (own * wanted).sum(dim=1))
        yaw = self.commands.held_yaw_rate(off, kind=self.kind, progress=progress)
        memory.command[:, 2].copy_(torch.where(memory.holds_heading, yaw, memory.command[:, 2]))

    def _new_commands(self, begun: torch.Tensor, progress: torch.Tensor) -> torch.Tensor:
        """Draw new commands where they are due, and return where, (N,) bool."""
        memory = self.memory
        memory.command_steps.sub_(1)
        due = begun | (memory.command_steps <= 0)
        drawn = self.commands.draw(
            {name: self.uniform[name] for name in COMMAND_COLUMNS},
            kind=self.kind,
            progress=progress,
            episode_length=memory.episode_length,
            issued=memory.issued,
            command=memory.command,
            extreme=memory.command_extreme,
            holds_heading=memory.holds_heading,
        )
        torch.where(due[:, None], drawn.command, memory.command, out=memory.command)
        torch.where(due, drawn.steps, memory.command_steps, out=memory.command_steps)
        torch.where(due, drawn.extreme, memory.command_extreme, out=memory.command_extreme)
        torch.where(due, drawn.holds_heading, memory.holds_heading, out=memory.holds_heading)
        memory.issued.add_(drawn.command[:, :2] * due[:, None])
        if self.scenarios is not None:
            self.scenarios.tell(memory.command, due, memory.holds_heading, memory.episode_length)
        if self.configuration.rewards.turn_error_time:
            memory.turn_error.masked_fill_(due, 0.0)
        return due

    def observe(self) -> Observations:
        """Return observations of the present state, which is fresh for worlds that were just reset or pushed."""
        if self.scenarios is not None:
            self.scenarios.prepare(self.inputs, self.memory.episode_length)
        return self.observer(self.inputs, self.memory, self.uniform)
