"""The Newton engine: its MuJoCo solver as ``newton``, its other solvers as ``newton:NAME``.

Poses and twists live in Newton's state; kernels of ours write the motors' torques into ``Control.joint_f`` before every physics step
and read state and contacts out afterwards. On a GPU a whole control period is one CUDA graph and no call waits for the device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from math import cos, pi
from typing import Any, ClassVar

import newton
import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike

from . import newton_kernels as kernels
from .base import BackendError, Capability, PhysicsBackend, PhysicsState, Randomization, Scene
from .newton_model import BIRTH_HEIGHT, build_world_model
from .newton_solvers import SOLVERS, SolverAdapter, dry_friction_slope

LARGEST_TORQUE = 1e6
"""Stands for no torque limit [N·m]."""
SMALLEST_MASS = 0.01
"""A base never gets lighter than this [kg]."""


class NewtonBackend(PhysicsBackend):
    """N worlds of one robot in Newton."""

    name: ClassVar[str] = "newton"
    adapter: ClassVar[type[SolverAdapter]] = SOLVERS["mujoco"]
    """The solver that does the work."""

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """See ``PhysicsBackend.capabilities``."""
        return cls.adapter.capabilities

    @classmethod
    def with_solver(cls, solver: str) -> type[NewtonBackend]:
        """The backend that runs a named solver, ``newton:SOLVER``.

        Raises:
            BackendError: there is no such solver, or this project does not run it.
        """
        if solver not in SOLVERS:
            raise BackendError(
                f"unknown Newton solver '{solver}'; 'newton:NAME' runs {' and '.join(SOLVERS)}, and docs/newton.md says why no others"
            )
        if SOLVERS[solver] is cls.adapter:
            return cls
        return type(f"{solver.capitalize()}NewtonBackend", (cls,), {"name": f"newton:{solver}", "adapter": SOLVERS[solver]})

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        """Build the worlds. ``threads`` is ignored: Warp runs on one CPU thread.

        Raises:
            BackendError: no such device, or something that the solver cannot do.
        """
        _check_device(device)
        self.adapter.refuse(scene)
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
        wp.init()
        self.scene, self.device, self.dtype = scene, torch.device(device), torch.float32
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self._warp_device = wp.device_from_torch(self.device)
        self._graphs: dict[tuple[int, bool, bool], Any] = {}
        with self._on_device():
            self._build()
            self._warm_up()

    # ---- building -----------------------------------------------------------------------------------------------

    def _build(self) -> None:
        """Make model, solver, state tensors and the structures that the kernels see."""
        scene, device = self.scene, str(self._warp_device)
        world = build_world_model(scene, device=device, gap=self.adapter.gap, skin=self.adapter.skin)
        self._world, self._model = world, world.model
        self._solver = self.adapter(world, scene)  # type: ignore[abstract]
        n, layout = scene.num_worlds, world.layout
        joints, feet, bodies = scene.robot.num_joints, len(scene.robot.foot_names), len(scene.robot.collision_bodies)
        self._sizes = (joints, feet, bodies)
        self._now, self._next = self._model.state(), self._model.state()
        self._control = self._model.control()
        if self._model.shape_body is None or self._now.body_f is None or self._next.body_f is None:
            raise BackendError("Newton made a model without bodies; the robot's model file has none")
        self._layout = self._fill(
            kernels.Layout(),
            coordinates=layout.coordinates,
            dofs=layout.dofs,
            bodies=layout.bodies,
            shapes=layout.shapes,
            base=layout.base,
            joint_q=self._ints(layout.joint_q),
            joint_v=self._ints(layout.joint_v),
            foot_body=self._ints(layout.foot_body),
            foot_center=wp.array(layout.foot_center, dtype=wp.vec3, device=device),
            shape_foot=self._ints(layout.shape_foot),
            shape_body=self._ints(layout.shape_body),
            shape_ground=self._ints(layout.shape_ground),
            shape_slot=self._ints(layout.shape_slot),
        )
        self._make_motors(joints)
        slots = world.slots
        self._palette = self._fill(
            kernels.Palette(),
            pose=wp.array(slots.pose, dtype=wp.transform, device=device),
            scale=wp.array(slots.scale, dtype=wp.vec3, device=device),
            wall=wp.array(slots.wall, dtype=int, device=device),
        )
        self._slot_shape = self._ints(layout.slot_shape)
        contacts = self._solver.contacts
        self._contacts = self._fill(
            kernels.ContactArrays(),
            count=contacts.rigid_contact_count,
            shape0=contacts.rigid_contact_shape0,
            shape1=contacts.rigid_contact_shape1,
            point0=contacts.rigid_contact_point0,
            point1=contacts.rigid_contact_point1,
            margin0=contacts.rigid_contact_margin0,
            margin1=contacts.rigid_contact_margin1,
            normal=contacts.rigid_contact_normal,
            force=self._solver.observables.contact_f,
            shape_body=self._model.shape_body,
        )
        self._state, self._state_arrays = self._allocate_state()
        self._sample, self._sample_arrays = self._allocate_state()
        whole = {"dtype": torch.int32, "device": self.device}
        self._active = torch.ones(n, **whole)  # type: ignore[call-overload]
        self._sample_at = torch.zeros(n, **whole)  # type: ignore[call-overload]
        self._requested_terrain = torch.tensor(scene.terrain_index, **whole)
        self._terrain = self._requested_terrain.clone()
        self._flag = torch.zeros(1, **whole)  # type: ignore[call-overload]
        self._mask = torch.zeros(n + 1, dtype=torch.bool, device=self.device)
        self._ticks = wp.zeros(n, dtype=int, device=device)
        self._kept = (
            wp.zeros_like(self._now.joint_q),
            wp.zeros_like(self._now.joint_qd),
            wp.zeros_like(self._now.body_q),
            wp.zeros_like(self._now.body_qd),
            wp.zeros_like(self._solver.warm_start),
        )
        self._remember_nominal()

    def _make_motors(self, joints: int) -> None:
        """Motor tensors, and the structure in which the kernels see them."""
        scene, n, world = self.scene, self.num_worlds, self._world
        constants = scene.parameters
        self._nominal_gains = (self._tensor(constants.stiffness), self._tensor(constants.damping))
        shape = {"dtype": torch.float32, "device": self.device}
        self._stiffness = self._nominal_gains[0].repeat(n, 1)
        self._damping = self._nominal_gains[1].repeat(n, 1)
        self._strength = torch.ones((n, joints), **shape)  # type: ignore[call-overload]
        self._offset = torch.zeros((n, joints), **shape)  # type: ignore[call-overload]
        self._requested = torch.zeros((n, joints), **shape)  # type: ignore[call-overload]
        self._delay = torch.zeros(n, dtype=torch.int32, device=self.device)
        limit = constants.torque_limit if scene.physics.torque_limits else (LARGEST_TORQUE,) * joints
        friction = np.zeros(joints)
        if not self._solver.own_dry_friction:
            friction = np.asarray(constants.friction_loss)
        dofs = np.array([int(world.reference.joint(name).dofadr[0]) for name in scene.robot.joint_names])
        slope = dry_friction_slope(world, dofs, scene.physics.timestep)
        self._motors = self._fill(
            kernels.Motors(),
            limit=self._floats(limit),
            stiffness=wp.from_torch(self._stiffness),
            damping=wp.from_torch(self._damping),
            strength=wp.from_torch(self._strength),
            offset=wp.from_torch(self._offset),
            dry_friction=self._floats(friction),
            dry_slope=self._floats(slope),
            requested=wp.from_torch(self._requested),
            current=wp.zeros((n, joints), dtype=float, device=self._warp_device),
            previous=wp.zeros((n, joints), dtype=float, device=self._warp_device),
            limp=wp.ones(n, dtype=int, device=self._warp_device),
            limp_before=wp.ones(n, dtype=int, device=self._warp_device),
            delay=wp.from_torch(self._delay),
            torque=wp.zeros((n, joints), dtype=float, device=self._warp_device),
        )

    def _remember_nominal(self) -> None:
        """Views of the model's masses, and what they are without randomization."""
        n, bodies = self.num_worlds, self._world.layout.bodies
        model = self._model
        self._mass = wp.to_torch(model.body_mass).view(n, bodies)
        self._inverse_mass = wp.to_torch(model.body_inv_mass).view(n, bodies)
        self._inertia = wp.to_torch(model.body_inertia).view(n, bodies, 3, 3)
        self._inverse_inertia = wp.to_torch(model.body_inv_inertia).view(n, bodies, 3, 3)
        self._friction = wp.to_torch(model.shape_material_mu).view(n, self._world.layout.shapes)
        self._nominal_mass = self._mass[0].clone()
        self._nominal_inertia = self._inertia[0].clone()
        reference = self._world.reference
        self._nominal_com = wp.vec3(*reference.body_ipos[self._world.layout.base + 1])
        self._mass_offset = torch.zeros(n, dtype=torch.float32, device=self.device)
        self._link_scale = torch.ones((n, bodies), dtype=torch.float32, device=self.device)
        self._com_offset = torch.zeros((n, 3), dtype=torch.float32, device=self.device)
        self._collision_bodies = torch.tensor(self._world.layout.collision_bodies, dtype=torch.int64, device=self.device)

    def _allocate_state(self) -> tuple[PhysicsState, Any]:
        """A state of zeros, as tensors and as the kernels see it."""
        n, (joints, feet, bodies) = self.num_worlds, self._sizes
        shapes: dict[str, tuple[int, ...]] = {
            "base_quaternion_w": (4,),
            "joint_position": (joints,),
            "joint_velocity": (joints,),
            "joint_torque": (joints,),
            "foot_position_w": (feet, 3),
            "foot_velocity_w": (feet, 3),
            "foot_contact_force_w": (feet, 3),
            "foot_normal_force": (feet,),
            "foot_tangential_force": (feet,),
            "body_contact_force_w": (bodies, 3),
        }
        whole = ("contact_count", "tilt_substep", "penetration_substep")
        flags = ("diverged", "overflowed")
        tensors, arrays = {}, kernels.StateArrays()
        for field in fields(PhysicsState):
            kind = torch.int64 if field.name in whole else torch.bool if field.name in flags else torch.float32
            rest = shapes.get(field.name, (3,) if field.name.endswith(("_w", "_b")) else ())
            tensor = torch.zeros((n, *rest), dtype=kind, device=self.device)
            vector = {3: wp.vec3, 4: wp.vec4}.get(rest[-1]) if rest and field.name.endswith(("_w", "_b")) else None
            tensors[field.name] = tensor
            setattr(arrays, field.name, wp.from_torch(tensor, dtype=vector) if vector else wp.from_torch(tensor))
        return PhysicsState(**tensors), arrays

    def _fill(self, structure: Any, **values: Any) -> Any:
        """Set the fields of a Warp structure."""
        for name, value in values.items():
            setattr(structure, name, value)
        return structure

    def _ints(self, values: ArrayLike) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.int32), dtype=int, device=self._warp_device)

    def _floats(self, values: ArrayLike) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float32), dtype=float, device=self._warp_device)

    def _tensor(self, values: ArrayLike) -> torch.Tensor:
        return torch.tensor(np.asarray(values), dtype=torch.float32, device=self.device)

    def _warm_up(self) -> None:
        """Compile everything, while a graph cannot be in the way, and put all worlds at the origin."""
        n = self.num_worlds
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=self.device).repeat(n, 1)
        terrain = self._requested_terrain.to(torch.int64)
        origin = torch.zeros((n, 3), device=self.device)
        self.reset(base_position=origin + self._tensor([0.0, 0.0, BIRTH_HEIGHT]), base_quaternion=upright, terrain_index=terrain)
        self._run_period(1, masked=True, sampled=True)
        self._solver.inertia_changed()
        self.push()
        self.reset(base_position=origin, base_quaternion=upright, terrain_index=terrain)

    # ---- running kernels ----------------------------------------------------------------------------------------

    @contextmanager
    def _on_device(self) -> Iterator[None]:
        """Run Warp where torch runs: on the backend's device, in torch's present stream."""
        if self.device.type == "cpu":
            yield
            return
        with wp.ScopedDevice(self._warp_device), wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.device))):
            yield

    def _launch(self, kernel: Any, dim: int | tuple[int, ...], *inputs: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self._warp_device)

    def _coordinates(self, state: newton.State) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        return state.joint_q, state.joint_qd, state.body_q, state.body_qd

    def _run_period(self, substeps: int, *, masked: bool, sampled: bool) -> None:
        """One control period, kernel by kernel; what it reads is in the tensors that ``step`` filled."""
        n, (joints, _, _) = self.num_worlds, self._sizes
        physics, state = self.scene.physics, self._state_arrays
        active = wp.from_torch(self._active)
        now, after = self._now, self._next
        keep = (*self._coordinates(now), self._solver.warm_start, *self._kept)
        width = max(self._world.layout.coordinates, self._world.layout.bodies, self._solver.warm_start.shape[1])
        if masked:
            self._launch(kernels.keep_inactive, (n, width), self._layout, active, 0, *keep)
        arguments = (self._layout, active, wp.from_torch(self._flag), joints, self._motors, *self._coordinates(now), state)
        self._launch(kernels.begin_period, n, *arguments)
        upright = -2.0 if physics.watch_tilt is None else cos(min(physics.watch_tilt, pi))
        for substep in range(substeps):
            self._launch(
                kernels.motor_law,
                (n, joints),
                substep,
                self._layout,
                self._motors,
                state.diverged,
                now.joint_q,
                now.joint_qd,
                self._control.joint_f,
            )
            watched = physics.watch_penetration is not None
            last = substep == substeps - 1
            self._solver.step(now, after, self._control, observe=last or sampled or watched)
            self._solver.collect_overflow(active, state.overflowed)
            if watched:
                self._launch(
                    kernels.watch_penetration,
                    self._solver.contacts.rigid_contact_max,
                    substep,
                    float(physics.watch_penetration or 0.0),
                    self._layout,
                    active,
                    self._contacts,
                    self._palette,
                    wp.from_torch(self._terrain),
                    now.body_q,
                    state,
                )
            self._launch(
                kernels.end_substep,
                n,
                substep,
                upright,
                self._layout,
                active,
                *self._coordinates(after),
                self._solver.warm_start,
                self._ticks,
                state,
            )
            if sampled:
                self._read(wp.from_torch(self._sample_at), substep + 1, after, self._sample_arrays, contacts_of=now)
            now, after = after, now
        # the contacts were found in the poses before the last substep
        self._read(active, 1, now, state, contacts_of=after)
        if now is not self._now:
            for source, target in zip(self._coordinates(now), self._coordinates(self._now), strict=True):
                wp.copy(target, source)
        if masked:
            self._launch(kernels.keep_inactive, (n, width), self._layout, active, 1, *keep)

    def _read(self, select: wp.array, value: int, state: newton.State, out: Any, *, contacts_of: newton.State | None) -> None:
        """Write the state of the worlds whose ``select`` equals ``value``; without ``contacts_of`` forces are zero."""
        n, (joints, feet, bodies) = self.num_worlds, self._sizes
        live = self._state_arrays
        self._read_motion(select, value, state, out)
        self._launch(kernels.clear_forces, n, select, value, joints, feet, bodies, out)
        if contacts_of is None:
            return
        self._launch(kernels.read_torques, (n, joints), select, value, self._motors, out)
        count = self._solver.contacts.rigid_contact_max
        poses = contacts_of.body_q
        self._launch(
            kernels.add_contacts, count, select, value, self._layout, self._contacts, poses, live.diverged, out
        )
        self._launch(kernels.finish_contacts, n, select, value, self._layout, poses, out)

    def _read_motion(self, select: wp.array, value: int, state: newton.State, out: Any) -> None:
        """Write poses, velocities and flags."""
        n, (joints, feet, _) = self.num_worlds, self._sizes
        live, com = self._state_arrays, self._model.body_com
        timestep = self.scene.physics.timestep
        ticks = self._ticks
        moving = (state.joint_q, state.joint_qd, com)
        self._launch(
            kernels.read_base_and_joints, (n, joints), select, value, timestep, self._layout, ticks, *moving, live, out
        )
        self._launch(kernels.read_feet, (n, feet), select, value, self._layout, state.body_q, state.body_qd, com, out)

    def _graph(self, key: tuple[int, bool, bool]) -> Any:
        """The CUDA graph of a control period, captured at its first use."""
        if key not in self._graphs:
            with wp.ScopedStream(wp.Stream(self._warp_device)), wp.ScopedCapture(force_module_load=False) as capture:
                self._run_period(key[0], masked=key[1], sampled=key[2])
            self._graphs[key] = capture.graph
        return self._graphs[key]

    # ---- the contract -------------------------------------------------------------------------------------------

    @property
    def state(self) -> PhysicsState:
        """State after the last call; the tensors change with the next one."""
        return self._state

    @property
    def sample(self) -> PhysicsState:
        """Snapshot taken by the last ``step(sample_at=…)``."""
        return self._sample

    def _select(self, worlds: torch.Tensor | None) -> None:
        """Note which worlds the present call is for."""
        if worlds is None:
            self._active.fill_(1)
            self._mask.fill_(True)
            return
        if worlds.dtype != torch.bool or worlds.shape != (self.num_worlds,):
            raise BackendError(f"the mask of worlds must be {self.num_worlds} booleans, not {tuple(worlds.shape)} of {worlds.dtype}")
        self._active.copy_(worlds)
        self._mask[:-1].copy_(worlds)

    def _rows(self, name: str, value: torch.Tensor | None, width: int, default: float | torch.Tensor = 0.0) -> wp.array:
        """An argument with one row per world as a Warp array."""
        if value is None:
            rows = torch.zeros((self.num_worlds, width), dtype=torch.float32, device=self.device) + default
        else:
            if value.shape != (self.num_worlds, width):
                raise BackendError(f"{name} must have the shape {(self.num_worlds, width)}, not {tuple(value.shape)}")
            rows = value.to(device=self.device, dtype=torch.float32).contiguous()
        return wp.from_torch(rows)

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
        joints = self._sizes[0]
        with self._on_device():
            self._select(worlds)
            active = wp.from_torch(self._active)
            if terrain_index is not None:
                self._requested_terrain.copy_(terrain_index)
                self._place_terrain(active)
            self._flag.fill_(held_target is not None)
            if held_target is not None:
                self._requested.copy_(held_target)
            pose = self._tensor(self.scene.robot.default_joint_position)
            self._launch(
                kernels.reset_worlds,
                (self.num_worlds, joints),
                self._layout,
                active,
                wp.from_torch(self._flag),
                self._rows("base_position", base_position, 3),
                self._rows("base_quaternion", base_quaternion, 4),
                self._rows("base_linear_velocity", base_linear_velocity, 3),
                self._rows("base_angular_velocity", base_angular_velocity, 3),
                self._rows("joint_position", joint_position, joints, pose),
                self._rows("joint_velocity", joint_velocity, joints),
                self._model.body_com,
                self._motors,
                self._now.joint_q,
                self._now.joint_qd,
                self._now.body_f,
                self._next.body_f,
                self._ticks,
                self._state_arrays,
            )
            self._solver.reset(self._now, wp.from_torch(self._mask))
            newton.eval_fk(self._model, self._now.joint_q, self._now.joint_qd, self._now)
            self._read(active, 1, self._now, self._state_arrays, contacts_of=None)

    def _place_terrain(self, active: wp.array) -> None:
        """Give the active worlds the terrains in ``_requested_terrain``."""
        self._launch(
            kernels.place_terrain,
            (self.num_worlds, max(1, len(self._world.layout.slot_shape))),
            self._layout,
            active,
            wp.from_torch(self._requested_terrain),
            len(self.scene.terrains),
            self._slot_shape,
            self._palette,
            wp.from_torch(self._terrain),
            self._model.shape_transform,
            self._model.shape_scale,
        )
        self._solver.shapes_changed(wp.from_torch(self._terrain))

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
        count = self.scene.physics.substeps if substeps is None else substeps
        with self._on_device():
            self._select(worlds)
            self._flag.fill_(joint_targets is not None)
            if joint_targets is not None:
                self._requested.copy_(joint_targets)
            if delay is None or joint_targets is None:
                self._delay.zero_()
            else:
                self._delay.copy_(delay)
            if sample_at is not None:
                self._sample_at.copy_(sample_at)
                self._sample_at.mul_(self._active)
            key = (count, worlds is not None, sample_at is not None)
            if self.device.type == "cpu":
                self._run_period(count, masked=key[1], sampled=key[2])
            else:
                wp.capture_launch(self._graph(key))

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``."""
        joints, _, bodies = self._sizes
        with self._on_device():
            write = self._writer(worlds)
            if randomization.friction is not None:
                write("friction", self._friction, randomization.friction.unsqueeze(-1))
                self._solver.shapes_changed(wp.from_torch(self._terrain))
            for name, tensor, nominal in (
                ("stiffness_scale", self._stiffness, self._nominal_gains[0]),
                ("damping_scale", self._damping, self._nominal_gains[1]),
            ):
                scale = getattr(randomization, name)
                if scale is not None:
                    write(name, tensor, scale.to(self.device, torch.float32) * nominal)
            for name, tensor in (("motor_strength", self._strength), ("motor_offset", self._offset)):
                if getattr(randomization, name) is not None:
                    write(name, tensor, getattr(randomization, name))
            if randomization.base_mass_offset is not None:
                write("base_mass_offset", self._mass_offset, randomization.base_mass_offset)
            if randomization.link_mass_scale is not None:
                scale = torch.ones((self.num_worlds, bodies), dtype=torch.float32, device=self.device)
                scale.copy_(self._link_scale[:, self._collision_bodies])
                write("link_mass_scale", scale, randomization.link_mass_scale)
                self._link_scale[:, self._collision_bodies] = scale
                self._link_scale[:, self._world.layout.base] = 1.0
            if randomization.base_com_offset is not None:
                write("base_com_offset", self._com_offset, randomization.base_com_offset)
                self._launch(
                    kernels.move_center_of_mass,
                    self.num_worlds,
                    self._layout,
                    self._nominal_com,
                    wp.from_torch(self._com_offset),
                    self._model.body_com,
                    self._now.joint_q,
                    self._now.joint_qd,
                )
                newton.eval_fk(self._model, self._now.joint_q, self._now.joint_qd, self._now)
            if any(getattr(randomization, f) is not None for f in ("base_mass_offset", "link_mass_scale", "base_com_offset")):
                self._write_masses()

    def _writer(self, worlds: torch.Tensor | None) -> Callable[[str, torch.Tensor, torch.Tensor], None]:
        """A function that writes rows for the masked worlds into a tensor with a row for every world."""
        self._select(worlds)

        def write(name: str, tensor: torch.Tensor, value: torch.Tensor) -> None:
            rows = value.to(device=self.device, dtype=tensor.dtype)
            # counting the mask would wait for a GPU
            wanted = self.num_worlds if worlds is None else int(worlds.sum()) if self.device.type == "cpu" else len(rows)
            if len(rows) != wanted:
                raise BackendError(f"Randomization.{name} has {len(rows)} rows for {wanted} worlds; give one row for each")
            rows = rows.expand(len(rows), *tensor.shape[1:]).contiguous()
            if worlds is None:
                tensor.copy_(rows)
            else:
                mask = worlds.to(self.device).view(-1, *([1] * (tensor.dim() - 1))).expand_as(tensor)
                tensor.masked_scatter_(mask, rows)

        return write

    def _write_masses(self) -> None:
        """Masses and inertias of all worlds from their randomization."""
        base = self._world.layout.base
        self._mass.copy_(self._nominal_mass * self._link_scale)
        self._mass[:, base] = (self._nominal_mass[base] + self._mass_offset).clamp(min=SMALLEST_MASS)
        self._inertia.copy_(self._nominal_inertia * self._link_scale[..., None, None])
        self._inverse_mass.copy_(1.0 / self._mass)
        self._inverse_inertia.copy_(torch.linalg.inv(self._inertia))
        self._solver.inertia_changed()

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.push``."""
        with self._on_device():
            self._select(worlds)
            active = wp.from_torch(self._active)
            self._launch(
                kernels.push_base,
                self.num_worlds,
                self._layout,
                active,
                self._rows("linear_velocity_w", linear_velocity_w, 3, float("nan")),
                self._rows("angular_velocity_b", angular_velocity_b, 3, float("nan")),
                self._model.body_com,
                self._now.joint_q,
                self._now.joint_qd,
            )
            newton.eval_fk(self._model, self._now.joint_q, self._now.joint_qd, self._now)
            self._read_motion(active, 1, self._now, self._state_arrays)

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        n, layout = self.num_worlds, self._world.layout
        if force_w.shape != (n, 3):
            raise BackendError(f"force_w must have the shape {(n, 3)}, not {tuple(force_w.shape)}")
        with self._on_device():
            for state in (self._now, self._next):
                wrenches = wp.to_torch(state.body_f).view(n, layout.bodies, 6)
                wrenches[:, layout.base, :3] = force_w.to(self.device, torch.float32)

    def close(self) -> None:
        """Free the graphs."""
        self._graphs.clear()


def _check_device(device: str) -> None:
    """Raise where the device does not exist.

    Raises:
        BackendError: says which device to use.
    """
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise BackendError(f"Newton has no device '{device}'; use 'cpu', 'cuda' or 'cuda:N'")
    if kind == "cuda" and not torch.cuda.is_available():
        raise BackendError(f"there is no GPU for device '{device}'; use device 'cpu'")
