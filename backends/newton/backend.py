"""The Newton engine: its MuJoCo solver as ``newton``, its other solvers as ``newton:NAME``.

Poses and twists live in Newton's state; kernels of ours write the motors' torques into ``Control.joint_f`` before every
physics step and read state and contacts out afterwards. On a GPU a whole control period is one CUDA graph and no call
waits for the device.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from math import cos, pi
from typing import Any, ClassVar

import newton
import torch
import warp as wp

from ..base import BackendError, Capability, PhysicsBackend, PhysicsOptions, PhysicsState, Randomization, Scene
from ..devices import find_device
from ..mujoco_warp.device import is_memory_error, memory_advice
from . import kernels
from . import readout_kernels as readout
from .buffers import (
    MassTensors,
    MotorTensors,
    allocate_state,
    contact_structure,
    ints,
    layout_structure,
    palette_structure,
)
from .description import describe_newton
from .model import BIRTH_HEIGHT, build_world_model
from .solvers import SOLVERS, SolverAdapter


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
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``PhysicsBackend.solver_settings``."""
        return cls.adapter.solver_settings(physics)

    @classmethod
    def with_solver(cls, solver: str) -> type[NewtonBackend]:
        """The backend that runs a named solver, ``newton:SOLVER``.

        Raises:
            BackendError: there is no such solver, or this project does not run it.
        """
        if solver not in SOLVERS:
            raise BackendError(
                f"unknown Newton solver '{solver}'; 'newton:NAME' runs {' and '.join(SOLVERS)} "
                "(docs/newton.md says why no others)"
            )
        if SOLVERS[solver] is cls.adapter:
            return cls
        return type(
            f"{solver.capitalize()}NewtonBackend", (cls,), {"name": f"newton:{solver}", "adapter": SOLVERS[solver]}
        )

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        """Build the worlds. ``threads`` is ignored: Warp runs on one CPU thread.

        Raises:
            BackendError: no such device, or something that the solver cannot do.
        """
        found = find_device(device, self.name)
        self.adapter.refuse(scene)
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
        wp.init()
        self.scene, self.device, self.dtype = scene, found, torch.float32
        self._warp_device = wp.device_from_torch(self.device)
        self._graphs: dict[tuple[int, bool, bool], Any] = {}
        try:
            with self._on_device():
                self._build()
                self._warm_up()
        except RuntimeError as error:  # torch's and Warp's out-of-memory errors are such
            if isinstance(error, BackendError) or not is_memory_error(error):
                raise
            raise BackendError(self._memory_advice()) from error

    def _memory_advice(self) -> str:
        """The sentence for worlds that do not fit: how many would, measured on small copies."""
        self.__dict__ = {name: self.__dict__[name] for name in ("scene", "device", "dtype", "_warp_device")}
        gc.collect()

        def free() -> int:
            wp.synchronize_device(self._warp_device)
            torch.cuda.empty_cache()
            return int(torch.cuda.mem_get_info(self.device)[0])

        start, used = free(), []
        for count in (64, 512):
            index = tuple(self.scene.terrain_index[i % self.num_worlds] for i in range(count))
            copy = type(self)(replace(self.scene, terrain_index=index), device=str(self.device))
            used.append(start - free())
            del copy
            gc.collect()
        return memory_advice(self.num_worlds, self.device, start, max(1.0, (used[1] - used[0]) / 448))

    # ---- building -----------------------------------------------------------------------------------------------

    def _build(self) -> None:
        """Make model, solver, tensors and the structures that the kernels see."""
        scene, on, n = self.scene, self._warp_device, self.num_worlds
        world = build_world_model(scene, device=str(on), gap=self.adapter.gap, skin=self.adapter.skin)
        self._world, self._model = world, world.model
        self._solver = self.adapter(world, scene)
        robot = scene.robot
        self._sizes = (robot.num_joints, len(robot.foot_names), len(robot.collision_bodies))
        self._now, self._next = self._model.state(), self._model.state()
        self._control = self._model.control()
        self._layout = layout_structure(world.layout, on)
        self._palette = palette_structure(world.slots, on)
        self._slot_shape = ints(world.layout.slot_shape, on)
        force = self._solver.observables.contact_f
        self._contacts = contact_structure(self._solver.contacts, force, self._model.shape_body)
        self._motors = MotorTensors(scene, world, own_dry_friction=self.adapter.own_dry_friction, device=self.device)
        self._masses = MassTensors(world, n, self.device)
        joints, feet, bodies = self._sizes
        sizes = {"joints": joints, "feet": feet, "bodies": bodies, "device": self.device}
        self._state, self._state_arrays = allocate_state(n, **sizes)
        self._sample, self._sample_arrays = allocate_state(n, **sizes)
        self._active = torch.ones(n, dtype=torch.int32, device=self.device)
        self._mask = torch.zeros(n + 1, dtype=torch.bool, device=self.device)
        self._sample_at = torch.zeros(n, dtype=torch.int32, device=self.device)
        self._requested_terrain = torch.tensor(scene.terrain_index, dtype=torch.int32, device=self.device)
        self._terrain = self._requested_terrain.clone()
        self._flag = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._pose = torch.tensor(robot.default_joint_position, dtype=torch.float32, device=self.device)
        self._ticks = wp.zeros(n, dtype=int, device=on)
        kept = (*self._coordinates(self._now), self._solver.warm_start)
        self._kept = tuple(wp.zeros_like(array) for array in kept)

    def _warm_up(self) -> None:
        """Compile everything, while a graph cannot be in the way, and put all worlds at the origin."""
        n = self.num_worlds
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=self.device).repeat(n, 1)
        terrain = self._requested_terrain.to(torch.int64)
        origin = torch.zeros((n, 3), device=self.device)
        high = origin + torch.tensor([0.0, 0.0, BIRTH_HEIGHT], device=self.device)
        self.reset(base_position=high, base_quaternion=upright, terrain_index=terrain)
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
        with (
            wp.ScopedDevice(self._warp_device),
            wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.device))),
        ):
            yield

    def _launch(self, kernel: Any, dim: int | tuple[int, ...], *inputs: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self._warp_device)

    def _coordinates(self, state: Any) -> tuple[Any, Any, Any, Any]:
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
        arguments = (
            self._layout,
            active,
            wp.from_torch(self._flag),
            joints,
            self._motors.structure,
            *self._coordinates(now),
            state,
        )
        self._launch(kernels.begin_period, n, *arguments)
        upright = -2.0 if physics.watch_tilt is None else cos(min(physics.watch_tilt, pi))
        for substep in range(substeps):
            self._launch(
                kernels.motor_law,
                (n, joints),
                substep,
                self._layout,
                self._motors.structure,
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
                    readout.watch_penetration,
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

    def _read(self, select: Any, value: int, state: Any, out: Any, *, contacts_of: Any) -> None:
        """Write the state of the worlds whose ``select`` equals ``value``; without ``contacts_of`` forces are zero."""
        n, (joints, feet, bodies) = self.num_worlds, self._sizes
        live = self._state_arrays
        self._read_motion(select, value, state, out)
        self._launch(readout.clear_forces, n, select, value, joints, feet, bodies, out)
        if contacts_of is None:
            return
        self._launch(readout.read_torques, (n, joints), select, value, self._motors.structure, out)
        count = self._solver.contacts.rigid_contact_max
        poses = contacts_of.body_q
        self._launch(
            readout.add_contacts, count, select, value, self._layout, self._contacts, poses, live.diverged, out
        )
        self._launch(readout.finish_contacts, n, select, value, self._layout, poses, out)

    def _read_motion(self, select: Any, value: int, state: Any, out: Any) -> None:
        """Write poses, velocities and flags."""
        n, (joints, feet, _) = self.num_worlds, self._sizes
        live, com = self._state_arrays, self._model.body_com
        timestep = self.scene.physics.timestep
        ticks = self._ticks
        moving = (state.joint_q, state.joint_qd, com)
        self._launch(
            readout.read_base_and_joints, (n, joints), select, value, timestep, self._layout, ticks, *moving, live, out
        )
        self._launch(readout.read_feet, (n, feet), select, value, self._layout, state.body_q, state.body_qd, com, out)

    def _graph(self, key: tuple[int, bool, bool]) -> Any:
        """The CUDA graph of a control period, captured at its first use."""
        if key not in self._graphs:
            torch.cuda.synchronize(self.device)
            # nothing runs while recording; recording in torch's default stream is impossible
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
            raise BackendError(
                f"the mask of worlds must be {self.num_worlds} booleans, not {tuple(worlds.shape)} of {worlds.dtype}"
            )
        self._active.copy_(worlds)
        self._mask[:-1].copy_(worlds)

    def _rows(self, name: str, value: torch.Tensor | None, width: int, default: float | torch.Tensor = 0.0) -> Any:
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
                self._motors.requested.copy_(held_target)
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
                self._rows("joint_position", joint_position, joints, self._pose),
                self._rows("joint_velocity", joint_velocity, joints),
                self._model.body_com,
                self._motors.structure,
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

    def _place_terrain(self, active: Any) -> None:
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
                self._motors.requested.copy_(joint_targets)
            if delay is None or joint_targets is None:
                self._motors.delay.zero_()
            else:
                self._motors.delay.copy_(delay)
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
        motors, masses = self._motors, self._masses
        targets: dict[str, tuple[torch.Tensor, torch.Tensor | float]] = {
            "friction": (masses.friction, 1.0),
            "base_mass_offset": (masses.base_offset, 1.0),
            "link_mass_scale": (masses.link_scale, 1.0),
            "base_com_offset": (masses.com_offset, 1.0),
            "stiffness_scale": (motors.stiffness, motors.nominal_stiffness),
            "damping_scale": (motors.damping, motors.nominal_damping),
            "motor_strength": (motors.strength, 1.0),
            "motor_offset": (motors.offset, 1.0),
        }
        with self._on_device():
            self._select(worlds)
            asked = [name for name in targets if getattr(randomization, name) is not None]
            for name in asked:
                tensor, unit = targets[name]
                value = getattr(randomization, name).to(self.device, torch.float32)
                self._write_rows(name, tensor, (value.unsqueeze(-1) if name == "friction" else value) * unit, worlds)
            if "friction" in asked:
                self._solver.shapes_changed(wp.from_torch(self._terrain))
            if "base_com_offset" in asked:
                self._launch(
                    kernels.move_center_of_mass,
                    self.num_worlds,
                    self._layout,
                    masses.nominal_com,
                    wp.from_torch(masses.com_offset),
                    self._model.body_com,
                    self._now.joint_q,
                    self._now.joint_qd,
                )
                newton.eval_fk(self._model, self._now.joint_q, self._now.joint_qd, self._now)
            if {"base_mass_offset", "link_mass_scale", "base_com_offset"} & set(asked):
                masses.write(self._solver)

    def _write_rows(self, name: str, tensor: torch.Tensor, rows: torch.Tensor, worlds: torch.Tensor | None) -> None:
        """Write one row for each masked world into a tensor with a row for every world."""
        # counting the mask would wait for a GPU
        wanted = self.num_worlds
        if worlds is not None:
            wanted = int(worlds.sum()) if self.device.type == "cpu" else len(rows)
        if len(rows) != wanted:
            raise BackendError(f"Randomization.{name} has {len(rows)} rows for {wanted} worlds; give one row for each")
        rows = rows.expand(len(rows), *tensor.shape[1:]).contiguous()
        if worlds is None:
            tensor.copy_(rows)
        else:
            mask = worlds.to(self.device).view(-1, *([1] * (tensor.dim() - 1))).expand_as(tensor)
            tensor.masked_scatter_(mask, rows)

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

    def describe(self) -> Mapping[str, list[float]]:
        """See ``PhysicsBackend.describe``."""
        return describe_newton(self.scene, self._world, self._motors)

    def close(self) -> None:
        """Free the graphs."""
        self._graphs.clear()
