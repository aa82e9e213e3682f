"""What the networks see: the noisy frame, its history, and the privileged state of teacher and critic.

The frame itself comes from the policy room's builder, the one that the gauge uses too.
"""

from __future__ import annotations

import torch

from ..policy.contract import TERM_WIDTH, PolicyContract
from .environment_configuration import NoiseConfiguration

LINEAR_VELOCITY_SCALE = 2.0
FOOT_FORCE_SCALE = 1e-3
JOINT_ACCELERATION_SCALE = 1e-4
HEIGHT_SCALE = 2.5
HEIGHT_OFFSET = 0.5
"""Height of the base over the ground that a scan entry of 0 stands for [m]."""


def noise_amplitude(contract: PolicyContract, noise: NoiseConfiguration, device: torch.device | str) -> torch.Tensor:
    """Half-width of the noise on each entry of a frame, in scaled units, (frame width,)."""
    blocks = []
    for term in contract.observation:
        width = TERM_WIDTH[term.name] or contract.num_joints
        half_width = getattr(noise, _NOISE_FIELD[term.name]) if term.name in _NOISE_FIELD else 0.0
        blocks.append(torch.tensor(term.scale).abs().expand(width) * half_width)
    return torch.cat(blocks).to(device)


_NOISE_FIELD = {
    "base_angular_velocity_b": "base_angular_velocity",
    "projected_gravity_b": "projected_gravity",
    "joint_position": "joint_position",
    "joint_velocity": "joint_velocity",
}


def add_noise(frame: torch.Tensor, signed: torch.Tensor, amplitude: torch.Tensor) -> torch.Tensor:
    """A frame with independent uniform noise on every entry; ``signed`` has numbers in [-1, 1), the frame's shape."""
    return frame + signed * amplitude


def push_history(history: torch.Tensor, frame: torch.Tensor, forget: torch.Tensor, *, start: str) -> torch.Tensor:
    """History with one more frame at its end and the oldest gone.

    Args:
        history: (N, H, width), oldest first.
        frame: (N, width).
        forget: worlds whose episode has just begun, (N,) bool.
        start: what stands before their new frame: ``zeros``, or ``repeat`` for copies of it.
    """
    newest, begins = frame[:, None], forget[:, None, None]
    if start == "repeat":
        kept = torch.where(begins, newest, history[:, 1:])
    else:
        kept = history[:, 1:].masked_fill(begins, 0.0)
    return torch.cat((kept, newest), dim=1)


def height_entries(base_height: torch.Tensor, ground: torch.Tensor) -> torch.Tensor:
    """Scan entries: height of the base over each point less ``HEIGHT_OFFSET``, clipped to 1 m, scaled.

    Args:
        base_height: z of the base, world frame [m], (N,).
        ground: z of the ground at each scan point, world frame [m], (N, P).
    """
    return (base_height[:, None] - HEIGHT_OFFSET - ground).clamp(-1.0, 1.0) * HEIGHT_SCALE


def privileged_state(
    *,
    base_linear_velocity_b: torch.Tensor,
    frame: torch.Tensor,
    foot_force: torch.Tensor,
    torque_ratio: torch.Tensor,
    joint_acceleration: torch.Tensor,
    heights: torch.Tensor,
) -> torch.Tensor:
    """State that only training knows, without noise: 263 entries for a robot with 12 joints, 4 feet and 187 scan
    points.

    Args:
        base_linear_velocity_b: [m/s], (N, 3); entries 0:3, scaled by 2.
        frame: the observation without noise, (N, 45); entries 3:48.
        foot_force: norm of each foot's contact force [N], (N, 4); entries 48:52, scaled by 1e-3.
        torque_ratio: torque over its limit, (N, J); entries 52:64.
        joint_acceleration: [rad/s²], (N, J); entries 64:76, scaled by 1e-4. The published code has the opposite sign.
        heights: entries of the height scan, (N, P); the rest.
    """
    return torch.cat(
        (
            base_linear_velocity_b * LINEAR_VELOCITY_SCALE,
            frame,
            foot_force * FOOT_FORCE_SCALE,
            torque_ratio,
            joint_acceleration * JOINT_ACCELERATION_SCALE,
            heights,
        ),
        dim=1,
    )
