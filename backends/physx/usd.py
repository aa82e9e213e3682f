"""Write a robot on a terrain as a USD text with the schemas of UsdPhysics and PhysX."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ...terrains.base import Box, HeightField, Terrain
from ..base import Scene
from ..sequential import RobotModel, Shape
from ..sequential.rotation import composed, matrix
from ..sequential.world import Array

ROBOT, GROUND, TERRAIN = "/World/robot", "/World/ground", "/World/terrain"
POSITION_ITERATIONS, VELOCITY_ITERATIONS = 16, 1
"""Of the solver, in each physics step."""
SCENE_SETTINGS: Mapping[str, str | bool | float | int] = {
    "physxScene:solverType": "TGS",
    "physxScene:broadphaseType": "MBP",
    "physxScene:enableGPUDynamics": False,
    "physxScene:enableCCD": False,
    "physxScene:enableStabilization": False,
    "physxScene:enableEnhancedDeterminism": True,
    "physxScene:disableSleeping": True,
    "physxScene:bounceThreshold": 0.2,
}
BODY_SETTINGS: Mapping[str, str | bool | float | int] = {
    "physxRigidBody:linearDamping": 0.0,
    "physxRigidBody:angularDamping": 0.0,
    "physxRigidBody:maxLinearVelocity": 1e4,
    "physxRigidBody:maxAngularVelocity": 1e6,
    "physxRigidBody:maxDepenetrationVelocity": 3.0,
    "physxRigidBody:enableGyroscopicForces": True,
}
"""PhysX damps turns, limits speeds and throws apart what overlaps unless it is told otherwise."""
CONTACT_OFFSET = 0.005
"""Distance at which PhysX begins to look at a pair of shapes, for each of the two [m]."""
_NUMBERS = {bool: "bool", int: "int", float: "float", str: "uniform token"}


class UsdText:
    """A USD text under construction."""

    def __init__(self) -> None:
        self._lines = ["#usda 1.0", "(", '    defaultPrim = "World"', "    metersPerUnit = 1", '    upAxis = "Z"', ")"]
        self._depth = 0

    def __str__(self) -> str:
        return "\n".join(self._lines) + "\n"

    def open(self, kind: str, name: str, *schemas: str) -> None:
        """Begin a prim."""
        applied = ", ".join(f'"{schema}"' for schema in schemas)
        self._add(f'def {kind} "{name}"' + (f" (prepend apiSchemas = [{applied}])" if schemas else ""))
        self._add("{")
        self._depth += 1

    def close(self) -> None:
        """End a prim."""
        self._depth -= 1
        self._add("}")

    def set(self, **values: str) -> None:
        """Write attributes by name, each with its type and value as text; a double underscore stands for a colon."""
        for name, value in values.items():
            kind, _, text = value.partition("|")
            self._add(f"{kind} {name.replace('__', ':')} = {text}")

    def settings(self, values: Mapping[str, str | bool | float | int]) -> None:
        """Write attributes; the type of each follows from its value."""
        for name, value in values.items():
            text = (
                f'"{value}"' if isinstance(value, str) else str(int(value)) if isinstance(value, bool) else repr(value)
            )
            self._add(f"{_NUMBERS[type(value)]} {name} = {text}")

    def place(
        self, position: Iterable[float], quaternion: Iterable[float], scale: Iterable[float] | None = None
    ) -> None:
        """Write the pose in the parent, quaternion wxyz, and the scale."""
        order = ["translate", "orient"] + ([] if scale is None else ["scale"])
        self.set(xformOp__translate=f"double3|{_tuple(position)}", xformOp__orient=f"quatd|{_tuple(quaternion)}")
        if scale is not None:
            self.set(xformOp__scale=f"double3|{_tuple(scale)}")
        self.set(xformOpOrder="uniform token[]|[" + ", ".join(f'"xformOp:{each}"' for each in order) + "]")

    def _add(self, line: str) -> None:
        self._lines.append("    " * self._depth + line)


def write_world(scene: Scene, robot: RobotModel, terrain: Terrain) -> str:
    """Return the text of one world. Links stand in the default pose, which lies within their joints' limits."""
    usd = UsdText()
    usd.open("Xform", "World")
    usd.open("PhysicsScene", "scene", "PhysxSceneAPI")
    usd.set(physics__gravityDirection="vector3f|(0, 0, -1)", physics__gravityMagnitude="float|9.81")
    usd.settings(SCENE_SETTINGS)
    usd.close()
    # the ground's coefficient is 1 and multiplies, so that the robot's own acts in every contact
    for name, friction, combine in (
        ("ground_material", 1.0, "multiply"),
        ("robot_material", robot.foot_friction, "average"),
    ):
        usd.open("Material", name, "PhysicsMaterialAPI", "PhysxMaterialAPI")
        for kind in ("staticFriction", "dynamicFriction"):
            usd.settings({f"physics:{kind}": friction})
        usd.settings({"physics:restitution": 0.0, "physxMaterial:frictionCombineMode": combine})
        usd.close()
    _ground(usd, terrain)
    _robot(usd, scene, robot)
    usd.close()
    return str(usd)


def _ground(usd: UsdText, terrain: Terrain) -> None:
    """Write floor and walls as one body, boxes and height field as another, so that contacts tell the two apart."""
    for name, boxes, field in (
        ("ground", [box for box in terrain.boxes if box.wall], None),
        ("terrain", [box for box in terrain.boxes if not box.wall], terrain.height_field),
    ):
        usd.open("Xform", name, "PhysicsRigidBodyAPI")
        usd.set(physics__kinematicEnabled="bool|1")
        if name == "ground":
            usd.open("Plane", "floor", *_COLLIDER)
            usd.set(axis='uniform token|"Z"')
            _collider(usd, "ground_material")
            usd.close()
        for number, box in enumerate(boxes):
            _box(usd, f"box_{number}", box)
        if field is not None:
            _field(usd, field)
        usd.close()


_COLLIDER = ("PhysicsCollisionAPI", "PhysxCollisionAPI", "MaterialBindingAPI")


def _collider(usd: UsdText, material: str) -> None:
    usd.settings({"physxCollision:contactOffset": CONTACT_OFFSET, "physxCollision:restOffset": 0.0})
    usd.set(material__binding__physics=f"rel|</World/{material}>")


def _box(usd: UsdText, name: str, box: Box) -> None:
    usd.open("Cube", name, *_COLLIDER)
    usd.set(size="double|2")
    usd.place(box.center, box.quaternion, box.half_size)
    _collider(usd, "ground_material")
    usd.close()


def _field(usd: UsdText, field: HeightField) -> None:
    """Write a height field's top as a triangle mesh, cut along MuJoCo's diagonals."""
    rows, columns = field.heights.shape
    x = field.center[0] + np.linspace(-field.half_size[0], field.half_size[0], columns)
    y = field.center[1] + np.linspace(-field.half_size[1], field.half_size[1], rows)
    grid_x, grid_y = np.meshgrid(x, y)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    _mesh(
        usd,
        "field",
        np.stack([grid_x, grid_y, field.heights], axis=-1).reshape(-1, 3),
        np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]),
        approximation="none",
    )
    _collider(usd, "ground_material")
    usd.close()


def _mesh(usd: UsdText, name: str, points: Array, faces: Array, *schemas: str, approximation: str) -> None:
    """Begin a mesh collider; the caller ends it."""
    usd.open("Mesh", name, *_COLLIDER, "PhysicsMeshCollisionAPI", *schemas)
    usd.set(
        points="point3f[]|[" + ", ".join(map(_tuple, points)) + "]",
        faceVertexCounts="int[]|[" + ", ".join(["3"] * len(faces)) + "]",
        faceVertexIndices="int[]|[" + ", ".join(str(i) for i in faces.ravel()) + "]",
        physics__approximation=f'uniform token|"{approximation}"',
    )


def _robot(usd: UsdText, scene: Scene, robot: RobotModel) -> None:
    usd.open("Xform", "robot")
    for index, link in enumerate(robot.links):
        position, quaternion = link.standing
        root = ("PhysicsArticulationRootAPI", "PhysxArticulationAPI") if link.parent < 0 else ()
        schemas = ("PhysicsRigidBodyAPI", "PhysxRigidBodyAPI", "PhysicsMassAPI", "PhysxContactReportAPI", *root)
        usd.open("Xform", link_name(index), *schemas)
        usd.place(np.add(position, (0.0, 0.0, 10.0)), quaternion)
        usd.settings({**BODY_SETTINGS, "physics:mass": link.mass, "physxContactReport:threshold": 0.0})
        usd.set(
            physics__centerOfMass=f"point3f|{_tuple(link.center)}", physics__diagonalInertia="float3|(0.1, 0.1, 0.1)"
        )
        if root:
            usd.settings(
                {
                    "physxArticulation:enabledSelfCollisions": bool(robot.meeting),
                    "physxArticulation:solverPositionIterationCount": POSITION_ITERATIONS,
                    "physxArticulation:solverVelocityIterationCount": VELOCITY_ITERATIONS,
                    "physxArticulation:sleepThreshold": 0.0,
                    "physxArticulation:stabilizationThreshold": 0.0,
                }
            )
        for number, shape in enumerate(robot.shapes):
            if shape.link == index:
                _shape(usd, number, shape, _apart(robot, number))
        usd.close()
    for index, link in enumerate(robot.links):
        if link.parent >= 0:
            angle = 0.0 if link.joint < 0 else scene.robot.default_joint_position[link.joint]
            _joint(usd, robot, index, angle)
    usd.close()


def link_name(index: int) -> str:
    """Return the name of a link's prim, which a robot's file cannot break."""
    return f"link_{index}"


def joint_name(index: int) -> str:
    """Return the name of the joint that carries a link."""
    return f"joint_{index}"


def shape_path(robot: RobotModel, number: int) -> str:
    """Return the path of a shape's prim."""
    return f"{ROBOT}/{link_name(robot.shapes[number].link)}/shape_{number}"


def _apart(robot: RobotModel, number: int) -> list[str]:
    """Return paths of the later shapes that a shape must not meet, though PhysX would let it."""
    if not robot.meeting:
        return []
    links = robot.links
    mine, found = robot.shapes[number].link, []
    for other in range(number + 1, len(robot.shapes)):
        theirs = robot.shapes[other].link
        jointed = mine == theirs or links[mine].parent == theirs or links[theirs].parent == mine
        if not jointed and (number, other) not in robot.meeting:
            found.append(shape_path(robot, other))
    return found


def _shape(usd: UsdText, number: int, shape: Shape, apart: list[str]) -> None:
    extra = ("PhysxContactReportAPI", *(("PhysicsFilteredPairsAPI",) if apart else ()))
    name, (a, b, c) = f"shape_{number}", shape.size
    scale = None
    if shape.kind in ("mesh", "ellipsoid"):
        from scipy.spatial import ConvexHull

        points = shape.vertices if shape.kind == "mesh" else _unit_sphere() * shape.size
        _mesh(usd, name, points, ConvexHull(points).simplices, *extra, approximation="convexHull")
    else:
        usd.open({"box": "Cube"}.get(shape.kind, shape.kind.capitalize()), name, *_COLLIDER, *extra)
        if shape.kind == "box":
            scale = (a, b, c)
            usd.set(size="double|2")
        else:
            usd.set(radius=f"double|{a:.9g}")
        if shape.kind in ("cylinder", "capsule"):
            usd.set(axis='uniform token|"Z"', height=f"double|{2.0 * b:.9g}")
    usd.place(shape.position, shape.quaternion, scale)
    usd.settings({"physxContactReport:threshold": 0.0})
    _collider(usd, "robot_material")
    if apart:
        usd.set(physics__filteredPairs="rel|[" + ", ".join(f"<{path}>" for path in apart) + "]")
    usd.close()


def _joint(usd: UsdText, robot: RobotModel, index: int, angle: float) -> None:
    """Write the joint of a link at an angle [rad]; PhysX turns about the x axis of the joint's own frame."""
    link = robot.links[index]
    hinged = link.joint >= 0
    usd.open(
        "PhysicsRevoluteJoint" if hinged else "PhysicsFixedJoint",
        joint_name(index),
        *(("PhysicsJointStateAPI:angular",) if hinged else ()),
    )
    frame = _from_x(link.axis)
    usd.set(
        physics__body0=f"rel|<{ROBOT}/{link_name(link.parent)}>",
        physics__body1=f"rel|<{ROBOT}/{link_name(index)}>",
        physics__localPos0=f"point3f|{_tuple(link.position + matrix(link.quaternion) @ link.anchor)}",
        physics__localRot0=f"quatf|{_tuple(composed(link.quaternion, frame))}",
        physics__localPos1=f"point3f|{_tuple(link.anchor)}",
        physics__localRot1=f"quatf|{_tuple(frame)}",
    )
    if hinged:
        usd.set(physics__axis='uniform token|"X"')
        usd.settings({"state:angular:physics:position": float(np.degrees(angle))})
        if np.isfinite(link.limits).all():
            lower, upper = np.degrees(link.limits)
            usd.settings({"physics:lowerLimit": float(lower), "physics:upperLimit": float(upper)})
    usd.close()


def _unit_sphere() -> Array:
    """Return points on a sphere of radius 1, (60, 3)."""
    count = np.arange(60) + 0.5
    up, turn = 1.0 - 2.0 * count / 60, np.pi * (1.0 + 5.0**0.5) * count
    level = np.sqrt(1.0 - up**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), up], axis=1)


def _from_x(axis: Array) -> Array:
    """Return the shortest turn, wxyz, of the x axis to a unit axis."""
    if axis[0] < -0.999999:
        return np.array([0.0, 0.0, 0.0, 1.0])
    turn = np.array([1.0 + axis[0], 0.0, -axis[2], axis[1]])
    return turn / np.linalg.norm(turn)


def _tuple(values: Any) -> str:
    return "(" + ", ".join(f"{float(value):.9g}" for value in values) + ")"
