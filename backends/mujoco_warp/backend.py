"""MuJoCo's equations on the GPU: thousands of worlds stepped together by mujoco_warp, in float32.

After a step, positions and velocities are those of the new state. Forces are those of the last substep; they and the
penetration watch come from the contacts at the substep's start, as in the ``mujoco`` engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco_warp
import torch
import warp as wp

from ..arguments import check_force
from ..base import CAPABILITY_NAMES, BackendError, Capability, PhysicsOptions, Randomization, Scene, Support
from ..upstream.fused_solver import FUSED_SOLVER
from ..upstream.height_fields import HEIGHT_FIELDS
from ..upstream.order import CanonicalOrder
from ..warp.backend import WarpBackend
from ..warp.device import is_memory_error, memory_advice
from ..warp.state import StateArrays
from ..warp.structures import filled, to_warp
from . import kernels, readout, side_by_side
from .arrays import DROPPED, Links, Motion, Palette, Roles, contact_arrays, motion_arrays
from .masses import BATCHED_FIELDS, WorldMasses, describe_model
from .memory import bytes_per_world
from .model import SMALLEST_TOLERANCE, Capacity, SharedModel, buffer_capacity, build_shared_model

PARKED_HEIGHT = 100.0
"""Height of robots that have diverged or must not step, away from every contact [m]."""


class MujocoWarpBackend(WarpBackend):
    """mujoco_warp on a CUDA device, or on the CPU for tests."""

    name: ClassVar[str] = "mujoco-warp"
    family: ClassVar[str] = "MuJoCo"
    state_stays: ClassVar[bool] = True
    always_masked: ClassVar[bool] = True

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Declare every capability, in single precision."""
        notes = {
            "penetration": "seen one substep late",
            "height_field": "at most 4 contacts for each geom, where MuJoCo keeps up to 50",
            "deterministic": "on a GPU with PhysicsOptions.deterministic, which sorts contacts every substep",
        }
        return {name: Capability(support=Support.EXACT, note=notes.get(name, "")) for name in CAPABILITY_NAMES}

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``PhysicsBackend.solver_settings``: no tolerance below what single precision can reach."""
        return {**super().solver_settings(physics), "tolerance": max(physics.tolerance, SMALLEST_TOLERANCE)}

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        self._open(scene, device)
        HEIGHT_FIELDS.apply()
        FUSED_SOLVER.apply()
        self._shared = build_shared_model(scene)
        capacity = buffer_capacity(scene, self._shared)
        free = self._scope.free_bytes()
        try:
            with self._scope():
                self._build(self._shared, capacity)
            self._reset_to_default(scene.robot.stand_height)
            if self._scope.on_gpu:
                with self._scope():  # compiles the kernels before a graph is recorded
                    self._control_period(1, masked=True, sampled=True)
                self.step(None)  # records the graph and tests that its scratch memory fits
                self._reset_to_default(scene.robot.stand_height)
                torch.cuda.synchronize(self.device)
        except (RuntimeError, torch.cuda.OutOfMemoryError) as error:
            if isinstance(error, BackendError) or not is_memory_error(error):
                raise
            processors = wp.device_from_torch(self.device).sm_count
            per_world = bytes_per_world(self._shared.model, capacity, scene.num_worlds, processors)
            raise BackendError(memory_advice(scene.num_worlds, self.device, free, per_world)) from error

    def _build(self, shared: SharedModel, capacity: Capacity) -> None:
        """Build model, data and buffers on the device."""
        scene, model = self.scene, shared.model
        n, robot = scene.num_worlds, scene.robot
        self._model = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(BATCHED_FIELDS, n))
        self._model.opt.warn_overflow = 0  # alarms are reported per world, not printed by the device
        self._model.opt.tolerance.fill_(self.solver_settings(scene.physics)["tolerance"])
        if scene.physics.deterministic:
            self._model.opt.deterministic = int(mujoco_warp.DeterminismType.ATOMICS)
        sizes = {"naconmax": capacity.contacts, "naccdmax": capacity.convex, "njmax": capacity.rows}
        self._data = mujoco_warp.make_data(model, nworld=n, **sizes)
        self._allocate()
        self._masses = WorldMasses(shared, self._model, self.device)
        self._motion = motion_arrays(self._model, self._data, shared)
        self._palette, self._links = filled(Palette, **shared.palette), filled(Links, **shared.links)
        self._roles, self._slot_geom = filled(Roles, **shared.roles), to_warp(shared.slot_geom, int)
        self._contacts = contact_arrays(self._data, pyramidal=scene.physics.cone == "pyramidal")
        if scene.physics.deterministic:
            self._order = CanonicalOrder(self._model, self._data)
            # called between collision detection and constraints, and between constraints and solver
            self._model.callback.contactfilter = lambda _, data: self._order.sort_contacts(data)
            self._model.callback.control = lambda _, data: self._order.sort_rows(data)
        changing = ("qpos", "qvel", "warmstart", "time", "overflow")
        self._kept = filled(Motion, self._motion, **{n: wp.zeros_like(getattr(self._motion, n)) for n in changing})
        parked = model.qpos0.copy()
        parked[:7] = (0.0, 0.0, PARKED_HEIGHT, 1.0, 0.0, 0.0, 0.0)
        parked[shared.joint_q] = robot.default_joint_position
        self._parked = to_warp(parked, float)
        self._external = wp.to_torch(self._data.xfrc_applied)

    # ---- launching ------------------------------------------------------------------------------------------------

    def _read(self, select: Any, value: int, out: StateArrays, *, forces: bool) -> None:
        """Launch the read-out of the worlds with ``select == value``."""
        n, motion, chosen = self.num_worlds, self._motion, [select, value]
        wp.launch(readout.read_joints, dim=(n, self._joints), inputs=[*chosen, DROPPED, motion, self._live, out])
        wp.launch(readout.read_feet, dim=(n, self._feet), inputs=[*chosen, self._links, motion, out])
        if forces:
            sizes = [self._feet, self._bodies]
            wp.launch(readout.read_contacts, dim=n, inputs=[*chosen, *sizes, self._contacts, self._roles, motion, out])
            self._read_torques(select, value, out)

    def _place_robots(self) -> None:
        active, motors = self._active_array, self._motors.arrays
        inputs = [active, self._request_array, *self._reset_arrays, motors, self._motion, self._live]
        wp.launch(kernels.reset_worlds, dim=(self.num_worlds, self._joints), inputs=inputs)
        self._clear_forces(active, 1, self._live)
        self._read(active, 1, self._live, forces=False)

    def _place_terrain(self) -> None:
        model, data, slots = self._model, self._data, len(self._shared.slot_geom)
        asked = [self._active_array, self._new_terrain_array, len(self.scene.terrains), slots]
        tables = [self._slot_geom, self._palette, self._terrain_array]
        poses = [data.geom_xpos, data.geom_xmat]
        shapes = [model.geom_size, model.geom_aabb, model.geom_rbound, model.geom_dataid]
        inputs = [*asked, *tables, *poses, *shapes, int(self._shared.has_field)]
        wp.launch(kernels.place_terrain, dim=(self.num_worlds, max(slots, 1)), inputs=inputs)

    def _control_period(self, total: int, *, masked: bool, sampled: bool) -> None:
        """See ``WarpBackend``; inactive worlds are put aside in any case."""
        n, data, motors, motion, live = self.num_worlds, self._data, self._motors.arrays, self._motion, self._live
        active, each_joint = self._active_array, (n, self._joints)
        depth, positions = self.scene.physics.watch_penetration, (n, self._motion.positions)
        wp.launch(kernels.begin_period, dim=each_joint, inputs=[active, self._request_array, motors, live])
        wp.launch(kernels.copy_inactive, dim=positions, inputs=[active, motion, self._kept])
        wp.launch(kernels.park_inactive, dim=n, inputs=[active, self._parked, motion])
        for substep in range(total):
            wp.launch(kernels.motor_law, dim=each_joint, inputs=[substep, motors, motion])
            side_by_side.step(self._model, data)
            end = [substep, self._upright_limit, active, self._parked, motion, live]
            wp.launch(kernels.end_substep, dim=n, inputs=end)
            if depth is not None:
                tables = [self._contacts, self._roles, self._palette, self._terrain_array]
                wp.launch(kernels.watch_penetration, dim=data.naconmax, inputs=[substep, depth, active, *tables, live])
            if sampled:
                self._read(self._sample_array, substep + 1, self._sampled, forces=True)
        wp.launch(kernels.copy_inactive, dim=positions, inputs=[active, self._kept, motion])
        self._read(active, 1, live, forces=True)

    def _push_base(self) -> None:
        inputs = [self._active_array, self._twist_array, self._motion]
        wp.launch(kernels.push_base, dim=(self.num_worlds, 6), inputs=inputs)
        self._read(self._active_array, 1, self._live, forces=False)

    # ---- the contract ---------------------------------------------------------------------------------------------

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        check_force(self.scene, force_w)
        self._external[:, self._shared.base, 0:3].copy_(force_w)

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``. Fields may also have a row for every world; then the masked rows count."""
        rows = self._changes(randomization, worlds)
        self._write_motors(rows)
        if self._masses.write(rows, self._active.bool()):
            with self._scope():
                mujoco_warp.set_const(self._model, self._data, restore=False)

    def describe(self) -> Mapping[str, list[float]]:
        """See ``PhysicsBackend.describe``."""
        with self._scope():
            return describe_model(self._model, self._shared, self._motors)
