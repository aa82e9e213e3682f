"""Build a Drake plant of the robot on one terrain."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Capsule,
    CollisionFilterDeclaration,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    GeometrySet,
    HalfSpace,
    InMemoryMesh,
    Mesh,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, RigidBody, SpatialInertia, UnitInertia
from pydrake.systems.framework import Diagram, DiagramBuilder

from ...terrains.base import Terrain
from ..base import Scene
from ..sequential import RobotModel, Shape
from .hydroelastic import FOOT_RESOLUTION, RESOLUTION, field_mesh, modulus, thickness

APPROXIMATION = "sap"
"""Drake's convex approximation of contact; friction of ``lagged``, its default, acts with the normal force of the step before."""
RELAXATION = 1.0
"""Relaxation time of a shape's contacts over the timestep. The approximation lifts what slides by relaxation time times friction
times speed: with Drake's default of 0.1 s a foot that slips at 0.1 m/s floats 6 mm high."""

# Drake says of each floor that soft bodies would not meet it; there are none.
logging.getLogger("drake").addFilter(lambda record: "deformable" not in record.getMessage())


@dataclass(frozen=True, kw_only=True, eq=False)
class Plant:
    """A compiled diagram; worlds are contexts of it."""

    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    bodies: list[RigidBody]
    """Of the robot's links, in their order."""
    joint_q: np.ndarray
    """Place of each joint in Drake's positions, (J,)."""
    joint_v: np.ndarray
    """Place of each joint in Drake's velocities, (J,)."""
    shape_of: dict[GeometryId, int]
    """Robot's shape of a geometry."""
    terrain: dict[GeometryId, bool]
    """Geometries of the ground: True for boxes and the height field, False for floor and walls."""
    properties: dict[GeometryId, ProximityProperties] = field(default_factory=dict)
    """Of all collision geometries."""


def pose(position: Any, quaternion: Any) -> RigidTransform:
    """Return a transform from a position [m] and a quaternion wxyz of any length."""
    wxyz = np.asarray(quaternion, dtype=np.float64)
    return RigidTransform(Quaternion(wxyz / np.linalg.norm(wxyz)), np.asarray(position, dtype=np.float64))


def spatial_inertia(mass: float, center: np.ndarray, inertia: np.ndarray) -> SpatialInertia:
    """Return the inertia of a link from mass [kg], centre [m] and central inertia [kg·m²]."""
    if mass == 0.0:
        return SpatialInertia.Zero()
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia / mass
    central = UnitInertia(xx, yy, zz, xy, xz, yz)
    about_origin = central.ShiftFromCenterOfMass(-center)
    return SpatialInertia(mass, center, about_origin)


def build_plant(scene: Scene, robot: RobotModel, terrain: Terrain) -> Plant:
    """Return the diagram of the robot on a terrain.

    Spheres of feet have point contacts on boxes and planes. The other shapes touch by faces and edges, where Drake's point
    contact has a single point; their contacts are hydroelastic, the ground rigid and the robot compliant. So are those of spheres
    on a terrain with a height field, because Drake's point contact takes the field's convex hull.
    """
    on_field = terrain.height_field is not None
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=scene.physics.timestep,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation=APPROXIMATION,
    )
    plant, scene_graph = AddMultibodyPlant(config, builder)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -9.81])
    bodies, joints = _add_links(scene, robot, plant)
    found: dict[GeometryId, ProximityProperties] = {}

    def register(body: RigidBody, name: str, place: RigidTransform, shape: Any, of_robot: Shape | None) -> GeometryId:
        properties = ProximityProperties()
        AddContactMaterial(properties, friction=CoulombFriction(robot.foot_friction, robot.foot_friction))
        properties.AddProperty("material", "relaxation_time", RELAXATION * scene.physics.timestep)
        if of_robot is None:
            AddRigidHydroelasticProperties(1.0, properties)
        elif on_field or of_robot.foot < 0 or of_robot.kind != "sphere":
            edge = FOOT_RESOLUTION if of_robot.foot >= 0 and of_robot.kind == "sphere" else RESOLUTION
            AddCompliantHydroelasticProperties(edge * thickness(of_robot), modulus(of_robot), properties)
        geometry = plant.RegisterCollisionGeometry(body, place, shape, name, properties)
        found[geometry] = properties
        return geometry

    shape_of = {}
    for index, shape in enumerate(robot.shapes):
        place = pose(shape.position, shape.quaternion)
        shape_of[register(bodies[shape.link], shape.name, place, _drake_shape(shape), shape)] = index
    ground = {register(plant.world_body(), "floor", RigidTransform(), HalfSpace(), None): False}
    for number, box in enumerate(terrain.boxes):
        size = Box(*(2.0 * np.asarray(box.half_size)))
        place = pose(box.center, box.quaternion)
        ground[register(plant.world_body(), f"box_{number}", place, size, None)] = not box.wall
    if terrain.height_field is not None:
        field = Mesh(InMemoryMesh(mesh_file=MemoryFile(field_mesh(terrain.height_field), ".obj", "field.obj")))
        ground[register(plant.world_body(), "field", RigidTransform(), field, None)] = True
    plant.Finalize()
    _filter(scene_graph, robot, list(shape_of))
    diagram = builder.Build()
    return Plant(
        diagram=diagram,
        plant=plant,
        scene_graph=scene_graph,
        bodies=bodies,
        joint_q=np.array([joint.position_start() for joint in joints]),
        joint_v=np.array([joint.velocity_start() for joint in joints]),
        shape_of=shape_of,
        terrain=ground,
        properties=found,
    )


def _add_links(scene: Scene, robot: RobotModel, plant: MultibodyPlant) -> tuple[list[RigidBody], list[RevoluteJoint]]:
    """Add bodies and joints; return the bodies by link and the joints in the robot's order."""
    constants = scene.parameters
    bodies: list[RigidBody] = []
    joints: dict[int, RevoluteJoint] = {}
    for link in robot.links:
        body = plant.AddRigidBody(link.name, spatial_inertia(link.mass, link.center, link.inertia))
        bodies.append(body)
        if link.parent < 0:
            continue
        above, place = bodies[link.parent], pose(link.position, link.quaternion)
        if link.joint < 0:
            plant.WeldFrames(above.body_frame(), body.body_frame(), place)
            continue
        name, at_anchor = scene.robot.joint_names[link.joint], RigidTransform(link.anchor)
        joint = plant.AddJoint(
            RevoluteJoint(
                name=name,
                frame_on_parent=_offset(plant, f"{name}_parent", above, place @ at_anchor),
                frame_on_child=_offset(plant, f"{name}_child", body, at_anchor),
                axis=link.axis,
                pos_lower_limit=link.limits[0],
                pos_upper_limit=link.limits[1],
                damping=constants.joint_damping[link.joint],
            )
        )
        actuator = plant.AddJointActuator(name, joint)
        actuator.set_default_rotor_inertia(constants.armature[link.joint])
        actuator.set_default_gear_ratio(1.0)
        joints[link.joint] = joint
    return bodies, [joints[index] for index in sorted(joints)]


def _offset(plant: MultibodyPlant, name: str, body: RigidBody, place: RigidTransform) -> Any:
    """Return a frame at a fixed place in a body."""
    return plant.AddFrame(FixedOffsetFrame(name, body.body_frame(), place))


def _drake_shape(shape: Shape) -> Any:
    """Return Drake's shape."""
    a, b, c = shape.size
    match shape.kind:
        case "sphere":
            return Sphere(a)
        case "capsule":
            return Capsule(a, 2.0 * b)
        case "cylinder":
            return Cylinder(a, 2.0 * b)
        case "ellipsoid":
            return Ellipsoid(a, b, c)
        case "box":
            return Box(2.0 * a, 2.0 * b, 2.0 * c)
    return Convex(shape.vertices.T, shape.name)


def _filter(scene_graph: SceneGraph, robot: RobotModel, geometries: list[GeometryId]) -> None:
    """Let the robot's shapes collide in the pairs in which MuJoCo's do, and in no others."""
    declaration = CollisionFilterDeclaration()
    manager = scene_graph.collision_filter_manager()
    manager.Apply(declaration.ExcludeWithin(GeometrySet(geometries)))
    declaration = CollisionFilterDeclaration()
    for first, second in robot.meeting:
        declaration.AllowBetween(GeometrySet(geometries[first]), GeometrySet(geometries[second]))
    manager.Apply(declaration)
