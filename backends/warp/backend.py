"""The common part of the engines on Warp: buffers that torch writes and kernels read, masks, targets, graphs.

On a GPU a control period is one CUDA graph, and no call waits for the device. Inputs are copied into fixed buffers for the
kernels; the tensors of ``state`` and ``sample`` are the kernels' outputs. On the CPU the same kernels run one by one, slowly.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import fields
from functools import partial
from typing import Any, ClassVar

import torch
import warp as wp

from ..arguments import check_push, check_randomization, check_start, check_step
from ..base import BackendError, PhysicsBackend, Randomization, ResetState, Scene
from ..devices import find_device
from .device import DeviceScope
from .motors import MotorTensors, read_torques
from .state import StateArrays, allocate_state, clear_forces


class WarpBackend(PhysicsBackend):
    """N worlds on Warp. An engine adds its model and kernels."""

    torque_motors: ClassVar[bool] = True
    velocity_targets: ClassVar[bool] = True
    always_masked: ClassVar[bool] = False
    """True where every control period puts aside worlds that must not step, so that one graph serves all masks."""

    def _open(self, scene: Scene, device: str) -> None:
        """Find the device, or raise ``BackendError``, before anything is built."""
        self.scene, self.device, self.dtype = scene, find_device(device, self.name), torch.float32
        self._scope = DeviceScope(self.device)
        self._graphs: dict[tuple[int, bool, bool], wp.Graph] = {}

    def _allocate(self) -> None:
        """Allocate the memory that torch and kernels share, on the present device."""
        scene, robot, n = self.scene, self.scene.robot, self.scene.num_worlds
        self._joints, self._feet, self._bodies = robot.num_joints, len(robot.foot_names), len(robot.collision_bodies)
        sizes = {"joints": self._joints, "feet": self._feet, "bodies": self._bodies}
        allocate = partial(allocate_state, n, **sizes, device=self.device)
        self._state, self._live = allocate()
        self._sample, self._sampled = allocate()
        self._motors = MotorTensors(scene, self.device)
        self._active, self._sample_at = self._integers(n), self._integers(n)
        self._has_request = self._integers(1)
        self._terrain, self._new_terrain = self._integers(n), self._integers(n)
        self._pose, self._twist = self._floats(n, 7), self._floats(n, 6)
        self._new_position, self._new_velocity = self._floats(n, self._joints), self._floats(n, self._joints)
        self._default_joints = torch.tensor(robot.default_joint_position, dtype=torch.float32, device=self.device)
        tilt = scene.physics.watch_tilt
        self._upright_limit = -2.0 if tilt is None else math.cos(min(tilt, math.pi))
        # the same buffers as Warp arrays for the kernels
        self._active_array, self._sample_array = wp.from_torch(self._active), wp.from_torch(self._sample_at)
        self._request_array, self._terrain_array = wp.from_torch(self._has_request), wp.from_torch(self._terrain)
        self._new_terrain_array, self._twist_array = wp.from_torch(self._new_terrain), wp.from_torch(self._twist)
        start = (self._pose, self._twist, self._new_position, self._new_velocity)
        self._reset_arrays = [wp.from_torch(tensor) for tensor in start]

    def _floats(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=torch.float32, device=self.device)

    def _integers(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=torch.int32, device=self.device)

    def _reset_to_default(self, height: float) -> None:
        """Put every world at its first terrain's origin in the default pose."""
        position, quaternion = self._floats(self.num_worlds, 3), self._floats(self.num_worlds, 4)
        position[:, 2], quaternion[:, 0] = height, 1.0
        terrain = torch.tensor(self.scene.terrain_index, device=self.device)
        self.reset(ResetState(base_position=position, base_quaternion=quaternion, terrain_index=terrain))

    # ---- what an engine adds ----------------------------------------------------------------------------------------

    @abstractmethod
    def _control_period(self, total: int, *, masked: bool, sampled: bool) -> None:
        """Launch the ``total`` substeps between two targets; ``masked``: some worlds may stay; ``sampled``: fill the sample."""

    @abstractmethod
    def _place_terrain(self) -> None:
        """Launch the kernels that give the active worlds the terrains in ``_new_terrain``."""

    @abstractmethod
    def _place_robots(self) -> None:
        """Launch the kernels that put the active worlds into the states in the buffers."""

    @abstractmethod
    def _push_base(self) -> None:
        """Launch the kernels that give the active worlds' bases the velocities in ``_twist``."""

    # ---- the contract -----------------------------------------------------------------------------------------------

    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.reset``. On a GPU the kernel clamps terrains, because a check would wait for the device."""
        check_start(self.scene, start, worlds)
        self._select(worlds)
        self._fill(self._pose[:, 0:3], start.base_position)
        self._fill(self._pose[:, 3:7], start.base_quaternion)
        self._fill(self._twist[:, 0:3], start.base_linear_velocity)
        self._fill(self._twist[:, 3:6], start.base_angular_velocity)
        self._fill(self._new_position, start.joint_position, self._default_joints)
        self._fill(self._new_velocity, start.joint_velocity)
        self._fill(self._motors.requested, start.held_target)
        self._has_request.fill_(int(start.held_target is not None))
        terrain = start.terrain_index
        if terrain is not None:
            self._fill(self._new_terrain, terrain)
        with self._scope():
            if terrain is not None:
                self._place_terrain()
            self._place_robots()

    def step(
        self,
        joint_targets: torch.Tensor | None,
        *,
        delay: torch.Tensor | None = None,
        sample_at: torch.Tensor | None = None,
        worlds: torch.Tensor | None = None,
        substeps: int | None = None,
    ) -> None:
        """See ``PhysicsBackend.step``."""
        total = check_step(self.scene, joint_targets, delay, sample_at, worlds, substeps)
        self._select(worlds)
        self._has_request.fill_(int(joint_targets is not None))
        self._fill(self._motors.requested, joint_targets)
        self._fill(self._motors.delay, delay, 0)
        if sample_at is not None:
            self._fill(self._sample_at, sample_at)
            self._sample_at.mul_(self._active)
        masked, sampled = self.always_masked or worlds is not None, sample_at is not None
        if not self._scope.on_gpu:
            with self._scope():
                self._control_period(total, masked=masked, sampled=sampled)
            return
        key = (total, masked, sampled)
        if key not in self._graphs:  # once for each number of substeps
            self._graphs[key] = self._scope.record(lambda: self._control_period(total, masked=masked, sampled=sampled))
        self._scope.replay(self._graphs[key])

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.push``."""
        check_push(self.scene, worlds, linear_velocity_w, angular_velocity_b)
        self._select(worlds)
        self._fill(self._twist[:, 0:3], linear_velocity_w, math.nan)
        self._fill(self._twist[:, 3:6], angular_velocity_b, math.nan)
        with self._scope():
            self._push_base()

    def close(self) -> None:
        """Free the recorded graphs with their memory."""
        self._graphs.clear()

    # ---- writing buffers --------------------------------------------------------------------------------------------

    def _select(self, worlds: torch.Tensor | None) -> None:
        """Write the mask of the worlds that the next kernels touch."""
        if worlds is None:
            self._active.fill_(1)
        else:
            self._active.copy_(worlds)

    @staticmethod
    def _fill(buffer: torch.Tensor, value: torch.Tensor | None, default: torch.Tensor | float = 0.0) -> None:
        """Copy an argument with a row for each world into its buffer."""
        source = default if value is None else value
        if isinstance(source, torch.Tensor):
            buffer.copy_(source)
        else:
            buffer.fill_(source)

    def _changes(self, randomization: Randomization, worlds: torch.Tensor | None) -> dict[str, torch.Tensor]:
        """Return the fields that change, each with a row for every world; rows outside of the mask are void.

        The mask is written into ``_active``. A field may have a row for each masked world, or one for every world.

        Raises:
            BackendError: mask or shape, or a field has another number of rows.
        """
        check_randomization(self.scene, randomization, worlds)
        self._select(worlds)
        rows: dict[str, torch.Tensor] = {}
        for item in fields(Randomization):
            value = getattr(randomization, item.name)
            if value is None:
                continue
            value = value.to(device=self.device, dtype=torch.float32)
            if len(value) != self.num_worlds:
                counted = worlds is not None and self.device.type == "cpu"  # counting would wait for a GPU
                wanted = int(self._active.sum()) if counted else len(value) if worlds is not None else self.num_worlds
                if len(value) != wanted or len(value) == 0:
                    count = f"{len(value)} rows for {wanted} worlds"
                    raise BackendError(f"Randomization.{item.name} has {count}; give one row for each")
                value = value[(torch.cumsum(self._active, 0) - 1).clamp(0, len(value) - 1)]
            rows[item.name] = value
        return rows

    def _write(self, target: torch.Tensor, rows: torch.Tensor) -> None:
        """Write the active worlds' rows."""
        active = self._active.bool().view(-1, *(1,) * (target.dim() - 1))
        target.copy_(torch.where(active, rows, target))

    def _write_motors(self, rows: dict[str, torch.Tensor]) -> None:
        """Write the changed constants of the motor law."""
        motors = self._motors
        for name, target, unit in (
            ("stiffness_scale", motors.stiffness, motors.nominal_stiffness),
            ("damping_scale", motors.damping, motors.nominal_damping),
            ("motor_strength", motors.strength, 1.0),
            ("motor_speed", motors.speed, 1.0),
            ("motor_offset", motors.offset, 1.0),
        ):
            if name in rows:
                self._write(target, rows[name] * unit)

    # ---- reading ------------------------------------------------------------------------------------------------------

    def _clear_forces(self, select: Any, value: int, out: StateArrays) -> None:
        """Launch the kernel that zeroes the forces of the worlds with ``select == value``."""
        sizes = [self._joints, self._feet, self._bodies]
        wp.launch(clear_forces, dim=self.num_worlds, inputs=[select, value, *sizes, out])

    def _read_torques(self, select: Any, value: int, out: StateArrays) -> None:
        """Launch the kernel that reads the torques of the worlds with ``select == value``."""
        dim: Any = (self.num_worlds, self._joints)
        wp.launch(read_torques, dim=dim, inputs=[select, value, self._motors.arrays, out])
