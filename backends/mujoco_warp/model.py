"""Build the model that all worlds of the mujoco_warp engine share, and the tables of each world's ground.

The model holds the robot without visual geoms, a floor, box geoms for the palette's fullest terrain, and one height-field geom
if any terrain has a field. A world's terrain is a set of poses and sizes of these geoms, the slots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...terrains.base import HeightField, Terrain
from ..base import BackendError, PhysicsOptions, Scene
from ..mujoco.model import robot_spec

PARKED = (0.0, 0.0, -1000.0)
"""Place of unused slots, out of reach of any robot [m]."""
PARKED_SIZE = 0.01
"""Half size of an unused slot [m]."""
DEFAULT_CONTACTS = {"plane": 32, "boxes": 40, "height_field": 56}
"""Contact capacity of a world, by the palette's hardest shape; a robot that lies flat needs about 30."""
SPARE_CONTACTS = 256
"""Further contact capacity, shared by all worlds, for fallen robots."""

SMALLEST_TOLERANCE = 1e-6
"""Smallest solver tolerance that single precision reaches; mujoco_warp raises smaller ones to it."""

Floats = NDArray[np.float64]
Integers = NDArray[np.int32]
Tables = dict[str, NDArray]
"""Arrays by the name of a structure's field."""


@dataclass(frozen=True, kw_only=True)
class SharedModel:
    """The compiled model and its tables for kernels. G geoms, B collision bodies, J joints."""

    model: mujoco.MjModel
    palette: Tables
    """Terrains as slot poses and sizes: the fields of ``arrays.Palette``."""
    links: Tables
    """Links from the base to each foot: the fields of ``arrays.Links``."""
    slot_geom: Integers
    """Geom of each slot, (S,)."""
    has_field: bool
    roles: Tables
    """Role of each geom: the fields of ``arrays.Roles``."""
    joint_q: Integers
    """Address in qpos, (J,)."""
    joint_v: Integers
    """Address in qvel, (J,)."""
    base: int
    """Id of the base body."""
    bodies: Integers
    """Ids of the collision bodies, (B,)."""


@dataclass(frozen=True, kw_only=True)
class Capacity:
    """Sizes of the engine's fixed buffers."""

    contacts: int
    """Contacts (and candidate pairs) of all worlds together."""
    convex: int
    """Contacts of all worlds together in the iterative convex solver, for each pair of shapes."""
    rows: int
    """Constraint rows of one world."""


def build_shared_model(scene: Scene) -> SharedModel:
    """Compile the model that all worlds share.

    Raises:
        BackendError: a name of the robot is missing in its file, or the robot is no tree of hinges on one free base.
    """
    robot = scene.robot
    slots = max((len(t.boxes) for t in scene.terrains), default=0)
    fields = [t.height_field for t in scene.terrains if t.height_field is not None]
    spec = robot_spec(scene)
    strip(spec)
    slot_names = _add_slots(spec, fields, slots)
    try:
        model = spec.compile()
    except ValueError as error:
        raise BackendError(f"MuJoCo cannot build the model of robot '{robot.name}': {error}") from error
    for address, field in zip(model.hfield_adr, fields, strict=True):
        # unchanged, because MuJoCo's compiler shifts every field's lowest node to zero
        elevation = (field.heights / _top(field.heights)).ravel()
        model.hfield_data[address : address + len(elevation)] = elevation
    base = _find(model, scene, "body", robot.base_body)
    free = model.body_jntadr[base]
    if free != 0 or model.jnt_type[free] != mujoco.mjtJoint.mjJNT_FREE:
        raise BackendError(f"body '{robot.base_body}' of robot '{robot.name}' must carry a free joint and come first")
    slot_geom = np.array([model.geom(name).id for name in slot_names], dtype=np.int32)
    geom_slot = np.full(model.ngeom, -1, dtype=np.int32)
    geom_slot[slot_geom] = np.arange(len(slot_geom))
    bodies = np.array([_find(model, scene, "body", name) for name in robot.collision_bodies], dtype=np.int32)
    index = {int(b): i for i, b in enumerate(bodies)}
    trunk = [_find(model, scene, "geom", name) for name in scene.robot.trunk_shapes]
    geom_foot = np.full(model.ngeom, -1, dtype=np.int32)
    for foot, sole in enumerate(robot.soles):
        geom_foot[[_find(model, scene, "geom", name) for name in sole]] = foot
    return SharedModel(
        model=model,
        palette=_palette(scene.terrains, slots, bool(fields)),
        links=_links(model, scene, base),
        slot_geom=slot_geom,
        has_field=bool(fields),
        roles={
            "foot": geom_foot,
            "body": np.array([index.get(int(b), -1) for b in model.geom_bodyid], dtype=np.int32),
            "trunk": np.isin(np.arange(model.ngeom), trunk).astype(np.int32),
            "ground": (model.geom_bodyid == 0).astype(np.int32),
            "slot": geom_slot,
        },
        joint_q=np.array([model.joint(j).qposadr[0] for j in robot.joint_names], dtype=np.int32),
        joint_v=np.array([model.joint(j).dofadr[0] for j in robot.joint_names], dtype=np.int32),
        base=base,
        bodies=bodies,
    )


def contacts_per_world(physics: PhysicsOptions, *, boxes: bool, fields: bool) -> int:
    """Return the contact capacity of a world, from the options or else from the shapes of the palette.

    Raises:
        BackendError: less than one contact is asked for.
    """
    asked = physics.contacts_per_world
    if asked is not None and asked < 1:
        raise BackendError(f"contacts_per_world is {asked}, but must be at least 1 (PhysicsOptions.contacts_per_world)")
    return asked or DEFAULT_CONTACTS["height_field" if fields else "boxes" if boxes else "plane"]


def constraint_rows(model: mujoco.MjModel, feet: Sequence[int], physics: PhysicsOptions, contacts: int) -> int:
    """Return the constraint rows of one world: joint friction, joint limits, contacts; feet (geoms) have their own dimension."""
    rows_of = (lambda d: d) if physics.cone == "elliptic" else (lambda d: max(1, 2 * (d - 1)))
    rows = int(np.count_nonzero(model.dof_frictionloss > 0)) + int(model.jnt_limited.sum()) + contacts * rows_of(3)
    # a foot rarely has more than two contacts: the ground and another box
    rows += 2 * sum(rows_of(max(int(model.geom_condim[g]), 3)) - rows_of(3) for g in feet)
    return 16 * -(-rows // 16)


def buffer_capacity(scene: Scene, shared: SharedModel) -> Capacity:
    """Return the sizes of the buffers, from ``PhysicsOptions.contacts_per_world`` or the palette's shapes."""
    model, physics = shared.model, scene.physics
    contacts = contacts_per_world(physics, boxes=len(shared.slot_geom) > 0, fields=shared.has_field)
    rows = constraint_rows(model, np.flatnonzero(shared.roles["foot"] >= 0).tolist(), physics, contacts)
    collides = (shared.roles["ground"] == 0) & ((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    same_shape = np.bincount(model.geom_type[collides]).max(initial=1)
    total = scene.num_worlds * contacts + SPARE_CONTACTS
    per_world = int(same_shape) if shared.has_field else max(8, contacts // 4)
    return Capacity(contacts=total, convex=min(scene.num_worlds * per_world + SPARE_CONTACTS, total), rows=rows)


def strip(spec: mujoco.MjSpec) -> None:
    """Remove actuators (kernels compute the motor law), sensors, lights and cameras; ``robot_spec`` removes visual geoms."""
    for element in [*spec.actuators, *spec.sensors, *spec.lights, *spec.cameras]:
        spec.delete(element)


def _add_slots(spec: mujoco.MjSpec, fields: Sequence[HeightField], slots: int) -> list[str]:
    """Add floor, box slots and height fields; return the names of the slots' geoms, in order."""
    world = spec.worldbody
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    names = [f"box_{i}" for i in range(slots)]
    for name in names:
        world.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[PARKED_SIZE] * 3, pos=PARKED)
    for i, field in enumerate(fields):
        hfield = spec.add_hfield(name=f"field_{i}", nrow=field.heights.shape[0], ncol=field.heights.shape[1])
        hfield.size = np.array([*field.half_size, _top(field.heights), field.base])
        hfield.userdata = field.heights.astype(np.float32).ravel()
    if fields:
        world.add_geom(name="field", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field_0", pos=PARKED)
        names.append("field")
    return names


def _top(heights: Floats) -> float:
    """Return the height of the engine's unit elevation [m]."""
    return max(float(heights.max()), 1e-6)


def _palette(terrains: tuple[Terrain, ...], slots: int, has_field: bool) -> Tables:
    """Return slot poses, sizes and bounds of every terrain."""
    t, s = len(terrains), slots + int(has_field)
    position = np.tile(np.array(PARKED), (t, s, 1))
    rotation = np.tile(np.eye(3), (t, s, 1, 1))
    size = np.full((t, s, 3), PARKED_SIZE)
    center, half = np.zeros((t, s, 3)), np.full((t, s, 3), PARKED_SIZE)
    radius = np.full((t, s), PARKED_SIZE * np.sqrt(3.0))
    field_index, wall = np.zeros(t, dtype=np.int32), np.zeros((t, s), dtype=np.int32)
    seen = 0
    for i, terrain in enumerate(terrains):
        for k, box in enumerate(terrain.boxes):
            position[i, k] = box.center
            turn = np.asarray(box.quaternion) / np.linalg.norm(box.quaternion)
            mujoco.mju_quat2Mat(rotation[i, k].reshape(9), turn)  # a view
            size[i, k] = half[i, k] = box.half_size
            radius[i, k] = np.linalg.norm(box.half_size)
            wall[i, k] = box.wall
        field = terrain.height_field
        if field is not None:
            field_index[i], seen = seen, seen + 1
            top, base = _top(field.heights), field.base
            position[i, -1] = (*field.center, 0.0)
            size[i, -1] = (*field.half_size, 0.25 * top + 0.5 * base)
            center[i, -1] = (0.0, 0.0, 0.5 * (top - base))
            half[i, -1] = (*field.half_size, 0.5 * (top + base))
            radius[i, -1] = np.sqrt(np.sum(np.square(field.half_size)) + max(top, base) ** 2)
    bounds = {"bound_center": center, "bound_half": half, "radius": radius}
    return {"position": position, "rotation": rotation, "size": size, "field": field_index, "wall": wall} | bounds


def _links(model: mujoco.MjModel, scene: Scene, base: int) -> Tables:
    """Follow each foot's body up to the base; one link for each body, and one more for each further joint of a body."""
    start: list[int] = [0]
    rows: list[tuple[Floats, Floats, int]] = []
    feet: list[Floats] = []
    unit = np.array([1.0, 0.0, 0.0, 0.0])
    for name, sole in zip(scene.robot.foot_names, scene.robot.soles, strict=True):
        geoms = [_find(model, scene, "geom", shape) for shape in sole]
        feet.append(model.geom_pos[geoms].mean(axis=0))
        chain: list[int] = []
        body = int(model.geom_bodyid[geoms[0]])
        while body != base:
            if body == 0:
                foot = f"foot '{name}' of robot '{scene.robot.name}'"
                raise BackendError(f"{foot} does not hang on its base '{scene.robot.base_body}'")
            chain.append(body)
            body = int(model.body_parentid[body])
        for body in reversed(chain):
            first, number = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            for i, joint in enumerate(range(first, first + number) or [-1]):
                if joint >= 0 and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
                    wrong = f"joint '{model.joint(joint).name}' of robot '{scene.robot.name}'"
                    raise BackendError(f"{wrong} must be a hinge")
                offset = (model.body_pos[body], model.body_quat[body]) if i == 0 else (np.zeros(3), unit)
                rows.append((*offset, joint))
        start.append(len(rows))
    joint_of = [j for _, _, j in rows]

    def of_joint(values: NDArray, empty: float | Floats) -> NDArray:
        return np.array([values[j] if j >= 0 else empty for j in joint_of])

    turns = np.array([q for _, q, _ in rows]).reshape(-1, 4)
    return {
        "start": np.array(start, dtype=np.int32),
        "position": np.array([p for p, _, _ in rows]).reshape(-1, 3),
        "rotation": np.roll(turns, -1, axis=1),  # Warp's quaternions are xyzw
        "hinge": np.array([int(j >= 0) for j in joint_of], dtype=np.int32),
        "axis": of_joint(model.jnt_axis, np.array([0.0, 0.0, 1.0])).reshape(-1, 3),
        "anchor": of_joint(model.jnt_pos, np.zeros(3)).reshape(-1, 3),
        "address_q": of_joint(model.jnt_qposadr, 0).astype(np.int32),
        "address_v": of_joint(model.jnt_dofadr, 0).astype(np.int32),
        "zero": np.array([model.qpos0[model.jnt_qposadr[j]] if j >= 0 else 0.0 for j in joint_of]),
        "foot": np.array(feet).reshape(-1, 3),
    }


def _find(model: mujoco.MjModel, scene: Scene, kind: str, name: str) -> int:
    """Return the id of a ``body`` or collision ``geom`` of the robot; raise ``BackendError`` where it is missing."""
    found = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if found < 0:
        missing = (
            f"robot '{scene.robot.name}' has no {'collision ' * (kind == 'geom')}{kind} '{name}' in its model file"
        )
        raise BackendError(f"{missing}; correct robot.toml")
    return int(found)
