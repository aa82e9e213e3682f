"""Describe the model that an engine holds, with the same fields for every engine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .base import DESCRIPTION_KEYS

UNLIMITED = 1e5
"""Smallest torque that counts as no limit [N·m]."""


@dataclass(frozen=True, kw_only=True)
class FootContact:
    """Contact of each foot with the floor beside sliding friction. Arrays (F,)."""

    dimension: ArrayLike
    """3 sliding, 4 with torsion, 6 with rolling."""
    torsion: ArrayLike
    """Torsional coefficient [m]."""
    rolling: ArrayLike
    """Rolling coefficient [m]."""
    cone: float
    """Faces of the friction cone, infinity for a true one."""
    softness: ArrayLike
    """Time constant of the contact's spring [s]; 0 for a hard contact."""
    restitution: ArrayLike
    """Share of the speed after a bounce."""

    @classmethod
    def hard(cls, feet: int) -> FootContact:
        """Return hard contacts that slide on a true cone and do not bounce."""
        none = np.zeros(feet)
        sliding = np.full(feet, 3.0)
        return cls(dimension=sliding, torsion=none, rolling=none, cone=np.inf, softness=none, restitution=none)

    @classmethod
    def of_mujoco(
        cls, *, dimension: ArrayLike, friction: ArrayLike, softness: ArrayLike, priority: ArrayLike, pyramidal: bool
    ) -> FootContact:
        """Return MuJoCo's contacts by its rules of combination.

        Args:
            dimension: ``condim`` of the feet, then of the floor, (F + 1,).
            friction: coefficients in the same order, (F + 1, 3).
            softness: ``solref``, (F + 1, 2).
            priority: (F + 1,).
            pyramidal: True where the cone is a pyramid.
        """
        rank = np.asarray(priority)

        def combined(values: ArrayLike, mix: Callable[[NDArray, NDArray], NDArray]) -> NDArray:
            given = np.asarray(values, np.float64)
            feet, floor = given[:-1], np.broadcast_to(given[-1], given[:-1].shape)
            first = (rank[:-1] - rank[-1]).reshape(-1, *[1] * (given.ndim - 1))
            return np.where(first > 0, feet, np.where(first < 0, floor, mix(feet, floor)))

        size, coefficients = combined(dimension, np.maximum), combined(friction, np.maximum)
        usual = (np.asarray(softness)[:, :1] > 0).all()
        constant, ratio = combined(softness, lambda a, b: 0.5 * (a + b) if usual else np.minimum(a, b)).T
        # negative numbers are stiffness and damping
        constant, ratio = np.where(constant < 0, -2.0 / ratio, constant), np.where(constant < 0, 1.0, ratio)
        damped = np.clip(ratio, 0.0, 1.0 - 1e-12)
        return cls(
            dimension=size,
            torsion=np.where(size >= 4, coefficients[:, 1], 0.0),
            rolling=np.where(size >= 6, coefficients[:, 2], 0.0),
            cone=4.0 if pyramidal else np.inf,
            softness=constant,
            restitution=np.where(ratio >= 1.0, 0.0, np.exp(-np.pi * damped / np.sqrt(1.0 - damped**2))),
        )


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
    foot_contact: FootContact | None = None
    """Of the feet on the floor; None for hard contacts that only slide."""
    foot_priority: ArrayLike = 0
    """Priority of each foot's coefficient over the floor's; the larger coefficient acts where it is 0, (F,)."""

    def describe(self) -> dict[str, list[float]]:
        """Return the fields of ``PhysicsBackend.describe``."""
        given = {name: value for name, value in vars(self).items() if name != "foot_contact"}
        found: dict[str, NDArray] = {name: np.asarray(value, np.float64) for name, value in given.items()}
        inertia, limit = found["body_inertia"], found["torque_limit"]
        foot, floor = found["foot_friction"], found["floor_friction"]
        found["body_inertia"] = np.linalg.eigvalsh(inertia) if inertia.ndim == 3 else np.sort(inertia, axis=1)
        found["torque_limit"] = np.where(limit >= UNLIMITED, np.inf, limit)
        first = found["foot_priority"]
        found["contact_friction"] = np.where(first > 0, foot, np.where(first < 0, floor, np.maximum(foot, floor)))
        count = len(found["contact_friction"])
        contact = self.foot_contact or FootContact.hard(count)
        found |= {f"contact_{name}": np.asarray(value, np.float64) for name, value in vars(contact).items()}
        return {name: [float(v) for v in found[name].ravel()] for name in DESCRIPTION_KEYS}
