"""What engines say of the model that they hold: the same fields, whatever the engine keeps them in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

UNLIMITED = 1e5
"""Torque from which a limit counts as none [N·m]."""


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
        """As ``PhysicsBackend.describe`` says."""
        inertia = _array(self.body_inertia)
        moments = np.linalg.eigvalsh(inertia) if inertia.ndim == 3 else np.sort(inertia, axis=1)
        limit = _array(self.torque_limit)
        foot, priority = _array(self.foot_friction), np.asarray(self.foot_priority)
        acting = np.where(
            priority > 0, foot, np.where(priority < 0, self.floor_friction, np.maximum(foot, self.floor_friction))
        )
        fields = {
            "total_mass": np.array([self.total_mass]),
            "body_mass": _array(self.body_mass),
            "body_inertia": moments,
            "joint_range": _array(self.joint_range),
            "joint_armature": _array(self.joint_armature),
            "joint_damping": _array(self.joint_damping),
            "joint_friction_loss": _array(self.joint_friction_loss),
            "stiffness": _array(self.stiffness),
            "damping": _array(self.damping),
            "torque_limit": np.where(limit >= UNLIMITED, np.inf, limit),
            "contact_friction": acting,
        }
        return {name: [float(v) for v in values.ravel()] for name, values in fields.items()}


def _array(values: ArrayLike) -> Floats:
    return np.asarray(values, dtype=np.float64)
