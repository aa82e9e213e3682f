"""The Newton engine: its MuJoCo solver as ``newton``, its other solvers as ``newton:NAME``.

Newton's state holds poses and twists; this package's kernels write the motors' torques into ``Control.joint_f`` before every
physics step and read state and contacts afterwards.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import newton
import numpy as np
import torch
import warp as wp

from ..arguments import check_force
from ..base import BackendError, Capability, PhysicsOptions, Randomization, Scene, Support
from ..dry_friction import dry_friction_slope
from ..warp.backend import WarpBackend
from ..warp.device import is_memory_error, memory_advice
from ..warp.structures import filled, to_warp
from . import kernels
from . import readout_kernels as readout
from .buffers import MassTensors, contact_structure, describe_newton
from .model import BIRTH_HEIGHT, build_world_model
from .solvers import SOLVERS, SolverAdapter


class NewtonBackend(WarpBackend):
    """N worlds of one robot in Newton."""

    name: ClassVar[str] = "newton"
    family: ClassVar[str] = "MuJoCo"
    adapter: ClassVar[type[SolverAdapter]] = SOLVERS["mujoco"]
    """Adapter of the solver."""

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
        """Return the backend of a named solver, ``newton:SOLVER``.

        Raises:
            BackendError: this project runs no such solver.
        """
        if solver not in SOLVERS:
            raise BackendError(
                f"unknown Newton solver '{solver}'; 'newton:NAME' runs {' and '.join(SOLVERS)} "
                "(docs/reference/backends.md says why no others)"
            )
        if SOLVERS[solver] is cls.adapter:
            return cls
        fields = {"name": f"newton:{solver}", "family": f"Newton {solver.capitalize()}", "adapter": SOLVERS[solver]}
        return type(f"{solver.capitalize()}NewtonBackend", (cls,), fields)

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        """Build the worlds. ``threads`` is ignored: Warp runs on one CPU thread.

        Raises:
            BackendError: no such device, or a scene that the solver cannot simulate.
        """
        self._open(scene, device)
        self.adapter.refuse(scene)
        self._warp_device = self._scope.warp_device
        try:
            with self._scope():
                self._build()
                self._warm_up()
        except RuntimeError as error:  # the class of torch's and Warp's out-of-memory errors
            if isinstance(error, BackendError) or not is_memory_error(error):
                raise
            raise BackendError(self._memory_advice()) from error

    def _memory_advice(self) -> str:
        """Return the sentence for worlds that do not fit, with the number that would, measured on small copies."""
        self.__dict__ = {name: self.__dict__[name] for name in ("scene", "device", "dtype", "_scope", "_warp_device")}
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

    def _build(self) -> None:
        """Make model, solver, tensors and the structures for the kernels."""
        scene, on, n = self.scene, self._warp_device, self.num_worlds
        world = build_world_model(scene, device=str(on), gap=self.adapter.gap, skin=self.adapter.skin)
        self._world, self._model = world, world.model
        self._solver = self.adapter(world, scene)
        self._allocate()
        self._states = self._model.state(), self._model.state()
        kind: Any = kernels.Motion
        self._motions = [filled(kind, each, warm_start=self._solver.warm_start) for each in self._states]
        self._kept = filled(
            kernels.Motion, **{name: wp.zeros_like(getattr(self._motions[0], name)) for name in kind.vars}
        )
        self._control = self._model.control()
        self._layout, self._palette = filled(kernels.Layout, world.layout), filled(kernels.Palette, world.slots)
        self._slot_shape = to_warp(world.layout.slot_shape, int)
        force = self._solver.observables.contact_f
        self._contacts = contact_structure(self._solver.contacts, force, self._model.shape_body)
        dry = np.zeros(self._joints) if self.adapter.own_dry_friction else np.asarray(scene.parameters.friction_loss)
        dofs = np.array([int(world.reference.joint(name).dofadr[0]) for name in scene.robot.joint_names])
        self._dry_friction = to_warp(dry, float)
        self._dry_slope = to_warp(dry_friction_slope(world.reference, dofs, scene.physics.timestep), float)
        self._masses = MassTensors(world, n, self.device)
        self._mask = torch.ones(n + 1, dtype=torch.bool, device=self.device)
        self._ticks = wp.zeros(n, dtype=int, device=on)

    def _warm_up(self) -> None:
        """Compile all kernels before any graph is recorded, and put all worlds at the origin."""
        self._reset_to_default(BIRTH_HEIGHT)
        self._control_period(1, masked=True, sampled=True)
        self._solver.inertia_changed()
        self.push()
        self._reset_to_default(0.0)

    # ---- running kernels ----------------------------------------------------------------------------------------

    def _launch(self, kernel: Any, dim: int | tuple[int, ...], *inputs: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self._warp_device)

    def _control_period(self, total: int, *, masked: bool, sampled: bool) -> None:
        n, joints = self.num_worlds, self._joints
        physics, state, motors, active = self.scene.physics, self._live, self._motors.arrays, self._active_array
        states, (now, after) = self._states, self._motions
        width = max(self._world.layout.coordinates, self._world.layout.bodies, self._solver.warm_start.shape[1])
        if masked:
            self._launch(kernels.copy_inactive, (n, width), self._layout, active, now, self._kept)
        self._launch(kernels.begin_period, n, self._layout, active, self._request_array, joints, motors, now, state)
        law = (self._layout, motors, self._dry_friction, self._dry_slope, state.diverged)
        watched, depth = physics.watch_penetration is not None, float(physics.watch_penetration or 0.0)
        tables = (self._layout, active, self._contacts, self._palette, self._terrain_array)
        for substep in range(total):
            self._launch(kernels.motor_law, (n, joints), substep, *law, now, self._control.joint_f)
            self._solver.step(*states, self._control, observe=sampled or watched or substep == total - 1)
            self._solver.collect_overflow(active, state.overflowed)
            if watched:
                count = self._solver.contacts.rigid_contact_max
                self._launch(readout.watch_penetration, count, substep, depth, *tables, now.body_q, state)
            ended = (after, self._ticks, state)
            self._launch(kernels.end_substep, n, substep, self._upright_limit, self._layout, active, *ended)
            if sampled:
                self._read(self._sample_array, substep + 1, after, self._sampled, contacts_of=now)
            states, (now, after) = states[::-1], (after, now)
        # the contacts were found in the poses before the last substep
        self._read(active, 1, now, state, contacts_of=after)
        if now is not self._motions[0]:
            for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
                wp.copy(getattr(after, name), getattr(now, name))
        if masked:
            self._launch(kernels.copy_inactive, (n, width), self._layout, active, self._kept, self._motions[0])

    def _read(self, select: Any, value: int, motion: Any, out: Any, *, contacts_of: Any) -> None:
        """Write the state of the worlds with ``select == value``; forces are zero without ``contacts_of``."""
        n, live = self.num_worlds, self._live
        self._read_motion(select, value, motion, out)
        self._clear_forces(select, value, out)
        if contacts_of is None:
            return
        self._read_torques(select, value, out)
        count, poses = self._solver.contacts.rigid_contact_max, contacts_of.body_q
        chosen = (select, value, self._layout)
        self._launch(readout.add_contacts, count, *chosen, self._contacts, poses, live.diverged, out)
        self._launch(readout.finish_contacts, n, *chosen, poses, out)

    def _read_motion(self, select: Any, value: int, motion: Any, out: Any) -> None:
        """Write poses, velocities and flags."""
        n, com, timestep = self.num_worlds, self._model.body_com, self.scene.physics.timestep
        moving = (self._layout, self._ticks, motion, com, self._live, out)
        self._launch(readout.read_base_and_joints, (n, self._joints), select, value, timestep, *moving)
        self._launch(readout.read_feet, (n, self._feet), select, value, self._layout, motion, com, out)

    def _complete_kinematics(self) -> None:
        """Compute the bodies' poses and twists from the joints'."""
        state = self._states[0]
        newton.eval_fk(self._model, state.joint_q, state.joint_qd, state)

    def _place_robots(self) -> None:
        self._mask[:-1].copy_(self._active)
        asked = (self._layout, self._active_array, self._request_array, *self._reset_arrays)
        written = (self._motors.arrays, *self._motions, self._ticks, self._live)
        self._launch(kernels.reset_worlds, (self.num_worlds, self._joints), *asked, self._model.body_com, *written)
        self._solver.reset(self._states[0], wp.from_torch(self._mask))
        self._complete_kinematics()
        self._read(self._active_array, 1, self._motions[0], self._live, contacts_of=None)

    def _place_terrain(self) -> None:
        asked = (self._layout, self._active_array, self._new_terrain_array, len(self.scene.terrains))
        tables = (self._slot_shape, self._palette, self._terrain_array)
        shapes = (self._model.shape_transform, self._model.shape_scale)
        dim = (self.num_worlds, max(1, len(self._world.layout.slot_shape)))
        self._launch(kernels.place_terrain, dim, *asked, *tables, *shapes)
        self._solver.shapes_changed(self._terrain_array)

    def _push_base(self) -> None:
        push = (self._layout, self._active_array, self._twist_array, self._model.body_com, self._motions[0])
        self._launch(kernels.push_base, self.num_worlds, *push)
        self._complete_kinematics()
        self._read_motion(self._active_array, 1, self._motions[0], self._live)

    # ---- the contract -------------------------------------------------------------------------------------------

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``. Fields may also have a row for every world; then the masked rows count."""
        feet = randomization.foot_torsion is not None or randomization.foot_softness is not None
        if feet and self.capabilities()["foot_contact"].support is Support.NONE:
            own = f"backend '{self.name}' has the same feet in all worlds"
            raise BackendError(f"{own}; leave foot_torsion and foot_softness out, or use 'newton' or 'mujoco-warp'")
        masses, rows = self._masses, self._changes(randomization, worlds)
        self._write_motors(rows)
        if "friction" in rows:
            self._write(masses.friction, rows["friction"][:, None])
        for target, values in masses.feet(rows):
            self._write(target, values)
        for name, target in (
            ("base_mass_offset", masses.base_offset),
            ("link_mass_scale", masses.link_scale),
            ("base_com_offset", masses.com_offset),
        ):
            if name in rows:
                self._write(target, rows[name])
        with self._scope():
            if "friction" in rows or feet:
                self._solver.shapes_changed(self._terrain_array)
            if "base_com_offset" in rows:
                shift = (self._layout, masses.nominal_com, wp.from_torch(masses.com_offset))
                moved = (self._model.body_com, self._motions[0])
                self._launch(kernels.move_center_of_mass, self.num_worlds, *shift, *moved)
                self._complete_kinematics()
            if {"base_mass_offset", "link_mass_scale", "base_com_offset"} & set(rows):
                masses.write(self._solver)

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        check_force(self.scene, force_w)
        n, layout = self.num_worlds, self._world.layout
        with self._scope():
            for state in self._states:
                wrenches = wp.to_torch(state.body_f).view(n, layout.bodies, 6)
                wrenches[:, layout.base, :3] = force_w.to(self.device, torch.float32)

    def describe(self) -> Mapping[str, list[float]]:
        """See ``PhysicsBackend.describe``."""
        dry, soft = self._dry_friction.numpy(), self.adapter.skin
        return describe_newton(self.scene, self._world, self._motors, dry, soft=soft)
