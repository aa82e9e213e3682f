"""The interface of one world of an engine that holds each world in an object of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Base:
    """Pose and velocity of the base's origin."""

    position: Array
    """World frame [m], (3,)."""
    quaternion: Array
    """wxyz, (4,)."""
    linear_velocity: Array
    """World frame [m/s], (3,)."""
    angular_velocity: Array
    """Body frame [rad/s], (3,)."""


@dataclass(kw_only=True, eq=False, slots=True)
class Contact:
    """A contact of the last physics step between the robot and the ground.

    An engine may report pressure and friction of one contact apart, each with its part of the force.
    """

    shape: int
    """Index of the robot's shape."""
    terrain: bool
    """True for boxes and height fields, False for the floor and walls."""
    point_w: Array
    """[m], (3,)."""
    force_w: Array
    """Of the ground on the robot [N], (3,)."""
    normal: float
    """Part of the force along the contact's own normal [N]."""
    tangential: float
    """Magnitude of the rest of the force [N]."""
    depth: float = 0.0
    """[m]."""
    moment_w: Array | float = 0.0
    """Moment of a contact area about its point [N·m], (3,); zero for a point."""


class World(ABC):
    """One robot on one terrain. Joint arrays are in the robot's order, (J,)."""

    @abstractmethod
    def place(self, base: Base, joint_position: Array, joint_velocity: Array) -> None:
        """Put the robot into a state and forget the past."""

    @abstractmethod
    def step(self, torque: Array, force_w: Array) -> None:
        """Take one physics step with joint torques [N·m] and a force on the base's centre of mass [N].

        Raises:
            RuntimeError: the engine fails.
        """

    @abstractmethod
    def joints(self) -> tuple[Array, Array]:
        """Return joint positions [rad] and velocities [rad/s]."""

    @abstractmethod
    def base(self) -> Base:
        """Return pose and velocity of the base."""

    @abstractmethod
    def feet(self) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s] of the feet's centres in the world frame, (F, 3) each."""

    @abstractmethod
    def contacts(self) -> list[Contact]:
        """Return the contacts of the last physics step between the robot and the ground."""

    @abstractmethod
    def change(self, changes: Mapping[str, Array]) -> None:
        """Write fields of ``Randomization`` by name into the model, from its nominal values; fields that are missing are nominal."""

    def constants(self) -> dict[str, Any]:
        """Return the fields of ``ModelFields`` as the engine holds them, without the motors' gains and limits; nothing where unknown."""
        return {}

    def close(self) -> None:  # noqa: B027  (an engine may have nothing to free)
        """Free the world."""
