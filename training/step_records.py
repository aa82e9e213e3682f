"""What the torch part of a step reads and what it hands back."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from ..backends.base import PhysicsState

METRICS = ("linear_velocity_error", "yaw_rate_error")
"""Averages over all worlds and steps, in the order of ``EnvironmentMemory.metric_sums``."""

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
"""Physics state that ``after_physics`` reads."""
AFTER_RESET = AFTER_STEP[:6]
"""Physics state that ``observe`` reads."""


def static_inputs(state: PhysicsState, *, stays: bool = False) -> PhysicsState:
    """Tensors that physics states are copied into: as ``state`` in shape, floating point as float32; or, if these stay for
    good, the engine's own.
    """
    if stays:
        return state
    return PhysicsState(**{f.name: _float32(getattr(state, f.name)).clone() for f in fields(PhysicsState)})


def _float32(value: torch.Tensor) -> torch.Tensor:
    return value.float() if value.is_floating_point() else value


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """How the masked worlds begin their next episode."""

    worlds: torch.Tensor
    """(N,) bool."""
    base_position: torch.Tensor
    """World frame [m], (N, 3)."""
    base_quaternion: torch.Tensor
    """wxyz, (N, 4)."""
    base_linear_velocity: torch.Tensor
    """World frame [m/s], (N, 3)."""
    base_angular_velocity: torch.Tensor
    """Body frame [rad/s], (N, 3)."""
    joint_position: torch.Tensor
    """[rad], (N, J)."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What came of a step."""

    reward: torch.Tensor
    """(N,)."""
    done: torch.Tensor
    """(N,) bool."""
    time_out: torch.Tensor
    """Ends that are no failure, (N,) bool."""
    start: EpisodeStart
    push: torch.Tensor
    """Worlds that are pushed, (N,) bool."""
    push_linear_velocity: torch.Tensor
    """New velocity, world frame, NaN where it stays [m/s], (N, 3)."""
    push_angular_velocity: torch.Tensor
    """New angular velocity, body frame [rad/s], (N, 3)."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """The three observation groups."""

    policy: torch.Tensor
    """Noisy frame, (N, 45)."""
    history: torch.Tensor
    """Noisy frames, oldest first, the current one last, (N, 225)."""
    privileged: torch.Tensor
    """(N, 263)."""
