"""The torch part of an environment step: judging what the physics did, preparing new episodes, and observing.

Two functions without arguments, ``after_physics`` and ``observe``, read fixed tensors (inputs, memory, uniform
numbers) and have static shapes, no random state and no branch on data, so that each can be captured in a CUDA graph.
Between them the environment resets, randomizes and pushes the physics.
"""

from __future__ import annotations

import math

import mujoco
import torch

from ..backends.base import PhysicsState
from ..policy.contract import PolicyContract
from ..policy.observation import ObservationBuilder
from ..robots.base import JointParameters, Robot
from ..robots.rotation import from_yaw, rotate_inverse
from .commands import COMMAND_COLUMNS, CommandGenerator
from .curriculum import TrainingPalette, next_level
from .domain_randomization import MOTOR_COLUMNS, MotorParameters
from .environment_configuration import EnvironmentConfiguration
from .environment_memory import EnvironmentMemory
from .height_scan import HeightRasters, heading, heading_and_upright, place_pattern, scan_pattern
from .observations import add_noise, height_entries, noise_amplitude, privileged_state, push_history
from .randomness import UniformColumns
from .rewards import RewardFunction, commanded_to_move, progress_share
from .step_inputs import StepInputs
from .step_records import METRICS, EpisodeStart, Observations, Verdict
from .terminations import STUCK_SHORTFALL, Terminations


def joint_ranges(robot: Robot) -> torch.Tensor:
    """Lower and upper limit of every joint of the robot's model [rad], (J, 2)."""
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    return torch.tensor([list(model.joint(name).range) for name in robot.joint_names], dtype=torch.float32)


class StepProgram:
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
    ) -> None:
        """Allocate everything.

        Args:
            configuration: the environment's settings.
            robot: the robot.
            parameters: its joint constants.
            contract: the policy's interface, one frame of observation.
            palette: the tiles.
            kind: kind of tile of every world, (N,) int64.
            inputs: tensors that the physics state is copied into before each part.
            generator: where uniform numbers come from.
        """
        self.configuration = configuration
        self.inputs = inputs
        self.kind = kind
        self.device = device = kind.device
        num_envs, joints, feet = len(kind), robot.num_joints, len(robot.foot_names)
        self.period = configuration.physics.control_period
        self.max_episode_length = round(configuration.episode_length / self.period)
        self.num_levels = palette.num_levels
        self._tile_index = palette.index.to(device)
        self._builder = ObservationBuilder(contract, robot, num_envs, device)
        self.rewards = RewardFunction(configuration.rewards, self.period, device)
        self.terminations = Terminations(configuration.termination)
        self.commands = CommandGenerator(
            configuration.commands,
            terrain_limits=[tile.command_limits for tile in palette.tiles],
            control_period=self.period,
            max_episode_length=self.max_episode_length,
            device=device,
        )
        self.motors = MotorParameters(configuration.randomization, num_envs, joints, device)
        self.memory = EnvironmentMemory.allocate(
            num_envs,
            joints=joints,
            feet=feet,
            history=configuration.observations.history_length,
            frame=contract.frame_width,
            terms=len(self.rewards.names),
            ends=len(self.terminations.names),
            metrics=len(METRICS),
            device=device,
        )
        self.uniform = UniformColumns(
            {
                "noise": contract.frame_width,
                "delay": 1,
                "place": 2,
                "spread": 1,
                "yaw": 1,
                "joints": joints,
                "twist": 6,
                "push": 5,
                "level": 1,
                "variant": 1,
                **dict.fromkeys(MOTOR_COLUMNS, joints),
                **COMMAND_COLUMNS,
            },
            num_envs,
            generator,
        )
        self.action = torch.zeros(num_envs, joints, device=device)
        self._constants(robot, parameters, contract, palette)

    def _constants(
        self, robot: Robot, parameters: JointParameters, contract: PolicyContract, palette: TrainingPalette
    ) -> None:
        """Put everything that never changes on the device."""
        settings, device = self.configuration, self.device
        seen = settings.observations
        self.scan = scan_pattern(seen.scan_length, seen.scan_width, seen.scan_spacing, device)
        self._history_start = contract.history.start
        near = (self.scan[:, 0].abs() <= 0.2 + 1e-4) & (self.scan[:, 1].abs() <= 0.15 + 1e-4)
        self._trunk_points = self.scan[near]
        self._footprint = scan_pattern(0.5, 0.4, 0.1, device)
        reach = math.hypot(seen.scan_length, seen.scan_width) / 2
        edge = settings.terrain.leave_distance or settings.terrain.promotion_distance
        self.rasters = HeightRasters(palette.terrains, half_size=edge + reach, cell=seen.scan_cell, device=device)
        self.noise = noise_amplitude(contract, seen.noise, device)
        self.default_pose = torch.tensor(robot.default_joint_position, device=device)
        self.torque_limit = torch.tensor(parameters.torque_limit, device=device)
        ranges = joint_ranges(robot).to(device)
        self.joint_lower, self.joint_upper = ranges.unbind(1)
        middle, half = ranges.mean(dim=1), 0.5 * (self.joint_upper - self.joint_lower) * settings.rewards.soft_limit
        self.soft_lower, self.soft_upper = middle - half, middle + half
        self._hips = self._indices(robot.joint_names, "hip")
        bodies = robot.collision_bodies
        self._base = bodies.index(robot.base_body)
        self._touching = torch.cat((self._indices(bodies, "thigh"), self._indices(bodies, "calf")))
        sigma = torch.tensor([tile.sigma for tile in palette.tiles], device=device)[self.kind]
        self._sigma_growth = sigma - settings.rewards.tracking_sigma
        self._difficulty = (torch.exp(torch.arange(1, self.num_levels + 1, device=device) * 0.1) - 1.0).clamp(max=1.0)
        ends = torch.tensor([tile.ends for tile in palette.tiles], device=device)[self.kind]
        leave = settings.terrain.leave_distance
        never = torch.full((len(self.kind),), math.inf, device=device)
        self._leave = never if leave is None else torch.where(ends, torch.full_like(never, leave), never)
        r = settings.rewards
        low = torch.tensor((r.sigma_linear_range[0], r.sigma_linear_range[0], r.sigma_yaw_range[0]), device=device)
        high = torch.tensor((r.sigma_linear_range[1], r.sigma_linear_range[1], r.sigma_yaw_range[1]), device=device)
        self._sigma_low, self._sigma_rate = low, 1.0 / (high - low)
        self._clearance = robot.stand_height if settings.reset.clearance is None else settings.reset.clearance
        first, last = (round(t / settings.physics.timestep) for t in settings.randomization.delay)
        self._delay = (min(first, settings.physics.substeps), min(last, settings.physics.substeps))
        self.push_steps = round(settings.push.interval / self.period)
        push = settings.push
        self._push_size = torch.tensor(
            (push.linear, push.linear, push.angular, push.angular, push.angular), device=device
        )
        self._stays = torch.full((len(self.kind), 1), math.nan, device=device)
        self._one = torch.ones(len(self.kind), 1, device=device)
        terrain = settings.terrain
        self._spread_distance, self._spawn_jitter = (
            torch.tensor(distance, device=device) for distance in (terrain.spread_distance, terrain.spawn_jitter)
        )

    def _indices(self, names: tuple[str, ...], part: str) -> torch.Tensor:
        found = [i for i, name in enumerate(names) if part in name]
        return torch.tensor(found, dtype=torch.int64, device=self.device)

    # --- before the physics -----------------------------------------------------------------------------------------

    def targets(self) -> torch.Tensor:
        """Joint targets of the present action [rad], (N, J)."""
        return self._builder.targets(self.action)

    def delay(self) -> torch.Tensor | None:
        """Substeps for which the previous target still acts, (N,) int64; None if there is no latency."""
        first, last = self._delay
        if last == 0:
            return None
        drawn = (self.uniform["delay"][:, 0] * (last - first + 1)).long().clamp(max=last - first)
        return drawn if first == 0 else first + drawn

    def progress(self) -> torch.Tensor:
        """Fraction of the run, scalar."""
        return self.memory.step.float() * (1.0 / self.configuration.schedule.horizon_steps)

    # --- after the physics ------------------------------------------------------------------------------------------

    def sigma(self) -> torch.Tensor:
        """Tracking width of every command axis, (N, 3) (paper, dynamic velocity tracking precision adjustment)."""
        base = self.configuration.rewards.tracking_sigma
        command = self.memory.command
        if not self.configuration.rewards.dynamic_sigma:
            return torch.full_like(command, base)
        speed = ((command.abs() - self._sigma_low) * self._sigma_rate).clamp(0.0, 1.0)
        return base + speed * (self._difficulty[self.memory.level] * self._sigma_growth)[:, None]

    def after_physics(self) -> Verdict:
        """Judge the step, update the memory, and prepare the next episode of the worlds whose episode is over."""
        state, memory, settings = self.inputs, self.memory, self.configuration
        memory.step.add_(1)
        memory.episode_length.add_(1)
        progress = self.progress()

        velocity_b = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)
        heading_xy, upright = heading_and_upright(state.base_quaternion_w)
        touching = state.body_contact_force_w.norm(dim=-1)

        fast = state.joint_velocity.abs().amax(dim=1)
        total = state.base_position_w.sum(dim=1) + velocity_b.sum(dim=1) + state.joint_position.sum(dim=1)
        # Both comparisons are false for NaN.
        sound = (total.abs() < math.inf) & (fast <= settings.termination.joint_velocity)
        diverged = state.diverged | ~sound
        inputs = self._step_inputs(velocity_b, heading_xy, upright, touching, diverged, progress)
        self._remember_shortfall(inputs)
        ends = self.terminations(inputs)
        done = ends.failed | ends.time_out

        terms = self.rewards(inputs, progress).masked_fill(diverged[:, None], 0.0)
        self._record(terms, inputs, ends.by_rule, done, diverged)

        memory.previous_action.copy_(memory.action)
        memory.action.copy_(self.action)
        memory.joint_acceleration.copy_(inputs.joint_acceleration)
        memory.joint_velocity.copy_(state.joint_velocity)
        memory.joint_torque.copy_(state.joint_torque)
        memory.foot_force.copy_(state.foot_contact_force_w.norm(dim=-1))
        self._follow_commands(inputs.distance, heading_xy)
        push, push_linear, push_angular = self._push(done)
        # A diverged world is the engine's failure: it moves no level.
        start = self.begin_episodes(done, ends.failed & ~diverged, progress)
        return Verdict(
            reward=terms.sum(dim=1),
            done=done,
            time_out=ends.time_out,
            start=start,
            push=push,
            push_linear_velocity=push_linear,
            push_angular_velocity=push_angular,
        )

    def _step_inputs(
        self,
        velocity_b: torch.Tensor,
        heading_xy: torch.Tensor,
        upright: torch.Tensor,
        touching: torch.Tensor,
        diverged: torch.Tensor,
        progress: torch.Tensor,
    ) -> StepInputs:
        state, memory, settings = self.inputs, self.memory, self.configuration.rewards
        base = state.base_position_w
        points = torch.cat(
            (place_pattern(self._trunk_points, base[:, :2], heading_xy), state.foot_position_w[..., :2]), dim=1
        )
        ground = self.rasters.height(memory.terrain_index, points)
        trunk = len(self._trunk_points)
        below_base = ground[:, :trunk].mean(dim=1)
        below_feet = ground[:, trunk:] if settings.foot_height_over == "foot" else below_base[:, None]
        return StepInputs(
            base_linear_velocity_b=velocity_b,
            base_angular_velocity_b=state.base_angular_velocity_b,
            base_quaternion_w=state.base_quaternion_w,
            base_height=base[:, 2] - below_base,
            command=memory.command,
            sigma=self.sigma(),
            joint_position=state.joint_position,
            joint_velocity=state.joint_velocity,
            joint_acceleration=(state.joint_velocity - memory.joint_velocity) * (1.0 / self.period),
            joint_torque=state.joint_torque,
            previous_joint_torque=memory.joint_torque,
            default_joint_position=self.default_pose,
            soft_lower=self.soft_lower,
            soft_upper=self.soft_upper,
            hip_joints=self._hips,
            action=self.action,
            previous_action=memory.action,
            second_previous_action=memory.previous_action,
            foot_height=state.foot_position_w[..., 2] - below_feet,
            foot_velocity_w=state.foot_velocity_w,
            touching_bodies=(touching[:, self._touching] > settings.collision_force).sum(dim=1).float(),
            base_touching=(touching[:, self._base] > settings.collision_force).float(),
            upright=upright,
            trunk_contact_force_w=state.trunk_contact_force_w,
            distance=base[:, :2].abs().amax(dim=1),
            leave_distance=self._leave,
            episode_length=memory.episode_length,
            max_episode_length=self.max_episode_length,
            shortfall=memory.shortfall,
            diverged=diverged,
            progress=progress,
            state=state,
            failed=diverged,
            base_height_target=settings.base_height_target,
            foot_height_length=settings.foot_height_scale * settings.base_height_target,
        )

    def _remember_shortfall(self, inputs: StepInputs) -> None:
        """How much of what robots are told to do they have not done of late; ``stuck`` judges it."""
        patience = self.configuration.termination.stuck
        if patience is None:
            return
        missing = torch.where(commanded_to_move(inputs.command), 1.0 - progress_share(inputs), 0.0).nan_to_num(0.0)
        # After this much time at a standstill an average that began at 0 has come to STUCK_SHORTFALL.
        self.memory.shortfall.lerp_(missing, 1.0 - (1.0 - STUCK_SHORTFALL) ** (self.period / patience))

    def _record(
        self, terms: torch.Tensor, inputs: StepInputs, ends: torch.Tensor, done: torch.Tensor, diverged: torch.Tensor
    ) -> None:
        """Add to the sums that logs are made of."""
        memory = self.memory
        memory.episode_rewards.add_(terms)
        linear = (inputs.command[:, :2] - inputs.base_linear_velocity_b[:, :2]).norm(dim=1)
        yaw = (inputs.command[:, 2] - inputs.base_angular_velocity_b[:, 2]).abs()
        errors = torch.stack((linear, yaw), dim=1).masked_fill(diverged[:, None], 0.0)
        finished = torch.cat((memory.episode_rewards, memory.episode_length[:, None]), dim=1) * done[:, None]
        # In the order of ``SUMS``.
        memory.sums.add_(torch.cat((finished, ends, errors, self._one), dim=1).sum(dim=0))
        memory.diverged_total.add_(diverged.sum())

    def _follow_commands(self, place: torch.Tensor, heading_xy: torch.Tensor) -> None:
        """How far the robot came, and how far it should have come."""
        memory = self.memory
        memory.farthest.copy_(torch.maximum(memory.farthest, place))
        forward, lateral = memory.command[:, :1], memory.command[:, 1:2]
        left_xy = torch.stack((-heading_xy[:, 1], heading_xy[:, 0]), dim=1)
        memory.commanded_way.add_((forward * heading_xy + lateral * left_xy) * self.period)
        memory.commanded_farthest.copy_(torch.maximum(memory.commanded_farthest, memory.commanded_way.norm(dim=1)))

    def _push(self, done: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        settings, state = self.configuration.push, self.inputs
        if self.push_steps > 0:
            push = ((self.memory.episode_length + self.memory.push_phase) % self.push_steps == 0) & ~done
        else:
            push = torch.zeros_like(done)
        linear, angular = (self.uniform.signed("push") * self._push_size).split((2, 3), dim=1)
        if settings.add:
            linear = linear + state.base_linear_velocity_w[:, :2]
            angular = angular + state.base_angular_velocity_b
        return push, torch.cat((linear, self._stays), dim=1), angular

    # --- new episodes -----------------------------------------------------------------------------------------------

    def begin_episodes(self, worlds: torch.Tensor, fallen: torch.Tensor, progress: torch.Tensor) -> EpisodeStart:
        """Draw the next episode of the masked worlds, and new commands where they are due; the memory is updated in
        place.
        """
        memory, settings, uniform = self.memory, self.configuration, self.uniform
        level = next_level(
            settings.terrain,
            level=memory.level,
            num_levels=self.num_levels,
            farthest=memory.farthest,
            commanded=memory.commanded_farthest,
            fallen=fallen,
            uniform=uniform["level"][:, 0],
        )
        torch.where(worlds & memory.moves_level, level, memory.level, out=memory.level)
        variants = self._tile_index.shape[2]
        variant = (uniform["variant"][:, 0] * variants).long().clamp(max=variants - 1)
        tile = self._tile_index[self.kind, memory.level, variant]
        torch.where(worlds, tile, memory.terrain_index, out=memory.terrain_index)
        memory.begin_episode(worlds)
        self._new_commands(worlds, progress)
        self.motors.redraw(uniform.span(MOTOR_COLUMNS[0], MOTOR_COLUMNS[-1]), worlds)
        return self._start(worlds)

    def _new_commands(self, begun: torch.Tensor, progress: torch.Tensor) -> None:
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
        )
        torch.where(due[:, None], drawn.command, memory.command, out=memory.command)
        torch.where(due, drawn.steps, memory.command_steps, out=memory.command_steps)
        torch.where(due, drawn.extreme, memory.command_extreme, out=memory.command_extreme)
        memory.issued.add_(drawn.command[:, :2] * due[:, None])

    def _start(self, worlds: torch.Tensor) -> EpisodeStart:
        memory, uniform, terrain, reset = (
            self.memory,
            self.uniform,
            self.configuration.terrain,
            self.configuration.reset,
        )
        spread = uniform["spread"][:, 0] < terrain.spread_probability
        torch.where(worlds, ~spread, memory.moves_level, out=memory.moves_level)
        xy = uniform.signed("place") * torch.where(spread, self._spread_distance, self._spawn_jitter)[:, None]
        yaw = uniform.between("yaw", -math.pi, math.pi)[:, 0]
        direction = torch.stack((torch.cos(yaw), torch.sin(yaw)), dim=1)
        ground = self.rasters.height(memory.terrain_index, place_pattern(self._footprint, xy, direction)).amax(dim=1)
        joints = self.default_pose * uniform.between("joints", *reset.joint_scale)
        twist = uniform.signed("twist") * reset.velocity
        return EpisodeStart(
            worlds=worlds,
            base_position=torch.cat((xy, ground[:, None] + self._clearance), dim=1),
            base_quaternion=from_yaw(yaw),
            base_linear_velocity=twist[:, :3],
            base_angular_velocity=twist[:, 3:],
            joint_position=torch.clamp(joints, self.joint_lower, self.joint_upper),
        )

    # --- observing --------------------------------------------------------------------------------------------------

    def observe(self) -> Observations:
        """Observations of the present state, which is fresh for worlds that were just reset or pushed; adds a frame
        to the history.
        """
        state, memory = self.inputs, self.memory
        frame = self._builder.build(state, memory.command, memory.action)
        noisy = add_noise(frame, self.uniform.signed("noise"), self.noise)
        memory.history.copy_(push_history(memory.history, noisy, memory.just_reset, start=self._history_start))
        points = place_pattern(self.scan, state.base_position_w[:, :2], heading(state.base_quaternion_w))
        ground = self.rasters.height(memory.terrain_index, points)
        privileged = privileged_state(
            base_linear_velocity_b=rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w),
            frame=frame,
            foot_force=memory.foot_force,
            torque_ratio=memory.joint_torque / self.torque_limit,
            joint_acceleration=memory.joint_acceleration,
            heights=height_entries(state.base_position_w[:, 2], ground),
        )
        return Observations(policy=noisy, history=memory.history.flatten(1), privileged=privileged)
