"""Rotations as unit quaternions wxyz in torch, batched over all leading axes; they turn body vectors into world vectors."""

from __future__ import annotations

import torch


def rotate_inverse(quaternion: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return world vectors in the body frame, q* v q; (…, 4) and (…, 3), leading axes broadcast, to (…, 3)."""
    axis, vector = torch.broadcast_tensors(-quaternion[..., 1:], vector)
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + quaternion[..., :1] * twice + torch.linalg.cross(axis, twice)


def from_yaw(yaw: torch.Tensor) -> torch.Tensor:
    """Return the rotation about the world's z axis by ``yaw`` [rad], (…) to (…, 4)."""
    zero = torch.zeros_like(yaw)
    return torch.stack((torch.cos(yaw / 2), zero, zero, torch.sin(yaw / 2)), dim=-1)


def yaw_of(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the heading of the body's x axis in the world's xy plane [rad], in [−π, π], (…, 4) to (…)."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def heading_of(quaternion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return cosine and sine of ``yaw_of``, (…, 4) to (…) each; (0, 0) where the body's x axis is vertical.

    All operations round alike in every row; torch's atan2 does not.
    """
    w, x, y, z = quaternion.unbind(-1)
    sine, cosine = 2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)
    length = torch.clamp(torch.sqrt(sine * sine + cosine * cosine), min=1e-12)
    return cosine / length, sine / length


def from_heading(quaternion: torch.Tensor, forward: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """Turn a horizontal vector along the body's heading into world axes; rounds alike in every row, as ``heading_of`` does.

    Args:
        quaternion: (…, 4).
        forward: along the heading, (…).
        left: to its left, (…).

    Returns:
        (…, 3), the last component zero.
    """
    cosine, sine = heading_of(quaternion)
    x, y = cosine * forward - sine * left, sine * forward + cosine * left
    return torch.stack((x, y, torch.zeros_like(x)), dim=-1)


def in_heading(quaternion: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return a world vector's parts along the body's heading and to its left, (…, 3) to (…, 2)."""
    cosine, sine = heading_of(quaternion)
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack((cosine * x + sine * y, cosine * y - sine * x), dim=-1)


def projected_gravity(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the unit vector of gravity in the body frame, Rᵀ (0, 0, −1): (0, 0, −1) for an upright body, (…, 4) to (…, 3)."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.stack((2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0), dim=-1)


def tilt(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the angle between the body's z axis and the world's [rad], in [0, π], (…, 4) to (…)."""
    _, x, y, _ = quaternion.unbind(-1)
    # From both sine and cosine: arccos alone loses all precision near upright.
    sine = 2.0 * torch.sqrt((x * x + y * y) * torch.clamp(1.0 - x * x - y * y, min=0.0))
    return torch.atan2(sine, 1.0 - 2.0 * (x * x + y * y))
