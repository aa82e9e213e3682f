# mypy: ignore-errors
# ruff: noqa: ANN201, UP018
"""Targets, latency and law of the motors of all worlds: ``gaitgauge.backends.motor_law`` for kernels."""

# Warp reads the annotations of structs and functions: no ``from __future__ import annotations`` here.
import numpy as np
import torch
import warp as wp

from ..base import Scene
from ..motor_law import MotorLimits
from .state import StateArrays

wp.set_module_options({"enable_backward": False})


@wp.struct
class Motors:
    """Law and targets of every world and joint, (N, J) but for limits (J,) and (N,)."""

    torque_limit: wp.array[float]
    driving_limit: wp.array[float]
    no_load_speed: wp.array[float]
    fall: wp.array[float]
    """Limits as in ``MotorLimits``, (J,)."""
    direct: int
    """1 where a target is the torque itself."""
    by_velocity: wp.array[int]
    """1 where a target is a velocity, (J,)."""
    stiffness: wp.array2d[float]
    damping: wp.array2d[float]
    strength: wp.array2d[float]
    speed: wp.array2d[float]
    offset: wp.array2d[float]
    requested: wp.array2d[float]
    """Targets of the present step or reset."""
    current: wp.array2d[float]
    previous: wp.array2d[float]
    """Target that acts during the delay."""
    limp: wp.array[int]
    limp_before: wp.array[int]
    delay: wp.array[int]
    torque: wp.array2d[float]


class MotorTensors:
    """Tensors of the motors for torch, and the same memory as ``arrays`` for kernels. N worlds, J joints."""

    def __init__(self, scene: Scene, device: torch.device) -> None:
        shape, limits = (scene.num_worlds, scene.robot.num_joints), MotorLimits.of(scene)
        on = wp.device_from_torch(device)

        def tensor(values: object) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.nominal_stiffness = tensor(scene.parameters.stiffness)
        self.nominal_damping = tensor(scene.parameters.damping)
        """Damping and, above, stiffness of the parameter set, (J,)."""
        self.torque_limit = tensor(limits.torque)
        """Torque limit at rest, (J,)."""
        self.stiffness = self.nominal_stiffness.repeat(shape[0], 1)
        self.damping = self.nominal_damping.repeat(shape[0], 1)
        self.strength = torch.ones(shape, dtype=torch.float32, device=device)
        self.speed = torch.ones(shape, dtype=torch.float32, device=device)
        self.offset = torch.zeros(shape, dtype=torch.float32, device=device)
        self.requested = torch.zeros(shape, dtype=torch.float32, device=device)
        """Targets of the present step or reset, (N, J)."""
        self.delay = torch.zeros(shape[0], dtype=torch.int32, device=device)
        """Number of substeps of the previous target, (N,)."""
        self.arrays = arrays = Motors()
        arrays.direct = int(scene.parameters.motor == "torque")
        self._by_velocity = torch.tensor(scene.robot.driven_by_velocity, dtype=torch.int32, device=device)
        arrays.by_velocity = wp.from_torch(self._by_velocity)
        for name in ("torque_limit", "stiffness", "damping", "strength", "speed", "offset", "requested", "delay"):
            setattr(arrays, name, wp.from_torch(getattr(self, name)))
        self._limits = [tensor(getattr(limits, name)) for name in ("driving", "no_load_speed", "fall")]
        arrays.driving_limit, arrays.no_load_speed, arrays.fall = map(wp.from_torch, self._limits)
        for name in ("current", "previous", "torque"):
            setattr(arrays, name, wp.zeros(shape, dtype=float, device=on))
        arrays.limp, arrays.limp_before = (wp.ones(shape[0], dtype=int, device=on) for _ in range(2))

    def described(self) -> dict[str, np.ndarray]:
        """Return the constants of the first world's motors by their names in ``PhysicsBackend.describe``, (J,) each."""
        values = {"stiffness": self.stiffness[0], "damping": self.damping[0], "torque_limit": self.torque_limit}
        return {name: (value * self.strength[0]).cpu().numpy() for name, value in values.items()}


@wp.func
def take_target(motors: Motors, world: int, joint: int, has_request: int):
    """Shift a joint's targets at the start of a control period."""
    motors.previous[world, joint] = motors.current[world, joint]
    if has_request != 0:
        motors.current[world, joint] = motors.requested[world, joint]


@wp.func
def begin_world(motors: Motors, world: int, has_request: int, state: StateArrays):
    """Shift a world's limpness at the start of a control period, and clear its watches."""
    motors.limp_before[world] = motors.limp[world]
    if has_request != 0:
        motors.limp[world] = 0
    state.tilt_substep[world] = wp.int64(0)
    state.penetration_substep[world] = wp.int64(0)


@wp.func
def hold_target(motors: Motors, world: int, joint: int, has_held: int):
    """Let a joint hold ``requested`` after a reset, or nothing."""
    held = float(0.0)
    if has_held != 0:
        held = motors.requested[world, joint]
    motors.current[world, joint] = held
    motors.previous[world, joint] = held
    motors.torque[world, joint] = 0.0


@wp.func
def reset_world(motors: Motors, world: int, has_held: int, state: StateArrays):
    """Reset a world's limpness, and clear its flags."""
    motors.limp[world] = 1 - has_held
    motors.limp_before[world] = 1 - has_held
    state.diverged[world] = False
    state.overflowed[world] = False
    state.tilt_substep[world] = wp.int64(0)
    state.penetration_substep[world] = wp.int64(0)


@wp.func
def motor_torque(motors: Motors, world: int, joint: int, substep: int, position: float, velocity: float) -> float:
    """Return the motor law's torque in a substep (from 0); NaN for an invalid target or state, which a clamp would hide."""
    target = motors.current[world, joint]
    limp = motors.limp[world]
    if substep < motors.delay[world]:
        target = motors.previous[world, joint]
        limp = motors.limp_before[world]
    if limp != 0:
        return 0.0
    error = target + motors.offset[world, joint] - position
    torque = motors.stiffness[world, joint] * error - motors.damping[world, joint] * velocity
    if motors.by_velocity[joint] != 0:
        torque = motors.damping[world, joint] * (target - velocity)
    if motors.direct != 0:
        torque = target
    if wp.isnan(torque):
        return torque
    turning = wp.abs(velocity) / motors.speed[world, joint]
    share = wp.clamp((motors.no_load_speed[joint] - turning) / motors.fall[joint], 0.0, 1.0)
    driving = motors.driving_limit[joint] * share
    lower = -motors.torque_limit[joint]
    upper = motors.torque_limit[joint]
    if velocity <= 0.0:
        lower = -driving
    if velocity >= 0.0:
        upper = driving
    return wp.clamp(torque, lower, upper) * motors.strength[world, joint]


@wp.kernel
def read_torques(select: wp.array[int], value: int, motors: Motors, out: StateArrays) -> None:
    """Read torques of the last substep in the worlds with ``select == value``; zero where the world diverged."""
    world, joint = wp.tid()
    if select[world] != value:
        return
    torque = motors.torque[world, joint]
    if out.diverged[world]:
        torque = 0.0
    out.joint_torque[world, joint] = torque
