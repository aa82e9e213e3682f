"""Inputs of the functions of rewards and terminations."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from ...backends.base import PhysicsState

AFTER_STEP = (
    "base_position_w",
    "base_quaternion_w",
    "base_linear_velocity_w",
    "base_angular_velocity_b",
    "joint_position",
    "joint_velocity",
    "joint_torque",
    "foot_position_w",
    "foot_velocity_w",
    "foot_contact_force_w",
    "body_contact_force_w",
    "trunk_contact_force_w",
    "diverged",
)
"""Physics state that a step is judged by."""
AFTER_RESET = AFTER_STEP[:6]
"""Physics state that is observed."""


def static_inputs(state: PhysicsState) -> PhysicsState:
    """Return tensors that physics states are copied into: as ``state`` in shape, floating point as float32."""
    values = {f.name: getattr(state, f.name).clone() for f in fields(PhysicsState)}
    return PhysicsState(**{name: v.float() if v.is_floating_point() else v for name, v in values.items()})


@dataclass(frozen=True, kw_only=True)
class FootInputs:
    """State of the feet after a control step, in the order of ``foot_names``. N worlds, F feet."""

    contact: torch.Tensor
    """Feet that carry more than ``RewardLimits.foot_contact_force``, (N, F) bool."""
    air_time: torch.Tensor
    """Time since a foot left the ground [s], zero in contact, (N, F)."""
    contact_time: torch.Tensor
    """Time since a foot touched the ground [s], zero in the air, (N, F)."""
    clearance: torch.Tensor
    """Height of the foot's centre over the ground below it, less that of a standing foot [m], (N, F)."""
    tilt: torch.Tensor
    """Squared sine of the angle between the sole, level in the standing pose, and the horizontal plane, (N, F)."""
    apart: torch.Tensor
    """Smallest distance of a left foot from its right counterpart, to the left of the heading [m], (N,); negative for crossed legs."""
    swing: torch.Tensor
    """Feet that the gait clock wants in the air, (N, F) bool; none without a clock."""
    wanted_clearance: torch.Tensor
    """Clearance that the gait clock asks for [m], (N, F)."""


@dataclass(kw_only=True)
class StepInputs:
    """State after a control step, before any reset. N worlds, J joints, F feet."""

    base_linear_velocity_b: torch.Tensor
    """[m/s], (N, 3)."""
    base_angular_velocity_b: torch.Tensor
    """[rad/s], (N, 3)."""
    base_quaternion_w: torch.Tensor
    """wxyz, (N, 4)."""
    base_height: torch.Tensor
    """Height of the base over the mean ground below the trunk [m], (N,)."""
    command: torch.Tensor
    """Forward, lateral [m/s] and yaw [rad/s] speed, (N, 3)."""
    turn_error: torch.Tensor | None
    """Commanded less actual yaw rate [rad/s], averaged over ``RewardShapes.turn_error_time`` since the command was drawn, (N,); None
    where that time is 0."""
    sigma: torch.Tensor
    """Tracking width of each command axis, (N, 3)."""
    joint_position: torch.Tensor
    """[rad], (N, J)."""
    joint_velocity: torch.Tensor
    """[rad/s], (N, J)."""
    joint_acceleration: torch.Tensor
    """Change of velocity over the control step [rad/s²], (N, J)."""
    joint_torque: torch.Tensor
    """Torque of the last substep [N·m], (N, J)."""
    previous_joint_torque: torch.Tensor
    """The same, one control step earlier."""
    default_joint_position: torch.Tensor
    """Standing pose [rad], (J,)."""
    soft_lower: torch.Tensor
    """Lower soft joint limit [rad], (J,)."""
    soft_upper: torch.Tensor
    """Upper soft joint limit [rad], (J,)."""
    soft_speed: torch.Tensor
    """Soft limit of the joint speeds [rad/s], (J,); infinity where the reward ``joint_speed_limits`` has no weight."""
    hip_joints: torch.Tensor
    """Indices of the hip joints, which swing legs sideways, (H,) int64."""
    hip_pairs: torch.Tensor
    """Hip joints and their mirror images, (P, 2) int64; empty where the reward ``hip_symmetry`` has no weight."""
    hip_signs: torch.Tensor
    """−1 for pairs that turn opposite ways when they mirror each other, else 1, (P,)."""
    action: torch.Tensor
    """Raw action of this step, (N, J)."""
    previous_action: torch.Tensor
    """Raw action one step earlier; zeros after a reset."""
    second_previous_action: torch.Tensor
    """Raw action two steps earlier; zeros after a reset."""
    foot_height: torch.Tensor
    """Height of the foot centres over the ground [m], (N, F)."""
    foot_velocity_w: torch.Tensor
    """[m/s], (N, F, 3)."""
    touching_bodies: torch.Tensor
    """Number of thighs, calves and what hangs on them in contact, (N,)."""
    base_touching: torch.Tensor
    """1 where the base touches something, (N,)."""
    upright: torch.Tensor
    """Cosine of the angle between the base's z axis and the world's, (N,)."""
    trunk_contact_force_w: torch.Tensor
    """Force of the ground on the trunk's shapes [N], (N, 3)."""
    distance: torch.Tensor
    """Distance from the tile's middle, larger of |x| and |y| [m], (N,)."""
    leave_distance: torch.Tensor
    """``distance`` at which an episode is cut short [m], infinite for never, (N,)."""
    episode_length: torch.Tensor
    """Control steps of the present episode, (N,) int64."""
    max_episode_length: int | torch.Tensor
    """Control steps of the longest episode; (N,) where some worlds play scenarios."""
    can_be_stuck: torch.Tensor
    """Worlds on tiles on which being stuck ends an episode, (N,) bool."""
    shortfall: torch.Tensor
    """Share of the commanded speed that is missing of late, an exponential average, (N,)."""
    diverged: torch.Tensor
    """Worlds with diverged physics, (N,) bool."""
    progress: torch.Tensor
    """Fraction of the run, scalar."""
    heading_xy: torch.Tensor
    """Unit vector of the base's x axis in the world's xy plane, (N, 2)."""
    commanded_heading_xy: torch.Tensor
    """Heading that the command refers to, as ``heading_xy``, (N, 2); see ``RewardShapes.progress_along``."""
    period: float
    """Control period [s]."""
    state: PhysicsState
    """The whole physics."""
    failed: torch.Tensor
    """Episodes that end as a failure, (N,) bool; the terminations write it, so that rewards can read it."""
    base_height_target: float
    """[m]."""
    feet: FootInputs | None = None
    """More about the feet, where a reward with a weight asks for it."""
    pose_weight: torch.Tensor | None = None
    """Weight of each joint in the reward ``pose``, (J,), where that has a weight."""
    least_apart: float = 0.0
    """[m]; as the next two, of ``RewardShapes``."""
    longest_step: float = 1.0
    """[s]."""
    clock_sigma: float = 1.0
    """[m²]."""
    foot_height_length: float
    """Height over which foot regulation fades by a factor e [m]."""
