"""Describe the model that an engine holds, with the same fields for every engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .base import DESCRIPTION_KEYS

UNLIMITED = 1e5
"""Smallest torque that counts as no limit [N·m]."""


@dataclass(frozen=True, kw_only=True)
class ModelFields:
    """One world's model. B bodies and J joints in the robot's orders, F feet."""

    total_mass: float
    body_mass: ArrayLike
    """(B,)."""
    body_inertia: ArrayLike
    """Principal moments (B, 3), or tensors (B, 3, 3)."""
    joint_range: ArrayLike
    """(J, 2)."""
    joint_armature: ArrayLike
    joint_damping: ArrayLike
    joint_friction_loss: ArrayLike
    stiffness: ArrayLike
    damping: ArrayLike
    torque_limit: ArrayLike
    """(J,)."""
    foot_friction: ArrayLike
    """Sliding coefficient of each foot, (F,)."""
    floor_friction: float
    foot_priority: ArrayLike = 0
    """Priority of each foot's coefficient over the floor's; the larger coefficient acts where it is 0, (F,)."""

    def describe(self) -> dict[str, list[float]]:
        """Return the fields of ``PhysicsBackend.describe``."""
        found: dict[str, NDArray] = {name: np.asarray(value, np.float64) for name, value in vars(self).items()}
        inertia, limit = found["body_inertia"], found["torque_limit"]
        foot, floor = found["foot_friction"], found["floor_friction"]
        found["body_inertia"] = np.linalg.eigvalsh(inertia) if inertia.ndim == 3 else np.sort(inertia, axis=1)
        found["torque_limit"] = np.where(limit >= UNLIMITED, np.inf, limit)
        first = found["foot_priority"]
        found["contact_friction"] = np.where(first > 0, foot, np.where(first < 0, floor, np.maximum(foot, floor)))
        return {name: [float(v) for v in found[name].ravel()] for name in DESCRIPTION_KEYS}
