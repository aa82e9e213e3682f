"""Read a robot's links, joints and collision shapes off its compiled MuJoCo model, for engines that build their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..base import SMALLEST_BASE_MASS, BackendError, Scene
from ..dry_friction import dry_friction_slope
from ..mujoco.model import robot_spec

Array = NDArray[np.float64]
_KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A collision shape in its link's frame."""

    name: str
    """Unique within the robot."""
    kind: str
    """``sphere``, ``capsule``, ``ellipsoid``, ``cylinder``, ``box`` or ``mesh``; capsules and cylinders lie along z."""
    size: Array
    """MuJoCo's half sizes [m], (3,): radius; radius and half length; semi-axes; half extents."""
    position: Array
    quaternion: Array
    """wxyz."""
    link: int
    friction: float
    """Sliding coefficient of the robot's file."""
    foot: int
    """Index of the foot, -1 for none."""
    trunk: bool
    vertices: Array
    """Of a mesh [m], (V, 3); its convex hull collides."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Foot:
    """Centre of a foot: the mean of its shapes' centres."""

    link: int
    position: Array
    """In the link's frame [m], (3,)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid body and the hinge that carries it."""

    name: str
    parent: int
    """Index of the parent link, -1 for the base."""
    position: Array
    """In the parent's frame at joint angle 0 [m], (3,)."""
    quaternion: Array
    """wxyz."""
    mass: float
    center: Array
    """Centre of mass [m], (3,)."""
    inertia: Array
    """About the centre of mass along the link's axes [kg·m²], (3, 3)."""
    joint: int
    """Index in the robot's joint order, -1 for a rigid mount or the base."""
    axis: Array
    """Of the hinge, (3,)."""
    anchor: Array
    """Of the hinge [m], (3,)."""
    limits: tuple[float, float]
    """[rad]; infinite for none."""
    standing: tuple[Array, Array]
    """Position [m] and quaternion wxyz in the default pose, the base at the origin."""
    collision_body: int
    """Index in ``Robot.collision_bodies``, -1 for none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotModel:
    """A robot's tree; a parent precedes its children and the base is first."""

    links: tuple[Link, ...]
    shapes: tuple[Shape, ...]
    meeting: frozenset[tuple[int, int]]
    """Pairs of shapes, the smaller index first, that collide with each other."""
    foot_friction: float
    """Mean sliding coefficient of the feet in the robot's file."""
    friction_slope: Array
    """Of ``dry_friction_slope`` [N·m·s/rad], (J,)."""

    @property
    def feet(self) -> list[Foot]:
        """Return the centre of each foot."""
        soles: dict[int, list[Shape]] = {}
        for shape in self.shapes:
            soles.setdefault(shape.foot, []).append(shape)
        return [
            Foot(link=sole[0].link, position=np.mean([shape.position for shape in sole], axis=0))
            for foot, sole in sorted(soles.items())
            if foot >= 0
        ]

    @property
    def collision_links(self) -> list[int]:
        """Return the link of each of ``Robot.collision_bodies``."""
        found = {link.collision_body: index for index, link in enumerate(self.links)}
        return [found[body] for body in range(max(found) + 1)]

    def inertias(self, changes: Mapping[str, Array]) -> list[tuple[float, Array, Array]]:
        """Return mass, centre and inertia of each link, as in ``Link``, after the changes of ``Randomization`` by name."""
        scale, found = changes.get("link_mass_scale"), []
        for link in self.links:
            mass, center, inertia = link.mass, link.center, link.inertia
            if link.parent < 0:
                mass = max(mass + float(changes.get("base_mass_offset", 0.0)), SMALLEST_BASE_MASS)
                center = center + changes.get("base_com_offset", 0.0)
            elif scale is not None and link.collision_body >= 0:
                mass, inertia = mass * scale[link.collision_body], inertia * scale[link.collision_body]
            found.append((mass, center, inertia))
        return found


def read_robot(scene: Scene) -> RobotModel:
    """Return the robot of a scene.

    Raises:
        BackendError: the robot has a joint other than hinges at the reference angle 0, a spring, an equality or a tendon, or a shape
            that no engine here knows.
    """
    robot, model = scene.robot, robot_spec(scene).compile()
    unknown = {"springs in its joints": model.jnt_stiffness.any(), "equalities": model.neq, "tendons": model.ntendon}
    if found := [words for words, there in unknown.items() if there]:
        what = " and ".join(found)
        raise BackendError(
            f"robot '{robot.name}' has {what}, which this engine does not simulate; use --backend mujoco"
        )
    order = {model.joint(name).id: i for i, name in enumerate(robot.joint_names)}
    data = mujoco.MjData(model)
    data.qpos[:7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    for name, angle in zip(robot.joint_names, robot.default_joint_position, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    links = tuple(_link(scene, model, data, body, order) for body in range(1, model.nbody))
    if links[0].name != robot.base_body:
        raise BackendError(f"body '{robot.base_body}' of robot '{robot.name}' must come first and carry the free joint")
    geoms = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    shapes = tuple(_shape(scene, model, geom) for geom in geoms)
    dofs = np.array([int(model.joint(name).dofadr[0]) for name in robot.joint_names])
    return RobotModel(
        links=links,
        shapes=shapes,
        meeting=frozenset((i, j) for j in range(len(geoms)) for i in range(j) if _meet(model, geoms[i], geoms[j])),
        foot_friction=float(np.mean([model.geom(name).friction[0] for name in robot.foot_geoms])),
        friction_slope=dry_friction_slope(model, dofs, scene.physics.timestep),
    )


def _link(scene: Scene, model: mujoco.MjModel, data: mujoco.MjData, body: int, order: dict[int, int]) -> Link:
    robot, joint, count = scene.robot, int(model.body_jntadr[body]), int(model.body_jntnum[body])
    name = model.body(body).name or f"body_{body}"
    hinge, axis, anchor, limits = -1, np.array([0.0, 0.0, 1.0]), np.zeros(3), (-np.inf, np.inf)
    if body > 1 and count:
        known = joint in order and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        if count > 1 or not known or model.qpos0[model.jnt_qposadr[joint]] != 0.0:
            needs = "must hang on its parent rigidly or by one hinge of joint_names with the reference angle 0"
            raise BackendError(f"body '{name}' of robot '{robot.name}' {needs}; use --backend mujoco")
        hinge, axis, anchor = order[joint], model.jnt_axis[joint].copy(), model.jnt_pos[joint].copy()
        if model.jnt_limited[joint]:
            limits = (float(model.jnt_range[joint, 0]), float(model.jnt_range[joint, 1]))
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[body])
    turn = flat.reshape(3, 3)
    return Link(
        name=name,
        parent=int(model.body_parentid[body]) - 1,
        position=model.body_pos[body].copy(),
        quaternion=model.body_quat[body].copy(),
        mass=float(model.body_mass[body]),
        center=model.body_ipos[body].copy(),
        inertia=turn @ np.diag(model.body_inertia[body]) @ turn.T,
        joint=hinge,
        axis=axis,
        anchor=anchor,
        limits=limits,
        standing=(data.xpos[body].copy(), data.xquat[body].copy()),
        collision_body=robot.collision_bodies.index(name) if name in robot.collision_bodies else -1,
    )


def _shape(scene: Scene, model: mujoco.MjModel, geom: int) -> Shape:
    robot, kind = scene.robot, _KINDS.get(mujoco.mjtGeom(int(model.geom_type[geom])))
    name = model.geom(geom).name or f"shape_{geom}"
    if kind is None:
        can = ", ".join(_KINDS.values())
        raise BackendError(f"shape '{name}' of robot '{robot.name}' is none of {can}; use --backend mujoco")
    vertices = np.zeros((0, 3))
    if kind == "mesh":
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        vertices = model.mesh_vert[first : first + count].astype(np.float64)
    return Shape(
        name=name,
        kind=kind,
        size=model.geom_size[geom].copy(),
        position=model.geom_pos[geom].copy(),
        quaternion=model.geom_quat[geom].copy(),
        link=int(model.geom_bodyid[geom]) - 1,
        friction=float(model.geom_friction[geom, 0]),
        foot=next((foot for foot, sole in enumerate(robot.soles) if name in sole), -1),
        trunk=name in robot.trunk_shapes,
        vertices=vertices,
    )


def _meet(model: mujoco.MjModel, first: int, second: int) -> bool:
    """Return whether MuJoCo lets two shapes of the robot collide."""
    a, b = int(model.geom_bodyid[first]), int(model.geom_bodyid[second])
    kinds, others = model.geom_contype, model.geom_conaffinity
    if not (kinds[first] & others[second] or kinds[second] & others[first]):
        return False
    welded, parent = model.body_weldid, model.body_parentid
    fixed = (int(welded[a]), int(welded[b]))
    above = tuple(int(welded[parent[each]]) for each in fixed)
    if fixed[0] == fixed[1] or fixed[0] == above[1] or fixed[1] == above[0]:
        return False
    signature = (min(a, b) << 16) + max(a, b)
    return signature not in {int(each) for each in model.exclude_signature}
