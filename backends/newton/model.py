"""Build Newton models from a scene, and check Newton's import of the robot's file.

Every world holds the robot, a floor, as many boxes as the palette's fullest terrain needs and one height field if any
terrain has one. Poses and sizes of boxes and field, called slots, make a terrain, and a reset may change them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from ...terrains.base import HeightField, Terrain
from ..base import BackendError, Scene
from ..mujoco.model import robot_spec
from ..mujoco_warp.model import PARKED, PARKED_SIZE, strip

BIRTH_HEIGHT = 50.0
"""Height of the base in a fresh model [m], without contacts while buffers are sized."""

Floats = NDArray[np.float64]
Integers = NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class WorldLayout:
    """Places in one world's share of Newton's arrays. J joints, F feet, S shapes, B bodies, K slots."""

    coordinates: int
    dofs: int
    bodies: int
    shapes: int
    base: int
    """Index of the base body."""
    joint_q: Integers
    """Coordinate of each joint, (J,)."""
    joint_v: Integers
    """Degree of freedom of each joint, (J,)."""
    collision_bodies: Integers
    """Bodies in the order of ``Robot.collision_bodies``."""
    foot_body: Integers
    foot_center: Floats
    """Foot centres in their bodies' frames [m], (F, 3)."""
    shape_foot: Integers
    shape_body: Integers
    shape_trunk: Integers
    shape_ground: Integers
    shape_slot: Integers
    """Roles of the shapes as in ``kernels.Layout``, (S,) each."""
    slot_shape: Integers
    """Shape of each slot: boxes, then the height field if there is one, (K,)."""
    spare_fields: Integers
    """Shapes that only carry further height fields into the model, where the palette has more fields than worlds."""


@dataclass(frozen=True, kw_only=True)
class SlotTables:
    """The palette's terrains as slots. T terrains, K slots."""

    pose: Floats
    """Positions [m] and rotations xyzw, (T, K, 7)."""
    scale: Floats
    """Half sizes of boxes [m]; height fields have ones, (T, K, 3)."""
    wall: Integers
    """1 for boundary walls, (T, K)."""
    field: Integers
    """Index of the terrain's height field among the palette's, 0 for none, (T,)."""
    fields: tuple[HeightField, ...]
    """Height fields of the palette."""


@dataclass(frozen=True, kw_only=True)
class WorldModel:
    """The Newton model of all worlds with its layout."""

    model: Any
    """A ``newton.Model``; Newton declares every one of its arrays as optional."""
    layout: WorldLayout
    slots: SlotTables
    reference: mujoco.MjModel
    """The robot as compiled by MuJoCo."""


def build_world_model(scene: Scene, *, device: str, gap: float, skin: bool) -> WorldModel:
    """Build the model of all worlds.

    Args:
        gap: distance of each shape within which Newton looks for contacts [m].
        skin: keep the robot file's contact margins, which thicken the shapes of solvers with hard contacts.

    Raises:
        BackendError: the robot is no tree of hinges on a free base, or Newton cannot import it.
    """
    reference, source = _compiled_robot(scene)
    world = newton.ModelBuilder()
    world.rigid_gap = gap
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the import is checked below, field by field
        try:
            world.add_mjcf(source, parse_visuals=False, parse_sites=False, parse_mujoco_options=False)
        except (ValueError, RuntimeError, NotImplementedError) as error:
            robot = f"robot '{scene.robot.name}' ({scene.robot.mjcf.name})"
            raise BackendError(f"Newton cannot import {robot}: {error}") from error
    _repair_import(world, reference, scene, gap=gap, skin=skin)
    robot_shapes = len(world.shape_type)
    slots = _slot_tables(scene.terrains)
    slot_shapes, spare = _add_ground(world, slots, scene, gap=gap)
    layout = _layout(world, reference, scene, robot_shapes, slot_shapes, spare)
    everything = newton.ModelBuilder()
    everything.rigid_gap = gap
    everything.replicate(world, scene.num_worlds)
    _distribute_fields(everything, layout, slots, scene)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = everything.finalize(device=device, skip_all_validations=True)
    return WorldModel(model=model, layout=layout, slots=slots, reference=reference)


def _compiled_robot(scene: Scene) -> tuple[mujoco.MjModel, str]:
    """Return the robot with the scene's constants, without motors, sensors and visual geoms, compiled and as MJCF text."""
    spec = robot_spec(scene)
    strip(spec)
    for key in list(spec.keys):
        spec.delete(key)
    try:
        _weigh_what_is_seen(spec)
        return spec.compile(), spec.to_xml()
    except ValueError as error:
        raise BackendError(f"MuJoCo cannot build the model of robot '{scene.robot.name}': {error}") from error


def _weigh_what_is_seen(spec: mujoco.MjSpec) -> None:
    """Make inertias explicit where visual geoms contribute, and delete those geoms, which Newton does not import."""
    seen = [geom for geom in spec.geoms if not (geom.contype or geom.conaffinity)]
    if not seen:
        return
    model = spec.compile()
    for body in spec.bodies:
        if model.body_mass[body.id] > 0.0:
            body.explicitinertial = True
            body.mass, body.inertia = model.body_mass[body.id], model.body_inertia[body.id]
            body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
            body.fullinertia = np.full(6, np.nan)
    for geom in seen:
        spec.delete(geom)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE


def _leaf(label: str) -> str:
    """Return the name of a body, joint or shape: Newton's labels are paths."""
    return label.rpartition("/")[2]


def _repair_import(
    world: newton.ModelBuilder, reference: mujoco.MjModel, scene: Scene, *, gap: float, skin: bool
) -> None:
    """Give the imported robot MuJoCo's values in full precision, wherever Newton has a field for them.

    Newton's importer reads six digits and has its own defaults, margins and gaps.
    """
    robot = scene.robot
    bodies = [_leaf(label) for label in world.body_label]
    expected = [reference.body(i).name for i in range(1, reference.nbody)]
    if bodies != expected:
        raise BackendError(f"Newton imports the bodies {bodies} of robot '{robot.name}', but MuJoCo has {expected}")
    if world.joint_type[0] != newton.JointType.FREE or any(
        t != newton.JointType.REVOLUTE for t in world.joint_type[1:]
    ):
        raise BackendError(f"robot '{robot.name}' must be one free base with hinge joints only to run in Newton")
    matrix = np.zeros(9)
    for i in range(len(bodies)):
        mujoco.mju_quat2Mat(matrix, reference.body_iquat[i + 1])
        turn = matrix.reshape(3, 3)
        inertia = turn @ np.diag(reference.body_inertia[i + 1]) @ turn.T
        world.body_mass[i] = float(reference.body_mass[i + 1])
        world.body_inv_mass[i] = 1.0 / float(reference.body_mass[i + 1])
        world.body_com[i] = wp.vec3(*reference.body_ipos[i + 1])
        world.body_inertia[i] = wp.mat33(*inertia.ravel())
        world.body_inv_inertia[i] = wp.mat33(*np.linalg.inv(inertia).ravel())
    for i, label in enumerate(world.joint_label[1:], 1):
        joint = reference.joint(_leaf(label))
        dof, start = int(joint.dofadr[0]), world.joint_qd_start[i]
        world.joint_armature[start] = float(reference.dof_armature[dof])
        world.joint_friction[start] = float(reference.dof_frictionloss[dof])
        world.joint_damping[start] = float(reference.dof_damping[dof].flat[0])
        if joint.limited[0]:
            world.joint_limit_lower[start], world.joint_limit_upper[start] = map(float, joint.range)
        # kernels compute the motors' torques: no drive of Newton's, no effort limit
        world.joint_target_ke[start] = world.joint_target_kd[start] = 0.0
        world.joint_target_mode[start] = int(newton.JointTargetMode.EFFORT)
        world.joint_effort_limit[start] = 1e6
    for i, label in enumerate(world.shape_label):
        geom = reference.geom(_leaf(label))
        world.shape_gap[i] = gap
        world.shape_margin[i] = float(geom.margin[0]) if skin else 0.0
        world.shape_transform[i] = wp.transform(geom.pos, wp.quat(*np.roll(geom.quat, -1)))  # wxyz becomes xyzw
    world.joint_q[2] = BIRTH_HEIGHT
    for name, angle in zip(robot.joint_names, robot.default_joint_position, strict=True):
        world.joint_q[world.joint_q_start[_joint(world, name, robot.name)]] = float(angle)


def _joint(world: newton.ModelBuilder, name: str, robot: str) -> int:
    """Return the index of a joint."""
    found = [i for i, label in enumerate(world.joint_label) if _leaf(label) == name]
    if not found:
        missing = f"joint '{name}' of robot '{robot}' is not in its model file"
        raise BackendError(f"{missing}; correct joint_names in robot.toml")
    return found[0]


def _slot_tables(terrains: tuple[Terrain, ...]) -> SlotTables:
    """Return slot poses and sizes of every terrain."""
    boxes = max((len(t.boxes) for t in terrains), default=0)
    fields = tuple(t.height_field for t in terrains if t.height_field is not None)
    count, slots = len(terrains), boxes + bool(fields)
    pose = np.tile(np.array([*PARKED, 0.0, 0.0, 0.0, 1.0]), (count, slots, 1))
    scale = np.full((count, slots, 3), PARKED_SIZE)
    wall, field_index = np.zeros((count, slots), dtype=np.int32), np.zeros(count, dtype=np.int32)
    seen = 0
    for i, terrain in enumerate(terrains):
        for k, box in enumerate(terrain.boxes):
            w, x, y, z = np.asarray(box.quaternion) / np.linalg.norm(box.quaternion)
            pose[i, k] = (*box.center, x, y, z, w)
            scale[i, k] = box.half_size
            wall[i, k] = box.wall
        if fields:
            scale[i, -1] = 1.0
        if terrain.height_field is not None:
            pose[i, -1, :3] = (*terrain.height_field.center, 0.0)
            field_index[i], seen = seen, seen + 1
    return SlotTables(pose=pose, scale=scale, wall=wall, field=field_index, fields=fields)


def _add_ground(
    world: newton.ModelBuilder, slots: SlotTables, scene: Scene, *, gap: float
) -> tuple[list[int], list[int]]:
    """Add floor, box slots and height field; return the shapes of the slots and the spare fields."""
    material = newton.ModelBuilder.ShapeConfig(
        mu=1.0,
        mu_torsional=0.005,
        mu_rolling=0.0001,
        gap=gap,
        margin=0.0,
        # a negative group meets all but itself, which leaves the solver's 32 masks to pairs of the robot's shapes
        collision_group=min(0, *world.shape_collision_group) - 1,
    )
    world.add_ground_plane(cfg=material)
    boxes = slots.pose.shape[1] - bool(slots.fields)
    parked = wp.transform(wp.vec3(*PARKED), wp.quat_identity())
    shapes = [
        world.add_shape_box(-1, xform=parked, hx=PARKED_SIZE, hy=PARKED_SIZE, hz=PARKED_SIZE, cfg=material)
        for _ in range(boxes)
    ]
    spare: list[int] = []
    if slots.fields:
        for i in range(-(-len(slots.fields) // scene.num_worlds)):
            field = _newton_field(slots.fields[0])
            shape = world.add_shape_heightfield(xform=parked, heightfield=field, cfg=material)
            (shapes if i == 0 else spare).append(shape)
    return shapes, spare


def _newton_field(field: HeightField) -> newton.Heightfield:
    """Return a height field in Newton's terms; rows run along +y and columns along +x in both."""
    heights = np.asarray(field.heights, dtype=np.float64)
    low, high = float(heights.min()), float(heights.max())
    # a level field needs an extent, because heights are shares of it
    return newton.Heightfield(
        data=heights,
        nrow=heights.shape[0],
        ncol=heights.shape[1],
        hx=field.half_size[0],
        hy=field.half_size[1],
        min_z=low,
        max_z=max(high, low + 1e-6),
    )


def _distribute_fields(everything: newton.ModelBuilder, layout: WorldLayout, slots: SlotTables, scene: Scene) -> None:
    """Let the worlds' field shapes carry all fields of the palette into the model; resets assign them to worlds.

    Newton copies the field of every shape, so all shapes but the carriers get a tiny field.
    """
    if not slots.fields:
        return
    tiny = _newton_field(HeightField(center=(0.0, 0.0), half_size=(0.01, 0.01), heights=np.zeros((2, 2))))
    base: Any = everything.custom_attributes["mujoco:hfield_base"].values
    for shape in (int(layout.slot_shape[-1]), *map(int, layout.spare_fields)):
        for world in range(scene.num_worlds):
            everything.shape_source[world * layout.shapes + shape] = tiny
    for i, shape in enumerate(carriers(layout, slots, scene.num_worlds)):
        field = slots.fields[i]
        everything.shape_source[shape] = _newton_field(field)
        # Newton measures the solid's depth from the lowest node, ``HeightField`` from height 0
        base[shape] = field.base + float(np.min(field.heights))


def carriers(layout: WorldLayout, slots: SlotTables, worlds: int) -> list[int]:
    """Return the model's shape that carries each height field of the palette."""
    shapes = (int(layout.slot_shape[-1]), *map(int, layout.spare_fields))
    return [(i % worlds) * layout.shapes + shapes[i // worlds] for i in range(len(slots.fields))]


def _layout(
    world: newton.ModelBuilder,
    reference: mujoco.MjModel,
    scene: Scene,
    robot_shapes: int,
    slot_shapes: list[int],
    spare: list[int],
) -> WorldLayout:
    """Find the robot's parts in a world's arrays."""
    robot = scene.robot
    bodies = {_leaf(label): i for i, label in enumerate(world.body_label)}
    shapes = {_leaf(label): i for i, label in enumerate(world.shape_label[:robot_shapes])}
    for what, names, known in (
        ("body", (robot.base_body, *robot.collision_bodies), bodies),
        ("foot", robot.foot_geoms, shapes),
        ("trunk shape", robot.trunk_shapes, shapes),
    ):
        missing = [name for name in names if name not in known]
        if missing:
            lost = f"{what} '{missing[0]}' of robot '{robot.name}' is not in {robot.mjcf.name}"
            raise BackendError(f"{lost}; correct robot.toml")
    if bodies[robot.base_body] != 0:
        raise BackendError(f"body '{robot.base_body}' of robot '{robot.name}' must carry the free joint and come first")
    joints = [_joint(world, name, robot.name) for name in robot.joint_names]
    count = len(world.shape_type)
    body_index = {bodies[name]: i for i, name in enumerate(robot.collision_bodies)}
    foot, body, slot = np.full((3, count), -1, dtype=np.int32)
    trunk, ground = np.zeros((2, count), dtype=np.int32)
    for number, sole in enumerate(robot.soles):
        foot[[shapes[name] for name in sole]] = number
    trunk[[shapes[name] for name in robot.trunk_shapes]] = 1
    body[:robot_shapes] = [body_index.get(index, -1) for index in world.shape_body[:robot_shapes]]
    ground[robot_shapes:] = 1
    slot[slot_shapes] = np.arange(len(slot_shapes))
    return WorldLayout(
        coordinates=len(world.joint_q),
        dofs=len(world.joint_qd),
        bodies=len(bodies),
        shapes=count,
        base=0,
        joint_q=np.array([world.joint_q_start[j] for j in joints], dtype=np.int32),
        joint_v=np.array([world.joint_qd_start[j] for j in joints], dtype=np.int32),
        collision_bodies=np.array([bodies[name] for name in robot.collision_bodies], dtype=np.int32),
        foot_body=np.array([world.shape_body[shapes[sole[0]]] for sole in robot.soles], dtype=np.int32),
        foot_center=np.array([np.mean([reference.geom(name).pos for name in sole], axis=0) for sole in robot.soles]),
        shape_foot=foot,
        shape_body=body,
        shape_trunk=trunk,
        shape_ground=ground,
        shape_slot=slot,
        slot_shape=np.array(slot_shapes, dtype=np.int32),
        spare_fields=np.array(spare, dtype=np.int32),
    )
