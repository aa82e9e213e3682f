"""MuJoCo's equations on the GPU: thousands of worlds stepped together by mujoco_warp, in float32.

A control period (motor law, physics steps, watches, samples, read-out) is one CUDA graph, and nothing in ``step``, ``reset``,
``randomize`` and ``push`` waits for the device. Inputs are copied into fixed buffers, from which kernels read; the tensors of
``state`` and ``sample`` are those kernels' outputs. On the CPU the same kernels run one by one: right, but slow.

After a step, positions and velocities are those of the new state; forces are those of the last substep and come from the
contacts with which it started, as in the ``mujoco`` engine; so does the penetration watch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from typing import ClassVar

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp as wp

from . import mujoco_warp_kernels as kernels
from .base import (
    CAPABILITY_NAMES,
    BackendError,
    Capability,
    PhysicsBackend,
    PhysicsState,
    Randomization,
    Scene,
    Support,
)
from .mujoco_warp_model import Capacity, SharedModel, buffer_capacity, build_shared_model

_OVERFLOW = mujoco_warp.OverflowType
_DROPPED = int(
    _OVERFLOW.NEFC
    | _OVERFLOW.NJMAX_NNZ
    | _OVERFLOW.BROADPHASE
    | _OVERFLOW.NARROWPHASE
    | _OVERFLOW.CCD
    | _OVERFLOW.HFIELD
    | _OVERFLOW.EPA_HORIZON
)
"""Alarms that mean dropped contacts or constraints; a solver that stopped at its iteration limit is none."""
PARKED_HEIGHT = 100.0
"""Height at which a diverged world's robot waits for its reset, away from every contact [m]."""
_MEMORY_SLACK = 1.6
"""Factor on the arrays of the engine's data for the scratch memory of a step."""
_CONTROL_FIELDS = ("stiffness_scale", "damping_scale", "motor_strength", "motor_offset")
_BATCHED = (
    "geom_friction",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "geom_dataid",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
)
"""Model fields of which every world has its own."""


class MujocoWarpBackend(PhysicsBackend):
    """mujoco_warp on a CUDA device, or on the CPU for tests."""

    name: ClassVar[str] = "mujoco-warp"

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """What the engine does in single precision."""
        entries = {name: Capability(support=Support.EXACT) for name in CAPABILITY_NAMES}
        entries["penetration"] = Capability(support=Support.EXACT, note="seen one substep late")
        entries["height_field"] = Capability(
            support=Support.EXACT, note="at most 4 contacts for each pair of geom and field, as in MuJoCo"
        )
        entries["deterministic"] = Capability(
            support=Support.APPROXIMATE,
            note="exact on the CPU; on a GPU mujoco_warp 3.17 fixes the order of sums but not yet that of contacts",
        )
        return entries

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        self.scene = scene
        self.device = _device(device)
        self.dtype = torch.float32
        self._on_gpu = self.device.type == "cuda"
        wp.init()
        self._warp_device = wp.device_from_torch(self.device)
        self._graphs: dict[tuple[int, bool], wp.Graph] = {}
        self._streams: dict[int, wp.Stream] = {}
        shared = build_shared_model(scene)
        capacity = buffer_capacity(scene, shared)
        self._shared = shared
        try:
            with wp.ScopedDevice(self._warp_device):
                self._build(shared, capacity)
            self._reset_to_default()
            if self._on_gpu:  # compiles all kernels and finds out whether the scratch memory fits
                self.step(None)
                self._reset_to_default()
                torch.cuda.synchronize(self.device)
        except (RuntimeError, torch.cuda.OutOfMemoryError) as error:
            if isinstance(error, BackendError) or not _is_memory_error(error):
                raise
            raise BackendError(self._memory_advice(capacity)) from error

    # ---- building -------------------------------------------------------------------------------------------------

    def _build(self, shared: SharedModel, capacity: Capacity) -> None:
        """Model, data and buffers on the device."""
        scene, model = self.scene, shared.model
        n, robot = scene.num_worlds, scene.robot
        self._model = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(_BATCHED, n))
        self._model.opt.warn_overflow = 0  # alarms are reported per world, not printed by the device
        if scene.physics.deterministic:
            self._model.opt.deterministic = int(mujoco_warp.DeterminismType.ATOMICS)
        self._data = mujoco_warp.make_data(
            model, nworld=n, naconmax=capacity.contacts, naccdmax=capacity.convex, njmax=capacity.rows
        )
        joints, feet, bodies = robot.num_joints, len(robot.foot_names), len(robot.collision_bodies)
        self._feet, self._bodies = feet, bodies
        self._active = self._integers(n)
        self._always = self._integers(n, fill=1)
        self._has_request = self._integers(1)
        self._sample_at = self._integers(n)
        self._terrain = self._integers(n)
        self._requested_terrain = self._integers(n)
        self._pose, self._twist = self._floats(n, 7), self._floats(n, 6)
        self._new_position, self._new_velocity = self._floats(n, joints), self._floats(n, joints)
        self._kept = self._floats(n, model.nq + 2 * model.nv + 1)
        self._kept_overflow = self._integers(n)
        parked = model.qpos0.copy()
        parked[:7] = (0.0, 0.0, PARKED_HEIGHT, 1.0, 0.0, 0.0, 0.0)
        parked[shared.joint_q] = robot.default_joint_position
        self._parked = wp.array(parked, dtype=float)
        self._default_joints = self._floats(joints)
        self._default_joints[:] = torch.tensor(robot.default_joint_position)
        self._external = wp.to_torch(self._data.xfrc_applied)
        self._build_motors(shared)
        self._state, self._live = self._allocate_state()
        self._sample, self._sampled = self._allocate_state()
        self._build_tables(shared)
        self._nominal_mass = wp.to_torch(self._model.body_mass).clone()
        self._nominal_inertia = wp.to_torch(self._model.body_inertia).clone()
        self._nominal_com = wp.to_torch(self._model.body_ipos).clone()
        self._body_ids = torch.tensor(shared.bodies, dtype=torch.int64, device=self.device)
        self._tilt_limit = -2.0 if scene.physics.watch_tilt is None else math.cos(scene.physics.watch_tilt)

    def _floats(self, *shape: int, fill: float = 0.0) -> torch.Tensor:
        return torch.full(shape, fill, dtype=torch.float32, device=self.device)

    def _integers(self, *shape: int, fill: int = 0) -> torch.Tensor:
        return torch.full(shape, fill, dtype=torch.int32, device=self.device)

    def _build_motors(self, shared: SharedModel) -> None:
        """Gains, targets and torques; what ``randomize`` and ``step`` write is kept as tensors."""
        scene, n = self.scene, self.scene.num_worlds
        parameters, joints = scene.parameters, scene.robot.num_joints
        limit = parameters.torque_limit if scene.physics.torque_limits else (1.0e30,) * joints
        self._nominal_stiffness = torch.tensor(parameters.stiffness, device=self.device)
        self._nominal_damping = torch.tensor(parameters.damping, device=self.device)
        self._stiffness = self._nominal_stiffness.repeat(n, 1)
        self._damping = self._nominal_damping.repeat(n, 1)
        self._strength, self._offset = self._floats(n, joints, fill=1.0), self._floats(n, joints)
        self._requested = self._floats(n, joints)
        self._delay = self._integers(n)
        motors = kernels.Motors()
        motors.joint_q, motors.joint_v = _to_warp(shared.joint_q, int), _to_warp(shared.joint_v, int)
        motors.limit = _to_warp(np.asarray(limit), float)
        for name in ("stiffness", "damping", "strength", "offset", "requested", "delay"):
            setattr(motors, name, wp.from_torch(getattr(self, f"_{name}")))
        for name in ("current", "previous", "torque"):
            setattr(motors, name, wp.zeros((n, joints), dtype=float))
        motors.limp, motors.limp_before = wp.full(n, 1, dtype=int), wp.full(n, 1, dtype=int)
        self._motors = motors

    def _allocate_state(self) -> tuple[PhysicsState, kernels.StateArrays]:
        """A state of zeros and the same memory as Warp sees it."""
        n, joints = self.scene.num_worlds, self.scene.robot.num_joints
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("joint_position", "joint_velocity", "joint_torque"), (joints,)
        )
        shapes |= dict.fromkeys(("foot_position_w", "foot_velocity_w", "foot_contact_force_w"), (self._feet, 3))
        shapes |= dict.fromkeys(("foot_normal_force", "foot_tangential_force"), (self._feet,))
        shapes |= {"body_contact_force_w": (self._bodies, 3), "base_quaternion_w": (4,)}
        scalars = {"time": torch.float32, "diverged": torch.bool, "overflowed": torch.bool}
        scalars |= dict.fromkeys(("contact_count", "tilt_substep", "penetration_substep"), torch.int64)
        tensors: dict[str, torch.Tensor] = {}
        arrays = kernels.StateArrays()
        for item in fields(PhysicsState):
            shape = () if item.name in scalars else shapes.get(item.name, (3,))
            kind = scalars.get(item.name, torch.float32)
            tensor = torch.zeros((n, *shape), dtype=kind, device=self.device)
            vector = item.name not in scalars and item.name.endswith(("_w", "_b"))
            dtype = (wp.vec4 if shape == (4,) else wp.vec3) if vector else None
            setattr(arrays, item.name, wp.from_torch(tensor, dtype=dtype))
            tensors[item.name] = tensor
        return PhysicsState(**tensors), arrays

    def _build_tables(self, shared: SharedModel) -> None:
        """Constant tables of the kernels, and mujoco_warp's contacts."""
        palette, chains, data = shared.palette, shared.chains, self._data
        self._palette = kernels.Palette()
        for name in ("position", "size", "bound_center", "bound_half"):
            setattr(self._palette, name, _to_warp(getattr(palette, name), wp.vec3))
        self._palette.rotation = _to_warp(palette.rotation, wp.mat33)
        self._palette.radius = _to_warp(palette.radius, float)
        self._palette.field, self._palette.wall = _to_warp(palette.field, int), _to_warp(palette.wall, int)
        self._slot_geom = _to_warp(shared.slot_geom, int)
        links = kernels.Links()
        for name in ("position", "axis", "anchor", "foot"):
            setattr(links, name, _to_warp(getattr(chains, name), wp.vec3))
        links.rotation = _to_warp(np.roll(chains.quaternion, -1, axis=1), wp.quat)  # Warp's quaternions are xyzw
        for name in ("start", "hinge", "address_q", "address_v"):
            setattr(links, name, _to_warp(getattr(chains, name), int))
        links.zero = _to_warp(chains.zero, float)
        self._links = links
        self._roles = kernels.Roles()
        for name in ("foot", "body", "ground", "slot"):
            setattr(self._roles, name, _to_warp(getattr(shared, f"geom_{name}"), int))
        contacts = kernels.ContactArrays()
        contacts.count, contacts.world, contacts.geom = data.nacon, data.contact.worldid, data.contact.geom
        contacts.distance, contacts.position, contacts.frame = data.contact.dist, data.contact.pos, data.contact.frame
        contacts.friction, contacts.dimension = data.contact.friction, data.contact.dim
        contacts.address, contacts.row_id, contacts.row_force = data.contact.efc_address, data.efc.id, data.efc.force
        contacts.row_count, contacts.equality_rows = data.nefc, data.ne
        contacts.friction_rows, contacts.limit_rows = data.nf, data.nl
        contacts.row_capacity = data.njmax
        contacts.pyramidal = int(self.scene.physics.cone == "pyramidal")
        self._contacts = contacts
        if shared.has_field and shared.model.geom_margin.any():
            self._model.callback.contactfilter = self._correct_field_contacts

    def _correct_field_contacts(self, _: mujoco_warp.Model, data: mujoco_warp.Data) -> None:
        """Called by mujoco_warp between collision detection and the constraints."""
        contact = data.contact
        wp.launch(
            kernels.correct_field_contacts,
            dim=data.naconmax,
            inputs=[data.nacon, contact.geom, contact.frame, contact.includemargin, int(self._shared.slot_geom[-1])]
            + [contact.dist, contact.pos],
        )

    def _reset_to_default(self) -> None:
        """Every world at its first terrain's origin in the default pose."""
        n = self.num_worlds
        pose = torch.tensor([0.0, 0.0, self.scene.robot.stand_height], device=self.device).repeat(n, 1)
        quaternion = torch.tensor([1.0, 0.0, 0.0, 0.0], device=self.device).repeat(n, 1)
        terrain = torch.tensor(self.scene.terrain_index, device=self.device)
        self.reset(base_position=pose, base_quaternion=quaternion, terrain_index=terrain)

    def _memory_advice(self, capacity: Capacity) -> str:
        """The sentence for a device that is too small, with the number of worlds that would fit."""
        per_world = self.bytes_per_world(capacity)
        free = 0
        if self._on_gpu:
            self._data, self._state, self._sample = None, None, None  # what has been allocated counts as free
            torch.cuda.empty_cache()
            free = torch.cuda.mem_get_info(self.device)[0]
        fits = max(int(free / (per_world * _MEMORY_SLACK)), 0)
        return (
            f"{self.num_worlds} worlds do not fit into the memory of {self.device}: about {fits} would"
            f" ({per_world * _MEMORY_SLACK / 1e3:.0f} kB each, {free / 1e9:.1f} GB free); use fewer worlds,"
            " or fewer contacts (PhysicsOptions.contacts_per_world)"
        )

    def bytes_per_world(self, capacity: Capacity | None = None) -> float:
        """Memory that one more world's data need [bytes], scratch memory of a step not counted; measured on small copies."""
        capacity = capacity or buffer_capacity(self.scene, self._shared)
        share = self.num_worlds

        def size(worlds: int) -> int:
            with wp.ScopedDevice("cpu"):
                data = mujoco_warp.make_data(
                    self._shared.model,
                    nworld=worlds,
                    naconmax=worlds * (capacity.contacts // share + 1),
                    naccdmax=worlds * (capacity.convex // share + 1),
                    njmax=capacity.rows,
                )
            return sum(_array_bytes(part) for part in (data, data.contact, data.efc))

        return (size(3) - size(1)) / 2

    # ---- reading --------------------------------------------------------------------------------------------------

    @property
    def state(self) -> PhysicsState:
        """State after the last call; the tensors change with the next one."""
        return self._state

    @property
    def sample(self) -> PhysicsState:
        """Snapshot taken by the last ``step(sample_at=…)``."""
        return self._sample

    def _read(self, select: torch.Tensor, value: int, out: kernels.StateArrays, *, forces: bool) -> None:
        """Launch the read-out of the worlds whose ``select`` is ``value``."""
        n, data, chosen = self.num_worlds, self._data, wp.from_torch(select)
        joints = self.scene.robot.num_joints
        wp.launch(
            kernels.read_joints,
            dim=(n, joints),
            inputs=[
                chosen,
                value,
                self._motors,
                data.time,
                data.overflow,
                _DROPPED,
                data.qpos,
                data.qvel,
                self._live,
                out,
            ],
        )
        wp.launch(
            kernels.read_feet, dim=(n, self._feet), inputs=[chosen, value, self._links, data.qpos, data.qvel, out]
        )
        if forces:
            wp.launch(
                kernels.read_contacts,
                dim=n,
                inputs=[chosen, value, self._feet, self._bodies, self._contacts, self._roles, data.qpos, out],
            )
            wp.launch(kernels.read_torques, dim=(n, joints), inputs=[chosen, value, self._motors, out])

    # ---- acting ---------------------------------------------------------------------------------------------------

    @contextmanager
    def _scope(self) -> Iterator[None]:
        """Launch on this backend's device, in order with torch's own work there."""
        if not self._on_gpu:
            with wp.ScopedDevice(self._warp_device):
                yield
            return
        with wp.ScopedStream(self._torch_stream()), wp.ScopedDevice(self._warp_device):
            yield

    def _torch_stream(self) -> wp.Stream:
        """Torch's current stream as Warp's."""
        stream = torch.cuda.current_stream(self.device)
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
        return self._streams[stream.cuda_stream]

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

    def _fill(
        self, buffer: torch.Tensor, value: torch.Tensor | None, name: str, default: torch.Tensor | float = 0.0
    ) -> None:
        """Copy an argument with a row for each world into its buffer."""
        if value is None:
            buffer.copy_(default) if isinstance(default, torch.Tensor) else buffer.fill_(default)
            return
        if value.shape != buffer.shape:
            raise BackendError(
                f"{name} has shape {tuple(value.shape)}, but must be {tuple(buffer.shape)}: one row for each world"
            )
        buffer.copy_(value)

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
        self._fill(self._requested, held_target, "held_target")
        self._has_request.fill_(int(held_target is not None))
        if terrain_index is not None:
            self._check_terrain(terrain_index, worlds)
            self._fill(self._requested_terrain, terrain_index, "terrain_index")
        n, data, motors = self.num_worlds, self._data, self._motors
        model = self._shared.model
        active = wp.from_torch(self._active)
        with self._scope():
            if terrain_index is not None:
                self._place_terrain(active)
            wp.launch(
                kernels.reset_worlds,
                dim=(n, self.scene.robot.num_joints),
                inputs=[active, wp.from_torch(self._has_request), wp.from_torch(self._pose), wp.from_torch(self._twist)]
                + [wp.from_torch(self._new_position), wp.from_torch(self._new_velocity), model.nv, model.nbody, motors]
                + [data.qpos, data.qvel, data.qacc_warmstart, data.qfrc_applied, data.xfrc_applied]
                + [data.time, data.overflow, self._live],
            )
            wp.launch(
                kernels.clear_forces,
                dim=n,
                inputs=[active, self.scene.robot.num_joints, self._feet, self._bodies, self._live],
            )
            self._read(self._active, 1, self._live, forces=False)

    def _check_terrain(self, index: torch.Tensor, worlds: torch.Tensor | None) -> None:
        """Refuse indices outside the palette; on a GPU, where looking would wait for it, the kernel clamps them."""
        if self._on_gpu:
            return
        chosen = index if worlds is None else index[worlds]
        palette = len(self.scene.terrains)
        if chosen.numel() and not (0 <= int(chosen.min()) and int(chosen.max()) < palette):
            raise BackendError(
                f"terrain_index holds {int(chosen.min())} to {int(chosen.max())}, but the scene has terrains 0 to {palette - 1}"
            )

    def _place_terrain(self, active: wp.array) -> None:
        """Give the masked worlds the terrains asked for."""
        model, data, slots = self._model, self._data, len(self._shared.slot_geom)
        wp.launch(
            kernels.place_terrain,
            dim=(self.num_worlds, max(slots, 1)),
            inputs=[active, wp.from_torch(self._requested_terrain), len(self.scene.terrains), slots, self._slot_geom]
            + [self._palette, wp.from_torch(self._terrain), data.geom_xpos, data.geom_xmat, model.geom_size]
            + [model.geom_aabb, model.geom_rbound, model.geom_dataid, int(self._shared.has_field)],
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
        self._fill(self._requested, joint_targets, "joint_targets")
        self._fill(self._delay, delay, "delay", 0)
        self._fill(self._sample_at, sample_at, "sample_at", 0)
        if sample_at is not None:
            self._sample_at.mul_(self._active)
        if not self._on_gpu:
            with wp.ScopedDevice(self._warp_device):
                self._control_period(total, sample_at is not None)
            return
        key = (total, sample_at is not None)
        if key not in self._graphs:
            self._graphs[key] = self._capture(*key)
        wp.capture_launch(self._graphs[key], stream=self._torch_stream())

    def _capture(self, total: int, sampled: bool) -> wp.Graph:
        """Record a control period; done once for each number of substeps, and nothing runs while recording."""
        torch.cuda.synchronize(self.device)
        with wp.ScopedDevice(self._warp_device), wp.ScopedCapture(self._warp_device) as capture:
            self._control_period(total, sampled)
        return capture.graph

    def _control_period(self, total: int, sampled: bool) -> None:
        """Launch everything that happens between two targets."""
        n, data, motors, live = self.num_worlds, self._data, self._motors, self._live
        model, joints = self._shared.model, self.scene.robot.num_joints
        active = wp.from_torch(self._active)
        inactive = [model.nq, model.nv, data.qpos, data.qvel, data.qacc_warmstart, data.time, data.overflow]
        inactive += [wp.from_torch(self._kept), wp.from_torch(self._kept_overflow)]
        wp.launch(
            kernels.begin_period, dim=(n, joints), inputs=[active, wp.from_torch(self._has_request), motors, live]
        )
        wp.launch(kernels.keep_inactive, dim=(n, model.nq), inputs=[active, 0, *inactive])
        depth = self.scene.physics.watch_penetration
        for substep in range(total):
            wp.launch(
                kernels.motor_law, dim=(n, joints), inputs=[substep, motors, data.qpos, data.qvel, data.qfrc_applied]
            )
            mujoco_warp.step(self._model, data)
            wp.launch(
                kernels.end_substep,
                dim=n,
                inputs=[substep, self._tilt_limit, active, self._parked, model.nq, model.nv]
                + [data.qpos, data.qvel, data.qacc_warmstart, live],
            )
            if depth is not None:
                wp.launch(
                    kernels.watch_penetration,
                    dim=data.naconmax,
                    inputs=[substep, depth, active, self._contacts, self._roles, self._palette]
                    + [wp.from_torch(self._terrain), live],
                )
            if sampled:
                self._read(self._sample_at, substep + 1, self._sampled, forces=True)
        wp.launch(kernels.keep_inactive, dim=(n, model.nq), inputs=[active, 1, *inactive])
        self._read(self._active, 1, live, forces=True)

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
        with self._scope():
            wp.launch(
                kernels.push_base,
                dim=(self.num_worlds, 6),
                inputs=[wp.from_torch(self._active), wp.from_torch(self._twist), self._data.qvel],
            )
            self._read(self._active, 1, self._live, forces=False)

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        self._fill(self._external[:, self._shared.base, 0:3], force_w, "force_w")

    # ---- changing the model -----------------------------------------------------------------------------------------

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``. Fields may also have a row for every world; then the masked rows count."""
        self._set_active(worlds)
        mask = self._active.bool()
        model, base, bodies = self._model, self._shared.base, self._body_ids
        found = {f.name: getattr(randomization, f.name) for f in fields(Randomization)}
        rows = {name: self._rows(name, value, mask, worlds) for name, value in found.items() if value is not None}
        rows = {name: value for name, value in rows.items() if value is not None}

        def write(target: torch.Tensor, value: torch.Tensor) -> None:
            shape = (-1,) + (1,) * (target.dim() - 1)
            target.copy_(torch.where(mask.view(shape), value.to(target.dtype), target))

        targets = (self._stiffness, self._damping, self._strength, self._offset)
        nominal = (self._nominal_stiffness, self._nominal_damping, 1.0, 1.0)
        for name, target, factor in zip(_CONTROL_FIELDS, targets, nominal, strict=True):
            if name in rows:
                write(target, rows[name] * factor)
        if "friction" in rows:
            friction = wp.to_torch(model.geom_friction)
            write(friction[:, :, 0], rows["friction"][:, None].expand(-1, friction.shape[1]))
        mass, inertia = wp.to_torch(model.body_mass), wp.to_torch(model.body_inertia)
        if "link_mass_scale" in rows:
            others = (bodies != base).float()
            scale = rows["link_mass_scale"] * others + (1.0 - others)
            kept = mass[:, base].clone()
            mass[:, bodies] = torch.where(mask[:, None], self._nominal_mass[:, bodies] * scale, mass[:, bodies])
            inertia[:, bodies] = torch.where(
                mask[:, None, None], self._nominal_inertia[:, bodies] * scale[:, :, None], inertia[:, bodies]
            )
            mass[:, base] = kept
        if "base_mass_offset" in rows:
            write(mass[:, base], (self._nominal_mass[:, base] + rows["base_mass_offset"]).clamp(min=0.01))
        if "base_com_offset" in rows:
            write(wp.to_torch(model.body_ipos)[:, base], self._nominal_com[:, base] + rows["base_com_offset"])
        if {"link_mass_scale", "base_mass_offset", "base_com_offset"} & set(rows):
            with self._scope():
                mujoco_warp.set_const(self._model, self._data, restore=False)

    def _rows(
        self, name: str, value: torch.Tensor, mask: torch.Tensor, worlds: torch.Tensor | None
    ) -> torch.Tensor | None:
        """Spread a row for each masked world over all worlds, without asking the device how many are masked."""
        value = value.to(device=self.device, dtype=torch.float32)
        if len(value) == self.num_worlds:
            return value
        if worlds is None or (not self._on_gpu and len(value) != int(mask.sum())):
            wanted = self.num_worlds if worlds is None else int(mask.sum())
            raise BackendError(f"Randomization.{name} has {len(value)} rows for {wanted} worlds; give one row for each")
        if len(value) == 0:
            return None
        return value[(torch.cumsum(mask, 0) - 1).clamp(0, len(value) - 1)]

    def close(self) -> None:
        """Drop graphs and worlds."""
        self._graphs.clear()
        self._streams.clear()


def _device(name: str) -> torch.device:
    """The torch device of that name, checked."""
    device = torch.device(name)
    if device.type == "cpu":
        return device
    if device.type != "cuda":
        raise BackendError(f"backend 'mujoco-warp' runs on 'cuda' or 'cpu', not on device '{name}'")
    if not torch.cuda.is_available():
        raise BackendError(
            f"device '{name}' was asked for, but this machine has no CUDA device; use device 'cpu' (--device cpu)"
        )
    index = torch.cuda.current_device() if device.index is None else device.index
    if index >= torch.cuda.device_count():
        raise BackendError(
            f"device '{name}' does not exist; this machine has cuda:0 to cuda:{torch.cuda.device_count() - 1}"
        )
    return torch.device("cuda", index)


def _is_memory_error(error: BaseException) -> bool:
    """Whether torch or Warp ran out of device memory."""
    text = str(error).lower()
    return isinstance(error, torch.cuda.OutOfMemoryError) or "failed to allocate" in text or "out of memory" in text


def _to_warp(values: np.ndarray, dtype: type) -> wp.array:
    """A constant table on the current Warp device."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype)


def _array_bytes(part: object) -> int:
    """Memory of the Warp arrays that an object holds directly [bytes]."""
    return sum(v.capacity for v in vars(part).values() if isinstance(v, wp.array))
