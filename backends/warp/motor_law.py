# mypy: ignore-errors
"""The motor law of ``gaitgauge.backends.motor_law`` as a Warp function."""

# Warp reads the annotations of functions and structs: no ``from __future__ import annotations`` here.
import warp as wp

from ..motor_law import MotorLimits

wp.set_module_options({"enable_backward": False})


@wp.struct
class Limits:
    """Torque limits of the joints, as ``MotorLimits``, (J,) each."""

    torque: wp.array[float]
    driving: wp.array[float]
    no_load_speed: wp.array[float]
    fall: wp.array[float]


def limit_arrays(limits: MotorLimits, device: wp.Device | None = None) -> Limits:
    """Limits as kernels see them; ``device`` None for Warp's present one."""
    arrays = Limits()
    for name in ("torque", "driving", "no_load_speed", "fall"):
        setattr(arrays, name, wp.array(getattr(limits, name), dtype=float, device=device))
    return arrays


@wp.func
def motor_torque(
    joint: int, error: float, velocity: float, stiffness: float, damping: float, strength: float, limits: Limits
) -> float:
    """Torque of a motor; an invalid target or state gives NaN, which a clamp would hide."""
    torque = stiffness * error - damping * velocity
    if wp.isnan(torque):
        return torque
    share = wp.clamp((limits.no_load_speed[joint] - wp.abs(velocity)) / limits.fall[joint], 0.0, 1.0)
    driving = limits.driving[joint] * share
    lower = -limits.torque[joint]
    upper = limits.torque[joint]
    if velocity <= 0.0:
        lower = -driving
    if velocity >= 0.0:
        upper = driving
    return wp.clamp(torque, lower, upper) * strength
