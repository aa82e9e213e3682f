"""MuJoCo's equations on the GPU: thousands of worlds stepped together by mujoco_warp, in float32.

A control period (motor law, physics steps, watches, samples, read-out) is one CUDA graph, and nothing in ``step``,
``reset``, ``randomize`` and ``push`` waits for the device. Inputs are copied into fixed buffers, from which kernels
read; the tensors of ``state`` and ``sample`` are those kernels' outputs. On the CPU the same kernels run one by one:
right, but slow.

After a step, positions and velocities are those of the new state; forces are those of the last substep and come from
the contacts with which it started, as in the ``mujoco`` engine; so does the penetration watch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import mujoco_warp
import torch
import warp as wp

from ..base import (
    CAPABILITY_NAMES,
    BackendError,
    Capability,
    PhysicsBackend,
    PhysicsOptions,
    PhysicsState,
    Randomization,
    Scene,
    Support,
)
from ..devices import find_device
from . import kernels, readout
from .arrays import (
    StateArrays,
    allocate_state,
    contact_arrays,
    link_arrays,
    motion_arrays,
    palette_arrays,
    role_arrays,
    shared_array,
    to_warp,
)
from .device import DeviceScope, bytes_per_world, is_memory_error, memory_advice
from .height_fields.repair import repair_height_fields
from .model import SMALLEST_TOLERANCE, Capacity, SharedModel, buffer_capacity, build_shared_model
from .order import CanonicalOrder
from .parameters import BATCHED_FIELDS, WorldParameters

repair_height_fields()

_ALARMS = mujoco_warp.OverflowType
_DROPPED = int(
    _ALARMS.NEFC
    | _ALARMS.NJMAX_NNZ
    | _ALARMS.BROADPHASE
    | _ALARMS.NARROWPHASE
    | _ALARMS.CCD
    | _ALARMS.HFIELD
    | _ALARMS.EPA_HORIZON
)
"""Alarms that mean dropped contacts or constraints; a solver that stopped at its iteration limit is none."""
PARKED_HEIGHT = 100.0
"""Height at which a robot waits, away from every contact, that has diverged or must not step [m]."""


class MujocoWarpBackend(PhysicsBackend):
    """mujoco_warp on a CUDA device, or on the CPU for tests."""

    name: ClassVar[str] = "mujoco-warp"
    state_stays: ClassVar[bool] = True

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """What the engine does, all of it in single precision."""
        entries = {name: Capability(support=Support.EXACT) for name in CAPABILITY_NAMES}
        entries["penetration"] = Capability(support=Support.EXACT, note="seen one substep late")
        entries["height_field"] = Capability(
            support=Support.EXACT, note="at most 4 contacts for each geom, where MuJoCo keeps up to 50"
        )
        entries["deterministic"] = Capability(
            support=Support.EXACT, note="on a GPU with PhysicsOptions.deterministic, which sorts contacts every substep"
        )
        return entries

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``PhysicsBackend.solver_settings``: no tolerance below what single precision can reach."""
        return {**super().solver_settings(physics), "tolerance": max(physics.tolerance, SMALLEST_TOLERANCE)}

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        self.scene = scene
        self.device = find_device(device, self.name)
        self.dtype = torch.float32
        self._scope = DeviceScope(self.device)
        self._graphs: dict[tuple[int, bool], wp.Graph] = {}
        self._shared = build_shared_model(scene)
        capacity = buffer_capacity(scene, self._shared)
        free = self._scope.free_bytes()
        try:
            with self._scope():
                self._build(self._shared, capacity)
            self._reset_to_default()
            if self._scope.on_gpu:
                with self._scope():  # compiles the kernels, so that none has to be while a graph is recorded
                    self._control_period(1, sampled=True)
                self.step(None)  # records the graph and finds out whether its scratch memory fits
                self._reset_to_default()
                torch.cuda.synchronize(self.device)
        except (RuntimeError, torch.cuda.OutOfMemoryError) as error:
            if isinstance(error, BackendError) or not is_memory_error(error):
                raise
            processors = wp.device_from_torch(self.device).sm_count
            per_world = bytes_per_world(self._shared.model, capacity, scene.num_worlds, processors)
            raise BackendError(memory_advice(scene.num_worlds, self.device, free, per_world)) from error

    # ---- building -------------------------------------------------------------------------------------------------

    def _build(self, shared: SharedModel, capacity: Capacity) -> None:
        """Model, data and buffers on the device."""
        scene, model = self.scene, shared.model
        n, robot = scene.num_worlds, scene.robot
        self._model = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(BATCHED_FIELDS, n))
        self._model.opt.warn_overflow = 0  # alarms are reported per world, not printed by the device
        self._model.opt.tolerance.fill_(self.solver_settings(scene.physics)["tolerance"])
        if scene.physics.deterministic:
            self._model.opt.deterministic = int(mujoco_warp.DeterminismType.ATOMICS)
        self._data = mujoco_warp.make_data(
            model, nworld=n, naconmax=capacity.contacts, naccdmax=capacity.convex, njmax=capacity.rows
        )
        joints, feet, bodies = robot.num_joints, len(robot.foot_names), len(robot.collision_bodies)
        self._joints, self._feet, self._bodies = joints, feet, bodies
        self._parameters = WorldParameters(scene, shared, self._model, self.device)
        self._motors, self._motion = self._parameters.motors, motion_arrays(self._model, self._data)
        self._state, self._live = allocate_state(n, joints, feet, bodies, self.device)
        self._sample, self._sampled = allocate_state(n, joints, feet, bodies, self.device)
        self._palette, self._links = palette_arrays(shared.palette), link_arrays(shared.chains)
        self._roles, self._slot_geom = role_arrays(shared), to_warp(shared.slot_geom, int)
        self._contacts = contact_arrays(self._data, pyramidal=scene.physics.cone == "pyramidal")
        if scene.physics.deterministic:
            self._order = CanonicalOrder(self._model, self._data)
            # called between collision detection and constraints, and between constraints and solver
            self._model.callback.contactfilter = lambda _, data: self._order.sort_contacts(data)
            self._model.callback.control = lambda _, data: self._order.sort_rows(data)
        self._active, self._sample_at = self._integers(n), self._integers(n)
        self._has_request = self._integers(1)
        self._terrain, self._new_terrain = self._integers(n), self._integers(n)
        self._pose, self._twist = self._floats(n, 7), self._floats(n, 6)
        self._new_position, self._new_velocity = self._floats(n, joints), self._floats(n, joints)
        self._kept = self._floats(n, model.nq + 2 * model.nv + 1)
        self._kept_overflow = self._integers(n)
        parked = model.qpos0.copy()
        parked[:7] = (0.0, 0.0, PARKED_HEIGHT, 1.0, 0.0, 0.0, 0.0)
        parked[shared.joint_q] = robot.default_joint_position
        self._parked = to_warp(parked, float)
        self._default_joints = torch.tensor(robot.default_joint_position, dtype=torch.float32, device=self.device)
        self._external = wp.to_torch(self._data.xfrc_applied)
        self._upright_limit = -2.0 if scene.physics.watch_tilt is None else math.cos(scene.physics.watch_tilt)
        # the buffers once more, as the kernels see them
        self._active_array, self._sample_array = shared_array(self._active), shared_array(self._sample_at)
        self._request_array, self._terrain_array = shared_array(self._has_request), shared_array(self._terrain)
        self._reset_arrays = [
            shared_array(t) for t in (self._pose, self._twist, self._new_position, self._new_velocity)
        ]
        self._kept_arrays = [shared_array(self._kept), shared_array(self._kept_overflow)]
        self._new_terrain_array = shared_array(self._new_terrain)

    def _floats(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=torch.float32, device=self.device)

    def _integers(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=torch.int32, device=self.device)

    def _reset_to_default(self) -> None:
        """Every world at its first terrain's origin in the default pose."""
        n = self.num_worlds
        position = self._floats(n, 3)
        position[:, 2] = self.scene.robot.stand_height
        quaternion = self._floats(n, 4)
        quaternion[:, 0] = 1.0
        terrain = torch.tensor(self.scene.terrain_index, device=self.device)
        self.reset(base_position=position, base_quaternion=quaternion, terrain_index=terrain)

    # ---- reading --------------------------------------------------------------------------------------------------

    @property
    def state(self) -> PhysicsState:
        """State after the last call; the tensors change with the next one."""
        return self._state

    @property
    def sample(self) -> PhysicsState:
        """Snapshot taken by the last ``step(sample_at=…)``."""
        return self._sample

    def _read(self, select: wp.array, value: int, out: StateArrays, *, forces: bool) -> None:
        """Launch the read-out of the worlds whose ``select`` is ``value``."""
        n, motion, motors = self.num_worlds, self._motion, self._motors
        chosen = [select, value]
        wp.launch(
            readout.read_joints, dim=(n, self._joints), inputs=[*chosen, _DROPPED, motors, motion, self._live, out]
        )
        wp.launch(readout.read_feet, dim=(n, self._feet), inputs=[*chosen, self._links, motion, out])
        if forces:
            sizes = [self._feet, self._bodies]
            wp.launch(readout.read_contacts, dim=n, inputs=[*chosen, *sizes, self._contacts, self._roles, motion, out])
            wp.launch(readout.read_torques, dim=(n, self._joints), inputs=[*chosen, motors, out])

    # ---- acting ---------------------------------------------------------------------------------------------------

    def _set_active(self, worlds: torch.Tensor | None) -> None:
        """Write the mask of the worlds that the next kernels touch."""
        if worlds is None:
            self._active.fill_(1)
            return
        if worlds.dtype != torch.bool or worlds.shape != (self.num_worlds,):
            raise BackendError(
                f"the mask of worlds must be {self.num_worlds} booleans, not {tuple(worlds.shape)} of {worlds.dtype}"
            )
        self._active.copy_(worlds)

    @staticmethod
    def _fill(buffer: torch.Tensor, value: torch.Tensor | None, name: str, default: torch.Tensor | float = 0.0) -> None:
        """Copy an argument with a row for each world into its buffer."""
        if value is not None and value.shape != buffer.shape:
            raise BackendError(f"{name} has shape {tuple(value.shape)}, but must be {tuple(buffer.shape)}")
        source = default if value is None else value
        if isinstance(source, torch.Tensor):
            buffer.copy_(source)
        else:
            buffer.fill_(source)

    def reset(
        self,
        worlds: torch.Tensor | None = None,
        *,
        base_position: torch.Tensor,
        base_quaternion: torch.Tensor,
        joint_position: torch.Tensor | None = None,
        base_linear_velocity: torch.Tensor | None = None,
        base_angular_velocity: torch.Tensor | None = None,
        joint_velocity: torch.Tensor | None = None,
        held_target: torch.Tensor | None = None,
        terrain_index: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.reset``."""
        self._set_active(worlds)
        self._fill(self._pose[:, 0:3], base_position, "base_position")
        self._fill(self._pose[:, 3:7], base_quaternion, "base_quaternion")
        self._fill(self._twist[:, 0:3], base_linear_velocity, "base_linear_velocity")
        self._fill(self._twist[:, 3:6], base_angular_velocity, "base_angular_velocity")
        self._fill(self._new_position, joint_position, "joint_position", self._default_joints)
        self._fill(self._new_velocity, joint_velocity, "joint_velocity")
        self._fill(self._parameters.requested, held_target, "held_target")
        self._has_request.fill_(int(held_target is not None))
        if terrain_index is not None:
            self._check_terrain(terrain_index, worlds)
            self._fill(self._new_terrain, terrain_index, "terrain_index")
        n, active = self.num_worlds, self._active_array
        with self._scope():
            if terrain_index is not None:
                self._place_terrain()
            wp.launch(
                kernels.reset_worlds,
                dim=(n, self._joints),
                inputs=[active, self._request_array, *self._reset_arrays, self._motors, self._motion, self._live],
            )
            sizes = [self._joints, self._feet, self._bodies]
            wp.launch(readout.clear_forces, dim=n, inputs=[active, *sizes, self._live])
            self._read(active, 1, self._live, forces=False)

    def _check_terrain(self, index: torch.Tensor, worlds: torch.Tensor | None) -> None:
        """Refuse indices outside the palette; on a GPU, where looking would mean to wait, the kernel clamps them."""
        if self._scope.on_gpu:
            return
        chosen = index if worlds is None else index[worlds]
        last = len(self.scene.terrains) - 1
        if chosen.numel() and (int(chosen.min()) < 0 or int(chosen.max()) > last):
            raise BackendError(
                f"terrain_index holds {int(chosen.min())} to {int(chosen.max())}, but the terrains are 0 to {last}"
            )

    def _place_terrain(self) -> None:
        """Give the masked worlds the terrains asked for."""
        model, data, slots = self._model, self._data, len(self._shared.slot_geom)
        wp.launch(
            kernels.place_terrain,
            dim=(self.num_worlds, max(slots, 1)),
            inputs=[
                self._active_array,
                self._new_terrain_array,
                len(self.scene.terrains),
                slots,
                self._slot_geom,
                self._palette,
                self._terrain_array,
                data.geom_xpos,
                data.geom_xmat,
                model.geom_size,
                model.geom_aabb,
                model.geom_rbound,
                model.geom_dataid,
                int(self._shared.has_field),
            ],
        )

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
        total = self.scene.physics.substeps if substeps is None else substeps
        if total < 1:
            raise BackendError(f"substeps is {total}, but a step has at least one")
        self._set_active(worlds)
        self._has_request.fill_(int(joint_targets is not None))
        self._fill(self._parameters.requested, joint_targets, "joint_targets")
        self._fill(self._parameters.delay, delay, "delay", 0)
        if sample_at is not None:
            self._fill(self._sample_at, sample_at, "sample_at")
            self._sample_at.mul_(self._active)
        sampled = sample_at is not None
        if not self._scope.on_gpu:
            with self._scope():
                self._control_period(total, sampled=sampled)
            return
        if (total, sampled) not in self._graphs:
            self._graphs[total, sampled] = self._capture(total, sampled=sampled)
        wp.capture_launch(self._graphs[total, sampled], stream=self._scope.stream())

    def _capture(self, total: int, *, sampled: bool) -> wp.Graph:
        """Record a control period. Once for each number of substeps; nothing runs while recording."""
        torch.cuda.synchronize(self.device)
        device = self._scope.warp_device
        with wp.ScopedDevice(device), wp.ScopedCapture(device) as capture:
            self._control_period(total, sampled=sampled)
        return capture.graph

    def _control_period(self, total: int, *, sampled: bool) -> None:
        """Launch everything that happens between two targets."""
        n, data, motors, motion, live = self.num_worlds, self._data, self._motors, self._motion, self._live
        active, each_joint = self._active_array, (n, self._joints)
        depth, positions = self.scene.physics.watch_penetration, (n, self._motion.positions)
        keep = [self._parked, motion, *self._kept_arrays]
        wp.launch(kernels.begin_period, dim=each_joint, inputs=[active, self._request_array, motors, live])
        wp.launch(kernels.keep_inactive, dim=positions, inputs=[active, 0, *keep])
        for substep in range(total):
            wp.launch(kernels.motor_law, dim=each_joint, inputs=[substep, motors, motion])
            mujoco_warp.step(self._model, data)
            wp.launch(
                kernels.end_substep, dim=n, inputs=[substep, self._upright_limit, active, self._parked, motion, live]
            )
            if depth is not None:
                tables = [self._contacts, self._roles, self._palette, self._terrain_array]
                wp.launch(kernels.watch_penetration, dim=data.naconmax, inputs=[substep, depth, active, *tables, live])
            if sampled:
                self._read(self._sample_array, substep + 1, self._sampled, forces=True)
        wp.launch(kernels.keep_inactive, dim=positions, inputs=[active, 1, *keep])
        self._read(active, 1, live, forces=True)

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.push``."""
        self._set_active(worlds)
        self._fill(self._twist[:, 0:3], linear_velocity_w, "linear_velocity_w", math.nan)
        self._fill(self._twist[:, 3:6], angular_velocity_b, "angular_velocity_b", math.nan)
        twist = self._reset_arrays[1]
        with self._scope():
            wp.launch(kernels.push_base, dim=(self.num_worlds, 6), inputs=[self._active_array, twist, self._motion])
            self._read(self._active_array, 1, self._live, forces=False)

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        self._fill(self._external[:, self._shared.base, 0:3], force_w, "force_w")

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``. Fields may also have a row for every world; then the masked rows count."""
        self._set_active(worlds)
        if self._parameters.write(randomization, self._active.bool(), whole=worlds is None):
            with self._scope():
                mujoco_warp.set_const(self._model, self._data, restore=False)

    def describe(self) -> Mapping[str, list[float]]:
        """See ``PhysicsBackend.describe``."""
        with self._scope():
            return self._parameters.describe(self._model, self._shared)

    def close(self) -> None:
        """Drop the recorded graphs and the memory that they hold."""
        self._graphs.clear()
