"""Reward terms for legs of any plan: the pose by the joints' roles, and what the feet do. ``rewards.REWARD_TERMS`` names them."""

from __future__ import annotations

from collections.abc import Callable

import torch

from ...policy.contract import RESTING
from ...robots.anatomy.roles import anatomy
from ...robots.base import Robot
from ...robots.rotation import projected_gravity
from .reward_configuration import PoseWeights
from .step_inputs import FootInputs, StepInputs

_PARTS = {
    "ankle": "ankle",
    "waist": "waist",
    "head": "head",
    "shoulder": "arm",
    "elbow": "arm",
    "wrist": "arm",
    "hand": "arm",
}
"""Field of ``PoseWeights`` by the first word of a role; other roles have fields of their own, or none."""


def pose_weights(weights: PoseWeights, robot: Robot, device: torch.device) -> torch.Tensor:
    """Return the weight of each joint in ``pose``, (J,); zero for joints of other roles, as wheels."""
    fields = [_PARTS.get(role.partition("_")[0], role) for role in anatomy(robot).roles]
    return torch.tensor([float(getattr(weights, field, 0.0)) for field in fields], device=device)


def alive(inputs: StepInputs) -> torch.Tensor:
    """1 unless the episode ends as a failure."""
    return (~inputs.failed).float()


def orientation(inputs: StepInputs) -> torch.Tensor:
    """Squared horizontal part of the unit vector of gravity in the base's frame."""
    return projected_gravity(inputs.base_quaternion_w)[:, :2].square().sum(dim=1)


def pose(inputs: StepInputs) -> torch.Tensor:
    """Weighted sum of squared deviations from the standing pose [rad²]."""
    assert inputs.pose_weight is not None
    return ((inputs.joint_position - inputs.default_joint_position).square() * inputs.pose_weight).sum(dim=1)


def foot_tilt(inputs: StepInputs) -> torch.Tensor:
    """Sum over the feet of the squared sine of a sole's angle to the horizontal."""
    return _feet(inputs).tilt.sum(dim=1)


def foot_slip(inputs: StepInputs) -> torch.Tensor:
    """Sum over the feet that carry of their squared horizontal speed [m²/s²]."""
    return (inputs.foot_velocity_w[..., :2].square().sum(dim=-1) * _feet(inputs).contact).sum(dim=1)


def feet_apart(inputs: StepInputs) -> torch.Tensor:
    """Distance that is missing between a left foot and its right counterpart [m]."""
    return (inputs.least_apart - _feet(inputs).apart).clamp_min(0.0)


def air_time(inputs: StepInputs) -> torch.Tensor:
    """Time for which the same half of the feet has carried while the others were in the air, up to ``longest_step`` [s], under a command
    to move: steps instead of hops and shuffles (Isaac Lab's humanoids).
    """
    feet = _feet(inputs)
    halves = 2 * feet.contact.sum(dim=1) == feet.contact.shape[1]
    time = torch.where(feet.contact, feet.contact_time, feet.air_time).amin(dim=1).clamp(max=inputs.longest_step)
    return time * (halves & (inputs.command.norm(dim=1) >= RESTING))


def clock_height(inputs: StepInputs) -> torch.Tensor:
    """exp(−Σ (clearance − wanted clearance)²/sigma) over the feet (MuJoCo Playground's and Holosoma's humanoids)."""
    feet = _feet(inputs)
    return torch.exp((feet.clearance - feet.wanted_clearance).square().sum(dim=1) * (-1.0 / inputs.clock_sigma))


def clock_contact(inputs: StepInputs) -> torch.Tensor:
    """Share of the feet that carry where the clock wants them on the ground, and do not where it wants them in the air."""
    feet = _feet(inputs)
    return (feet.contact != feet.swing).float().mean(dim=1)


def _feet(inputs: StepInputs) -> FootInputs:
    assert inputs.feet is not None
    return inputs.feet


GAIT_TERMS: tuple[Callable[[StepInputs], torch.Tensor], ...] = (
    alive, orientation, pose, foot_tilt, foot_slip, feet_apart, air_time, clock_height, clock_contact,
)  # fmt: skip
