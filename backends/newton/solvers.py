"""Adapters of the Newton solvers that this project runs, with one small interface.

To add a solver, measure that the robot stands and walks in it, declare its limits in ``capabilities``, and add it to ``SOLVERS``.
``docs/reference/backends.md`` holds measurements of other solvers.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco_warp
import newton
import numpy as np
import warp as wp

from ..base import CAPABILITY_NAMES, BackendError, Capability, PhysicsOptions, Scene, Support
from ..mujoco_warp.arrays import DROPPED
from ..mujoco_warp.model import SMALLEST_TOLERANCE, constraint_rows, contacts_per_world
from ..upstream.fused_solver import FUSED_SOLVER
from ..upstream.height_fields import HEIGHT_FIELDS
from . import kernels, solver_kernels
from .import_check import import_differences
from .model import WorldModel, carriers

_EXACT = Capability(support=Support.EXACT)


def _roughly(note: str) -> Capability:
    return Capability(support=Support.APPROXIMATE, note=note)


def _declare(**others: Capability) -> dict[str, Capability]:
    """Return exact capabilities, except the named ones."""
    return {name: others.get(name, _EXACT) for name in CAPABILITY_NAMES}


_SAME_FEET = Capability(
    support=Support.NONE, note="the feet's contacts are the same in all worlds, but for sliding friction"
)


class SolverAdapter(ABC):
    """One Newton solver with its contacts."""

    name: ClassVar[str]
    """Name after the colon in ``newton:NAME``."""
    capabilities: ClassVar[Mapping[str, Capability]]
    gap: ClassVar[float]
    """Distance within which the solver needs contacts, for each of the two shapes [m]."""
    skin: ClassVar[bool]
    """True where the robot file's contact margins have MuJoCo's meaning in this solver."""
    own_dry_friction: ClassVar[bool]
    """True where the solver applies the joints' dry friction; else the motor kernel adds it."""

    warm_start: wp.array
    """Data that the solver carries from step to step, (N, W); W is 1 and the entry unused for none."""
    solver: Any
    timestep: float
    """Length of a physics step [s]."""
    fields: _FieldGeom | _FieldShape | None
    """The height field of every world, None where no terrain has one."""
    contacts: newton.Contacts
    observables: newton.solvers.SolverBase.Observables

    @classmethod
    def refuse(cls, scene: Scene) -> None:
        """Raise ``BackendError``, with the option to change, for a scene beyond the solver's capabilities."""
        physics = scene.physics
        for capability, asked, change in (
            ("height_field", any(t.height_field is not None for t in scene.terrains), "use terrains of boxes"),
            ("boxes", any(t.boxes for t in scene.terrains), "use flat terrains"),
            ("foot_condim_6", (physics.foot_condim or 3) > 3, "use PhysicsOptions(foot_condim=3), or None"),
            ("elliptic_cone", physics.cone == "elliptic", "use PhysicsOptions(cone='pyramidal')"),
            ("deterministic", physics.deterministic, "use PhysicsOptions(deterministic=False)"),
        ):
            if asked and cls.capabilities[capability].support is Support.NONE:
                note = cls.capabilities[capability].note
                raise BackendError(f"Newton's {cls.name} solver has no support for {capability} ({note}); {change}")

    @classmethod
    @abstractmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``PhysicsBackend.solver_settings``."""

    @abstractmethod
    def __init__(self, world: WorldModel, scene: Scene) -> None:
        """Make the solver and its contact buffers."""

    def step(self, before: newton.State, after: newton.State, control: newton.Control, *, observe: bool) -> None:
        """Take one physics step; ``observe``: compute contact forces."""
        wanted = self.observables if observe else None
        self.solver.step(before, after, control, self.contacts, self.timestep, observables=wanted)

    @abstractmethod
    def collect_overflow(self, active: Any, overflowed: Any) -> None:
        """Set the flags of the active worlds in which the last step dropped contacts or constraints."""

    def reset(self, state: newton.State, mask: Any) -> None:
        """Forget the past of the masked worlds; ``mask`` is (N + 1,) bool."""
        self.solver.reset(state, mask, flags=0)

    def shapes_changed(self, terrain: Any) -> None:
        """Pass poses, sizes and friction of the model's shapes to the solver; ``terrain`` is each world's, (N,)."""
        self.solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
        if self.fields is not None:
            self.fields.place(terrain)

    def inertia_changed(self) -> None:
        """Pass masses, inertias and centres of mass of the model's bodies to the solver."""
        self.solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)


def _contacts_per_world(scene: Scene, world: WorldModel) -> int:
    """Return the contact capacity of a world."""
    return contacts_per_world(scene.physics, boxes=len(world.layout.slot_shape) > 0, fields=bool(world.slots.fields))


class MujocoAdapter(SolverAdapter):
    """Newton's MuJoCo solver: mujoco_warp behind Newton's model, state and contacts."""

    name = "mujoco"
    capabilities = _declare(
        deterministic=_roughly(
            "to the last bit on a CPU; on a GPU by mujoco_warp's mode, but for sums of contact forces"
        ),
    )
    gap = 0.0
    skin = True
    own_dry_friction = True

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``SolverAdapter.solver_settings``: no tolerance below what single precision can reach."""
        asked = {name: getattr(physics, name) for name in ("cone", "impratio", "iterations", "ls_iterations")}
        return {**asked, "tolerance": max(physics.tolerance, SMALLEST_TOLERANCE)}

    def __init__(self, world: WorldModel, scene: Scene) -> None:
        HEIGHT_FIELDS.apply()
        FUSED_SOLVER.apply()
        physics, model = scene.physics, world.model
        contacts, reference = _contacts_per_world(scene, world), world.reference
        feet = [reference.geom(name).id for name in scene.robot.foot_geoms]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the margins of the warning are repaired below
            try:
                self.solver = newton.solvers.SolverMuJoCo(
                    model,
                    nconmax=contacts,
                    njmax=constraint_rows(reference, feet, physics, contacts),
                    iterations=physics.iterations,
                    ls_iterations=physics.ls_iterations,
                    tolerance=physics.tolerance,
                    solver="newton",
                    integrator="euler",
                    cone=physics.cone,
                    impratio=physics.impratio,
                    enable_multiccd=True,  # as in MuJoCo
                    include_sites=False,
                )
            except ValueError as error:
                raise BackendError(
                    f"Newton's MuJoCo solver cannot build these terrains together: {error}; use fewer of them in one "
                    "scene, PhysicsOptions(self_collision=False), or the backend 'mujoco-warp'"
                ) from error
        self.timestep = physics.timestep
        self._data, self._model = self.solver.mjw_data, self.solver.mjw_model
        if physics.deterministic:
            # mujoco_warp's own mode; Newton's switch asks Warp for a mode in which Newton's kernels do not compile
            self._model.opt.deterministic = int(mujoco_warp.DeterminismType.ATOMICS)
        self._model.opt.warn_overflow = 0  # alarms are reported per world, not printed by the device
        self._check_import(world, scene)
        geoms = _geom_shapes(self.solver)
        shapes = geoms[0] % world.layout.shapes
        margin = np.where(world.layout.shape_ground[shapes] == 0, model.shape_margin.numpy()[shapes], 0.0)
        self._margin: wp.array = wp.array(np.tile(margin, (len(geoms), 1)), dtype=float, device=model.device)
        self.fields = _FieldGeom(self.solver, world, scene) if world.slots.fields else None
        self.warm_start = self._data.qacc_warmstart
        self.contacts = newton.Contacts(self.solver.get_max_contact_count(), 0, device=model.device)
        self.observables = self.solver.observables({self.solver.ObservableKind.CONTACT_F}, contacts=self.contacts)

    def _check_import(self, world: WorldModel, scene: Scene) -> None:
        """Refuse a robot that Newton imports unlike MuJoCo."""
        shape_geom = {int(s): g for g, s in enumerate(_geom_shapes(self.solver)[0])}
        order = np.array([shape_geom[s] for s in range(world.reference.ngeom)])
        wrong = import_differences(self.solver.mj_model, world.reference, order)
        if wrong:
            raise BackendError(
                f"Newton imports robot '{scene.robot.name}' unlike MuJoCo: {'; '.join(wrong)}; "
                "use the backend 'mujoco-warp', or change the robot's model file"
            )

    def collect_overflow(self, active: Any, overflowed: Any) -> None:
        """See ``SolverAdapter.collect_overflow``."""
        inputs = [active, self._data.overflow, DROPPED, overflowed]
        wp.launch(kernels.collect_overflow_bits, dim=active.shape[0], inputs=inputs, device=active.device)

    def shapes_changed(self, terrain: Any) -> None:
        """See ``SolverAdapter.shapes_changed``."""
        super().shapes_changed(terrain)
        # Newton zeroes margins because of an old limit of mujoco_warp
        wp.copy(self._model.geom_margin, self._margin)


def _geom_shapes(solver: Any) -> np.ndarray:
    """Return Newton's shape of each MuJoCo geom in every world, (N, G)."""
    return solver.mjc_geom_to_newton_shape.numpy()


class _FieldGeom:
    """The height-field geom of Newton's MuJoCo solver, with a field for each world."""

    def __init__(self, solver: Any, world: WorldModel, scene: Scene) -> None:
        self._solver, slots, layout = solver, world.slots, world.layout
        device, count = world.model.device, len(slots.fields)
        shape_geom = {int(s): g for g, s in enumerate(_geom_shapes(solver)[0])}
        self._geom = shape_geom[int(layout.slot_shape[-1])]
        ids = solver.mjw_model.geom_dataid.numpy()
        asset = np.zeros(count, dtype=np.int32)
        for i, shape in enumerate(carriers(layout, slots, scene.num_worlds)):
            row, local = divmod(shape, layout.shapes)
            asset[i] = ids[row % len(ids), shape_geom[local]]
        present = np.array([t.height_field is not None for t in scene.terrains])
        low = np.array([float(np.min(f.heights)) for f in slots.fields])[slots.field]
        top = np.array([float(np.max(f.heights)) for f in slots.fields])[slots.field] - low
        base = np.array([f.base for f in slots.fields])[slots.field] + low
        half = np.array([f.half_size for f in slots.fields])[slots.field]
        position = slots.pose[:, -1, :3].copy()
        position[:, 2] += np.where(present, low, 0.0)
        middle = np.c_[np.zeros((len(present), 2)), 0.5 * (top - base)]
        box = np.stack([middle, np.c_[half, 0.5 * (top + base)]], axis=1)
        radius = np.sqrt((half**2).sum(1) + np.maximum(top, base) ** 2)
        self._asset: wp.array = wp.array(asset[slots.field], dtype=int, device=device)
        self._position: wp.array = wp.array(position, dtype=wp.vec3, device=device)
        self._box: wp.array = wp.array(box, dtype=wp.vec3, device=device)
        self._radius: wp.array = wp.array(radius, dtype=float, device=device)

    def place(self, terrain: Any) -> None:
        """Give every world the field of its terrain."""
        model, data = self._solver.mjw_model, self._solver.mjw_data
        wp.launch(
            solver_kernels.place_mujoco_field,
            dim=terrain.shape[0],
            inputs=[terrain, self._geom, self._asset, self._position, self._box, self._radius],
            outputs=[model.geom_dataid, model.geom_pos, data.geom_xpos, model.geom_aabb, model.geom_rbound],
            device=terrain.device,
        )


class _FieldShape:
    """The height-field shape of Newton's own collision pipeline, with a field for each world."""

    def __init__(self, world: WorldModel, scene: Scene) -> None:
        model, layout, slots = world.model, world.layout, world.slots
        self._model, self._shapes, self._shape = model, layout.shapes, int(layout.slot_shape[-1])
        shapes = np.array(carriers(layout, slots, scene.num_worlds))[slots.field]
        half = np.array([f.half_size for f in slots.fields])[slots.field]
        limits = [[float(limit(f.heights)) for f in slots.fields] for limit in (np.min, np.max)]
        low, top = (np.array(values)[slots.field] for values in limits)
        # replicated shapes share the bounds of the first, whatever their field
        lower, upper = np.c_[-half, low], np.c_[half, top]
        radius = np.linalg.norm(np.maximum(np.abs(lower), np.abs(upper)), axis=1)
        device = model.device
        self._tables: tuple[wp.array, ...] = (
            wp.array(model.shape_heightfield_index.numpy()[shapes], dtype=int, device=device),
            wp.array(model.shape_source_ptr.numpy()[shapes], dtype=wp.uint64, device=device),
            wp.array(lower, dtype=wp.vec3, device=device),
            wp.array(upper, dtype=wp.vec3, device=device),
            wp.array(radius, dtype=float, device=device),
        )
        self._arrays = (
            model.shape_heightfield_index,
            model.shape_source_ptr,
            model.shape_collision_aabb_lower,
            model.shape_collision_aabb_upper,
            model.shape_collision_radius,
        )

    def place(self, terrain: Any) -> None:
        """Give every world the field of its terrain."""
        wp.launch(
            solver_kernels.place_newton_field,
            dim=terrain.shape[0],
            inputs=[terrain, self._shapes, self._shape, *self._tables],
            outputs=list(self._arrays),
            device=terrain.device,
        )


class SteelAdapter(SolverAdapter):
    """Newton's Steel solver: joint coordinates, hard contacts by projected Gauss-Seidel, Newton's own collisions."""

    name = "steel"
    capabilities = _declare(
        foot_contact=_SAME_FEET,
        joint_friction=_roughly("an explicit torque that changes sign over a small speed: a joint at rest creeps"),
        elliptic_cone=_roughly("friction is the exact cone of a hard contact; impratio has no meaning here"),
        foot_condim_6=Capability(
            support=Support.NONE, note="contacts slide, they have no torsional or rolling friction"
        ),
        contact_forces=_roughly("impulses of hard contacts divided by the timestep, without moments"),
        deterministic=_roughly("to the last bit on a CPU; on a GPU by Newton's mode, but for sums of contact forces"),
    )
    gap = 0.01
    skin = False
    own_dry_friction = False

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``SolverAdapter.solver_settings``: a fixed number of sweeps over true cones."""
        return {"cone": physics.cone, "iterations": physics.iterations}

    @classmethod
    def refuse(cls, scene: Scene) -> None:
        """See ``SolverAdapter.refuse``; a pyramidal cone is refused too."""
        super().refuse(scene)
        if scene.physics.cone != "elliptic":
            lacks = "Newton's steel solver has no pyramidal friction cone, its contacts slide on a true cone"
            raise BackendError(f"{lacks}; use PhysicsOptions(cone='elliptic')")

    def __init__(self, world: WorldModel, scene: Scene) -> None:
        physics, model = scene.physics, world.model
        contacts = _contacts_per_world(scene, world)
        self.timestep = physics.timestep
        # the solver takes the mean of two coefficients; all shapes get the feet's until the first randomization
        feet = float(np.mean([world.reference.geom(name).friction[0] for name in scene.robot.foot_geoms]))
        model.shape_material_mu.fill_(feet)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.solver = newton.solvers.SolverSteel(
                model,
                iterations=physics.iterations,
                enable_joint_limits=True,
                joint_limit_activation_gap=0.1,
                # point friction and no warm start carry nothing over, so that resets and masks leave no trace
                friction_anchor_beta=0.0,
                contact_warmstart=False,
                enable_restitution=False,
                articulation_constraint_max=3 * contacts + scene.robot.num_joints,
                free_body_constraint_max=1,
                warn_constraint_overflow=False,
                deterministic=wp.DeterministicMode.RUN_TO_RUN if physics.deterministic else None,
            )
            self._pipeline = newton.CollisionPipeline(
                model, rigid_contact_max=contacts * scene.num_worlds + 256, deterministic=physics.deterministic
            )
        self.fields = _FieldShape(world, scene) if world.slots.fields else None
        self.contacts = self._pipeline.contacts()
        self.observables = self.solver.observables({self.solver.ObservableKind.CONTACT_F}, contacts=self.contacts)
        self.warm_start = wp.zeros((scene.num_worlds, 1), dtype=float, device=model.device)

    def step(self, before: newton.State, after: newton.State, control: newton.Control, *, observe: bool) -> None:
        """See ``SolverAdapter.step``."""
        self._pipeline.collide(before, self.contacts)
        super().step(before, after, control, observe=observe)

    def collect_overflow(self, active: Any, overflowed: Any) -> None:
        """See ``SolverAdapter.collect_overflow``."""
        inputs = [active, self.solver.constraint_overflow, overflowed]
        wp.launch(kernels.collect_overflow_flags, dim=active.shape[0], inputs=inputs, device=active.device)


SOLVERS: Mapping[str, type[SolverAdapter]] = {each.name: each for each in (MujocoAdapter, SteelAdapter)}
"""Solvers by name; the first is the default."""
