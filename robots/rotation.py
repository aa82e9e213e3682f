"""Rotations as unit quaternions wxyz in torch, batched over all leading axes. A quaternion turns body vectors into
world vectors.
"""

from __future__ import annotations

import torch


def rotate(quaternion: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Body vectors seen in the world: q v q*. ``quaternion`` (…, 4), ``vector`` (…, 3), leading axes broadcast; returns
    (…, 3).
    """
    return _rotate(quaternion[..., :1], quaternion[..., 1:], vector)


def rotate_inverse(quaternion: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """World vectors seen in the body: q* v q. ``quaternion`` (…, 4), ``vector`` (…, 3), leading axes broadcast; returns
    (…, 3).
    """
    return _rotate(quaternion[..., :1], -quaternion[..., 1:], vector)


def _rotate(w: torch.Tensor, axis: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    axis, vector = torch.broadcast_tensors(axis, vector)
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)


def conjugate(quaternion: torch.Tensor) -> torch.Tensor:
    """The opposite rotation, (…, 4)."""
    return torch.cat((quaternion[..., :1], -quaternion[..., 1:]), dim=-1)


def multiply(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Hamilton product, (…, 4): turns by ``second`` and then, in the world, by ``first``."""
    w1, x1, y1, z1 = first.unbind(-1)
    w2, x2, y2, z2 = second.unbind(-1)
    return torch.stack(
        (
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ),
        dim=-1,
    )


def from_euler(roll: torch.Tensor, pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Roll about x, then pitch about y, then yaw about z, all about the world's axes [rad], each (…); returns (…,
    4).
    """
    cr, sr = torch.cos(roll / 2), torch.sin(roll / 2)
    cp, sp = torch.cos(pitch / 2), torch.sin(pitch / 2)
    cy, sy = torch.cos(yaw / 2), torch.sin(yaw / 2)
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        dim=-1,
    )


def from_yaw(yaw: torch.Tensor) -> torch.Tensor:
    """Rotation about the world's z axis [rad], (…) to (…, 4)."""
    zero = torch.zeros_like(yaw)
    return torch.stack((torch.cos(yaw / 2), zero, zero, torch.sin(yaw / 2)), dim=-1)


def yaw_of(quaternion: torch.Tensor) -> torch.Tensor:
    """Heading of the body's x axis in the world's xy plane [rad], in [−π, π], (…, 4) to (…)."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def projected_gravity(quaternion: torch.Tensor) -> torch.Tensor:
    """Unit vector of gravity in the body frame, Rᵀ (0, 0, −1): (0, 0, −1) for an upright body, (…, 4) to (…, 3)."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.stack((2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0), dim=-1)


def tilt(quaternion: torch.Tensor) -> torch.Tensor:
    """Angle between the body's z axis and the world's [rad], in [0, π], (…, 4) to (…)."""
    _, x, y, _ = quaternion.unbind(-1)
    # From both sine and cosine: arccos alone loses all precision near upright.
    sine = 2.0 * torch.sqrt((x * x + y * y) * torch.clamp(1.0 - x * x - y * y, min=0.0))
    return torch.atan2(sine, 1.0 - 2.0 * (x * x + y * y))
