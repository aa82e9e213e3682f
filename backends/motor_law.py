"""The motor law for engines that compute it in NumPy or torch; ``warp.motors.motor_torque`` is the same law for kernels.

Torque = kp (target + offset − q) − kd q̇, clipped to limits, then multiplied by the motor strength. Joints of
``Robot.velocity_joints`` have targets of velocity: kd (target − q̇), clipped and multiplied alike. With
``PhysicsOptions.torque_speed_limit`` the limits follow the joint's speed: in the direction of motion a motor gives its
driving torque up to the speed of full torque, from there a torque that falls linearly to zero at the no-load speed;
against the motion it keeps its whole torque at any speed. A joint at rest counts as driven. ``Randomization.motor_speed``
multiplies both speeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from .base import BackendError, Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class MotorLimits:
    """Torque limits of the joints. Arrays (J,), NumPy float64 or tensors made by ``to``."""

    torque: Any
    """Largest torque [N·m]; infinity for none."""
    driving: Any
    """Largest torque in the direction of motion [N·m]."""
    no_load_speed: Any
    """Speed beyond which a motor does not drive [rad/s]; infinity where the speed does not matter."""
    fall: Any
    """Width of the range below that speed in which the driving torque falls [rad/s]."""
    by_speed: bool
    """True where the speed matters."""

    @classmethod
    def of(cls, scene: Scene) -> MotorLimits:
        """Return a scene's limits; raise ``BackendError`` for a limit by speed without the motors' data or without torque limits."""
        constants, physics = scene.parameters, scene.physics
        torque = np.asarray(constants.torque_limit, dtype=np.float64)
        if not physics.torque_limits:
            torque = np.full_like(torque, np.inf)
        if not physics.torque_speed_limit:
            still = {"no_load_speed": np.full_like(torque, np.inf), "fall": np.ones_like(torque)}
            return cls(torque=torque, driving=torque, **still, by_speed=False)
        if not physics.torque_limits:
            raise BackendError(
                "PhysicsOptions.torque_speed_limit is on without torque_limits; turn both on, or neither"
            )
        full, none = constants.full_torque_speed, constants.no_load_speed
        if full is None or none is None:
            raise BackendError(
                f"PhysicsOptions.torque_speed_limit is on, but this parameter set of robot '{scene.robot.name}' does not "
                "say how fast its motors turn; add full_torque_speed and no_load_speed to robot.toml, or turn it off"
            )
        driving = torque if constants.driving_torque_limit is None else np.asarray(constants.driving_torque_limit)
        end = np.asarray(none)
        return cls(torque=torque, driving=driving, no_load_speed=end, fall=end - np.asarray(full), by_speed=True)

    def to(self, *, device: torch.device, dtype: torch.dtype) -> MotorLimits:
        """Return the limits as torch tensors."""
        names = ("torque", "driving", "no_load_speed", "fall")
        tensors = {name: torch.as_tensor(getattr(self, name), device=device, dtype=dtype) for name in names}
        return MotorLimits(**tensors, by_speed=self.by_speed)

    def bounds(self, velocity: Any) -> tuple[Any, Any]:
        """Return the least and largest torque [N·m] at joint velocities [rad/s], (…, J)."""
        if not self.by_speed:
            return -self.torque, self.torque
        where = torch.where if isinstance(velocity, torch.Tensor) else np.where
        driving = self.driving * ((self.no_load_speed - abs(velocity)) / self.fall).clip(0.0, 1.0)
        return where(velocity <= 0, -driving, -self.torque), where(velocity >= 0, driving, self.torque)


def motor_torque(
    error: Any, velocity: Any, *, stiffness: Any, damping: Any, strength: Any, limits: MotorLimits, speed: Any = 1.0
) -> Any:
    """Return the torque of the motors [N·m], (…, J); NaN where an argument is.

    Args:
        error: target + offset − position [rad].
        velocity: joint velocity [rad/s].
        stiffness: kp [N·m/rad].
        damping: kd [N·m·s/rad].
        strength: factor on the torque after its limit.
        limits: of the same kind of arrays.
        speed: factor on the speeds of the limits.
    """
    return (stiffness * error - damping * velocity).clip(*limits.bounds(velocity / speed)) * strength
