"""Turn the physics after a control step into the inputs of rewards and terminations."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ...backends.base import PhysicsState
from ...robots.anatomy.body_plan import body_plan, joint_ranges, mirror_image
from ...robots.base import JointParameters, Robot
from ...robots.rotation import rotate_inverse
from ...terrains.height_scan import HeightRasters, heading_and_upright, place_pattern
from ..configuration import ConfigurationError
from .configuration import EnvironmentConfiguration
from .curriculum import TrainingPalette
from .feet import FootReader
from .gait_rewards import pose_weights
from .memory import EnvironmentMemory
from .reward_configuration import FOOT_TERMS, RewardConfiguration
from .step_inputs import StepInputs


def soft_speed_limits(rewards: RewardConfiguration, robot: Robot, parameters: JointParameters) -> tuple[float, ...]:
    """Return the joint speeds from which ``joint_speed_limits`` counts [rad/s], (J,); infinity where it has no weight.

    Raises:
        ConfigurationError: it has one, and the parameter set does not say how fast the motors turn.
    """
    if not rewards.joint_speed_limits:
        return (math.inf,) * robot.num_joints
    if parameters.no_load_speed is None:
        raise ConfigurationError(
            f"environment.rewards.joint_speed_limits is {rewards.joint_speed_limits:g}, but this parameter set of robot "
            f"'{robot.name}' does not say how fast its motors turn; add full_torque_speed and no_load_speed to "
            "robot.toml, or set it to 0"
        )
    return tuple(rewards.soft_speed_limit * speed for speed in parameters.no_load_speed)


class StepReader:
    """Computes ``StepInputs``; everything that never changes is on the device."""

    def __init__(
        self,
        configuration: EnvironmentConfiguration,
        *,
        robot: Robot,
        parameters: JointParameters,
        palette: TrainingPalette,
        kind: torch.Tensor,
        scan: torch.Tensor,
        rasters: HeightRasters,
        longest: int | torch.Tensor,
    ) -> None:
        """Prepare constants; ``kind`` is the kind of tile of every world, (N,) int64, ``scan`` the points of the height scan about the base
        [m], (P, 2), ``longest`` the control steps of the longest episode, one number or (N,).

        Raises:
            ConfigurationError: no point of the scan is below the trunk, or joint speeds of motors with an unknown no-load
                speed are judged.
        """
        self._settings, self._rasters = configuration.rewards, rasters
        self._joint_velocity_limit = configuration.termination.joint_velocity
        self._period = configuration.physics.control_period
        self._longest = longest
        time = self._settings.turn_error_time
        self._newest = -math.expm1(-self._period / time) if time else None
        self._device = device = kind.device
        area = 0.5 * torch.tensor(self._settings.trunk_area, device=device) + 1e-4
        self._trunk_points = scan[(scan.abs() <= area).all(dim=1)]
        if not len(self._trunk_points):
            length, width = self._settings.trunk_area
            raise ConfigurationError(
                f"environment.rewards.trunk_area is {length:g} x {width:g} m, which holds no point of the height scan; make it "
                "larger"
            )
        self._default_pose = torch.tensor(robot.default_joint_position, device=device)
        ranges = torch.from_numpy(joint_ranges(robot)).float().to(device)
        lower, upper = ranges.unbind(1)
        middle, half = ranges.mean(dim=1), 0.5 * (upper - lower) * self._settings.soft_limit
        limited = ranges.isfinite().all(dim=1)
        self._soft_lower = torch.where(limited, middle - half, lower)
        self._soft_upper = torch.where(limited, middle + half, upper)
        self._soft_speed = torch.tensor(soft_speed_limits(self._settings, robot, parameters), device=device)
        plan = body_plan(robot)
        self._hips = self._indices(plan.abduction)
        pairs: list[tuple[int, int, float]] = []
        if self._settings.hip_symmetry:
            mirror = mirror_image(robot)
            pairs = [(i, mirror.joint[i], mirror.sign[i]) for i in plan.abduction if i < mirror.joint[i]]
        self._hip_pairs = self._indices([pair[:2] for pair in pairs]).view(-1, 2)
        self._hip_signs = torch.tensor([sign for *_, sign in pairs], device=device)
        r = self._settings
        self._pose_weight = pose_weights(r.pose_weights, robot, device) if r.pose else None
        self._feet = None
        if any(getattr(r, name) for name in FOOT_TERMS):
            self._feet = FootReader(r, configuration.gait, robot=robot, period=self._period, device=device)
        self._base = robot.collision_bodies.index(robot.base_body)
        self._limbs = self._indices(plan.limb_bodies)
        tiles = palette.tiles
        sigma = torch.tensor([tile.sigma for tile in tiles], device=device)[kind]
        self._sigma_growth = sigma - r.tracking_sigma
        levels = torch.arange(1, palette.num_levels + 1, device=device)
        self._difficulty = (torch.exp(levels * 0.1) - 1.0).clamp(max=1.0)
        rising = torch.tensor((r.sigma_linear_range, r.sigma_linear_range, r.sigma_yaw_range), device=device)
        self._sigma_low, self._sigma_rate = rising[:, 0], 1.0 / (rising[:, 1] - rising[:, 0])
        leave = configuration.terrain.leave_distance
        distance = [leave if leave is not None and tile.ends else math.inf for tile in tiles]
        self._leave = torch.tensor(distance, device=device)[kind]
        self._can_be_stuck = torch.tensor([tile.stuck for tile in tiles], device=device)[kind]

    def _indices(self, found: Sequence[int] | Sequence[tuple[int, int]]) -> torch.Tensor:
        return torch.tensor(found, dtype=torch.int64, device=self._device)

    def sigma(self, memory: EnvironmentMemory) -> torch.Tensor:
        """Return the tracking width of every command axis, (N, 3) (paper, dynamic velocity tracking precision adjustment)."""
        base = self._settings.tracking_sigma
        command = memory.command
        if not self._settings.dynamic_sigma:
            return torch.full_like(command, base)
        speed = ((command.abs() - self._sigma_low) * self._sigma_rate).clamp(0.0, 1.0)
        return base + speed * (self._difficulty[memory.level] * self._sigma_growth)[:, None]

    def _commanded_heading(self, memory: EnvironmentMemory, heading_xy: torch.Tensor) -> torch.Tensor:
        """Return ``StepInputs.commanded_heading_xy``, where ``heading_xy`` are the robots' own."""
        if self._settings.progress_along == "straight":
            return torch.where(memory.holds_heading[:, None], memory.commanded_heading, heading_xy)
        return heading_xy if self._settings.progress_along == "base" else memory.commanded_heading

    def __call__(
        self, state: PhysicsState, memory: EnvironmentMemory, action: torch.Tensor, progress: torch.Tensor
    ) -> StepInputs:
        """Return the inputs of rewards and terminations after a step, from the physics after it, the memory of before it, with the counters
        of the step, the raw action (N, J), and the fraction of the run, a scalar.
        """
        settings, base = self._settings, state.base_position_w
        velocity_b = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)
        heading_xy, upright = heading_and_upright(state.base_quaternion_w)
        touching = state.body_contact_force_w.norm(dim=-1)
        fast = state.joint_velocity.abs().amax(dim=1)
        total = base.sum(dim=1) + velocity_b.sum(dim=1) + state.joint_position.sum(dim=1)
        # Both comparisons are false for NaN.
        sound = (total.abs() < math.inf) & (fast <= self._joint_velocity_limit)
        diverged = state.diverged | ~sound
        trunk = place_pattern(self._trunk_points, base[:, :2], heading_xy)
        points = torch.cat((trunk, state.foot_position_w[..., :2]), dim=1)
        ground = self._rasters.height(memory.terrain_index, points)
        below_base = ground[:, : len(self._trunk_points)].mean(dim=1)
        below_feet = (
            ground[:, len(self._trunk_points) :] if settings.foot_height_over == "foot" else below_base[:, None]
        )
        foot_height = state.foot_position_w[..., 2] - below_feet
        return StepInputs(
            base_linear_velocity_b=velocity_b,
            base_angular_velocity_b=state.base_angular_velocity_b,
            base_quaternion_w=state.base_quaternion_w,
            base_height=base[:, 2] - below_base,
            command=memory.command,
            turn_error=None
            if self._newest is None
            else memory.turn_error.lerp_(memory.command[:, 2] - state.base_angular_velocity_b[:, 2], self._newest),
            sigma=self.sigma(memory),
            joint_position=state.joint_position,
            joint_velocity=state.joint_velocity,
            joint_acceleration=(state.joint_velocity - memory.joint_velocity) * (1.0 / self._period),
            joint_torque=state.joint_torque,
            previous_joint_torque=memory.joint_torque,
            default_joint_position=self._default_pose,
            soft_lower=self._soft_lower,
            soft_upper=self._soft_upper,
            soft_speed=self._soft_speed,
            hip_joints=self._hips,
            hip_pairs=self._hip_pairs,
            hip_signs=self._hip_signs,
            action=action,
            previous_action=memory.action,
            second_previous_action=memory.previous_action,
            foot_height=foot_height,
            foot_velocity_w=state.foot_velocity_w,
            touching_bodies=(touching[:, self._limbs] > settings.collision_force).sum(dim=1).float(),
            base_touching=(touching[:, self._base] > settings.collision_force).float(),
            upright=upright,
            trunk_contact_force_w=state.trunk_contact_force_w,
            distance=base[:, :2].abs().amax(dim=1),
            leave_distance=self._leave,
            episode_length=memory.episode_length,
            max_episode_length=self._longest,
            can_be_stuck=self._can_be_stuck,
            shortfall=memory.shortfall,
            diverged=diverged,
            progress=progress,
            heading_xy=heading_xy,
            commanded_heading_xy=self._commanded_heading(memory, heading_xy),
            period=self._period,
            state=state,
            failed=diverged,
            feet=None if self._feet is None else self._feet(state, memory, foot_height, heading_xy),
            pose_weight=self._pose_weight,
            least_apart=settings.least_apart,
            longest_step=settings.longest_step,
            clock_sigma=settings.clock_sigma,
            base_height_target=settings.base_height_target,
            foot_height_length=settings.foot_height_scale * settings.base_height_target,
        )
