"""One world of PhysX: an instance of its own, so that masks and resets are exact."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import ovphysx
import ovstage
from numpy.typing import NDArray
from ovphysx.samples.python_samples.schema_support import physx_schema_paths
from ovphysx.types import TensorType

from ...terrains.base import Terrain
from ..base import Scene
from ..sequential import Base, Contact, RobotModel, World
from ..sequential.rotation import matrix
from ..sequential.world import Array
from .usd import GROUND, ROBOT, TERRAIN, joint_name, link_name, shape_path, write_world

CONTACT_SLOTS = 256
"""Contact points that a world reports at most."""
_TENSORS = {
    "pose": TensorType.ARTICULATION_ROOT_POSE,
    "velocity": TensorType.ARTICULATION_ROOT_VELOCITY,
    "joint_position": TensorType.ARTICULATION_DOF_POSITION,
    "joint_velocity": TensorType.ARTICULATION_DOF_VELOCITY,
    "torque": TensorType.ARTICULATION_DOF_ACTUATION_FORCE,
    "wrench": TensorType.ARTICULATION_LINK_WRENCH,
    "link_pose": TensorType.ARTICULATION_LINK_POSE,
    "link_velocity": TensorType.ARTICULATION_LINK_VELOCITY,
    "mass": TensorType.ARTICULATION_BODY_MASS,
    "center": TensorType.ARTICULATION_BODY_COM_POSE,
    "inertia": TensorType.ARTICULATION_BODY_INERTIA,
    "limit": TensorType.ARTICULATION_DOF_LIMIT,
    "armature": TensorType.ARTICULATION_DOF_ARMATURE,
    "joint_friction": TensorType.ARTICULATION_DOF_FRICTION_PROPERTIES,
    "material": TensorType.ARTICULATION_SHAPE_FRICTION_AND_RESTITUTION,
}
"""Tensors of the articulation. These bindings are deprecated; the sessions that follow them cost ten times the time on a CPU."""


@cache
def _prepare() -> None:
    """Set up the process: one thread, no GPU, PhysX's schemas."""
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="ovphysx")
    # a world says nothing in Newton's schema, which ovphysx would like to see
    logging.getLogger("ovphysx").addFilter(lambda record: "newton-usd-schemas" not in record.getMessage())
    ovphysx.set_global_config(ovphysx.GlobalConfigKey.NUM_THREADS, 0)
    ovphysx.PhysX.set_cpu_mode(True)
    ovstage.population.register_usd_schemas([str(path) for path in physx_schema_paths()])


def in_use() -> bool:
    """Return whether this process, or the one that it was forked from, has built worlds."""
    return bool(_prepare.cache_info().currsize)


class PhysxWorld(World):
    """See ``World``."""

    def __init__(self, scene: Scene, robot: RobotModel, terrain: Terrain) -> None:
        _prepare()
        self._robot, self._feet, self._timestep = robot, robot.feet, scene.physics.timestep
        self._physx = ovphysx.PhysX()
        self._stage = ovstage.Stage("gaitgauge")
        with TemporaryDirectory() as folder:
            path = Path(folder) / "world.usda"
            path.write_text(write_world(scene, robot, terrain), encoding="utf-8")
            population = ovstage.PopulationDomain.ALL
            ovstage.population.open_usd(self._stage, str(path), ordinal=1, domains=population)
        self._stage.advance_write_floor(ordinal=1).wait()
        self._physx.wait_task(self._physx.attach_ovstage(self._stage, read_ordinal=1))
        root = f"{ROBOT}/{link_name(0)}"
        self._bindings = {n: self._physx.create_tensor_binding(root, tensor_type=t) for n, t in _TENSORS.items()}
        self._buffers = {name: np.zeros(binding.shape, np.float32) for name, binding in self._bindings.items()}
        joints = self._bindings["joint_position"].dof_names
        names = {joint_name(i): link.joint for i, link in enumerate(robot.links)}
        # rows of PhysX's joints and links in the robot's order
        self._joint = np.argsort([names[each] for each in joints])
        links = self._bindings["link_pose"].body_names
        self._link = np.array([links.index(link_name(i)) for i in range(len(robot.links))])
        sensors = [shape_path(robot, i) for i in range(len(robot.shapes))]
        self._contact_binding = self._physx.create_contact_binding(
            sensor_patterns=sensors,
            filter_patterns=[GROUND, TERRAIN] * len(sensors),
            filters_per_sensor=2,
            max_contact_data_count=CONTACT_SLOTS,
        )
        self._sensor = [sensors.index(path) for path in self._contact_binding.sensor_paths]
        slots, pairs = (CONTACT_SLOTS, 3), (len(sensors), 2)
        self._normal_data = (
            *(np.zeros((CONTACT_SLOTS, 1), np.float32), np.zeros(slots, np.float32), np.zeros(slots, np.float32)),
            *(np.zeros((CONTACT_SLOTS, 1), np.float32), np.zeros(pairs, np.int32), np.zeros(pairs, np.int32)),
        )
        self._friction_data = (
            *(np.zeros(slots, np.float32), np.zeros(slots, np.float32)),
            *(np.zeros(pairs, np.int32), np.zeros(pairs, np.int32)),
        )
        self._physx.warmup()
        constants = scene.parameters
        friction = np.stack([constants.friction_loss, constants.friction_loss, constants.joint_damping], axis=1)
        self._write("joint_friction", self._in_physx(friction))
        self._write("armature", self._in_physx(np.asarray(constants.armature)))
        self._center = robot.links[0].center
        self._base: Base | None = None
        self._pushed = False
        self.change({})
        self._read_joints()

    def _in_physx(self, values: Array) -> Array:
        """Return joint values, (J, …), in PhysX's order, (1, J, …)."""
        ordered = np.empty_like(values)
        ordered[self._joint] = values
        return ordered[None]

    def _read(self, name: str) -> Array:
        """Return a tensor of the articulation, (rows, …)."""
        self._bindings[name].read(self._buffers[name])
        return self._buffers[name][0].astype(np.float64)

    def _write(self, name: str, values: Array) -> None:
        self._bindings[name].write(np.ascontiguousarray(values, dtype=np.float32).reshape(self._buffers[name].shape))

    def _read_joints(self) -> None:
        self._base = None
        self._joints = (self._read("joint_position")[self._joint], self._read("joint_velocity")[self._joint])

    def place(self, base: Base, joint_position: Array, joint_velocity: Array) -> None:
        """See ``World.place``."""
        turn = matrix(base.quaternion)
        spin = turn @ base.angular_velocity
        state = {
            "pose": np.concatenate([base.position, np.roll(base.quaternion, -1)]),
            "velocity": np.concatenate([base.linear_velocity + np.cross(spin, turn @ self._center), spin]),
            "joint_position": self._in_physx(joint_position),
            "joint_velocity": self._in_physx(joint_velocity),
        }
        if not all(np.isfinite(values).all() for values in state.values()):
            self._base, self._joints = base, (joint_position, joint_velocity)  # such a world is never stepped
            return
        for name, values in state.items():
            self._write(name, values)
        self._physx.update_articulations_kinematic()
        self._read_joints()

    def step(self, torque: Array, force_w: Array) -> None:
        """See ``World.step``."""
        self._write("torque", self._in_physx(torque))
        if force_w.any() or self._pushed:
            self._pushed = bool(force_w.any())
            base, wrench = self.base(), np.zeros((len(self._link), 9))
            at = base.position + matrix(base.quaternion) @ self._center
            wrench[self._link[0]] = np.concatenate([force_w, np.zeros(3), at])
            self._write("wrench", wrench)
        self._physx.step_sync(self._timestep)
        self._read_joints()

    def joints(self) -> tuple[Array, Array]:
        """See ``World.joints``."""
        return self._joints

    def base(self) -> Base:
        """See ``World.base``."""
        if self._base is None:
            pose, velocity = self._read("pose"), self._read("velocity")
            quaternion = np.roll(pose[3:], 1) / np.linalg.norm(pose[3:])
            turn, spin = matrix(quaternion), velocity[3:]
            self._base = Base(
                position=pose[:3],
                quaternion=quaternion,
                linear_velocity=velocity[:3] - np.cross(spin, turn @ self._center),
                angular_velocity=turn.T @ spin,
            )
        return self._base

    def feet(self) -> tuple[Array, Array]:
        """See ``World.feet``."""
        pose, velocity = self._read("link_pose")[self._link], self._read("link_velocity")[self._link]
        positions, velocities = [], []
        for foot in self._feet:
            turn = matrix(np.roll(pose[foot.link, 3:], 1))
            center = self._robot.links[foot.link].center
            positions.append(pose[foot.link, :3] + turn @ foot.position)
            arm = turn @ (foot.position - center)
            velocities.append(velocity[foot.link, :3] + np.cross(velocity[foot.link, 3:], arm))
        return np.array(positions), np.array(velocities)

    def contacts(self) -> list[Contact]:
        """See ``World.contacts``: points with their normal forces, then friction anchors at other places."""
        force, point, normal, separation, count, start = self._normal_data
        self._contact_binding.read_normal_contact_data(*self._normal_data)
        found = []
        for sensor, where, at in _entries(count, start):
            pressing, direction = float(force[at, 0]), normal[at].astype(np.float64)
            found.append(
                Contact(
                    shape=self._sensor[sensor],
                    terrain=where == 1,
                    point_w=point[at].astype(np.float64),
                    force_w=pressing * direction,
                    normal=pressing,
                    tangential=0.0,
                    depth=-float(separation[at, 0]),
                )
            )
        friction, anchor, count, start = self._friction_data
        self._contact_binding.read_friction_contact_data(*self._friction_data)
        for sensor, where, at in _entries(count, start):
            sliding = friction[at].astype(np.float64)
            found.append(
                Contact(
                    shape=self._sensor[sensor],
                    terrain=where == 1,
                    point_w=anchor[at].astype(np.float64),
                    force_w=sliding,
                    normal=0.0,
                    tangential=float(np.linalg.norm(sliding)),
                )
            )
        return found

    def change(self, changes: Mapping[str, Array]) -> None:
        """See ``World.change``."""
        mass, center, inertia = (np.array(values) for values in zip(*self._robot.inertias(changes), strict=True))
        self._center = center[0]
        ordered = [np.empty_like(values) for values in (mass, center, inertia)]
        for values, given in zip(ordered, (mass, center, inertia), strict=True):
            values[self._link] = given
        self._write("mass", ordered[0])
        self._write("center", np.concatenate([ordered[1], np.tile([0.0, 0.0, 0.0, 1.0], (len(mass), 1))], axis=1))
        self._write("inertia", ordered[2])
        friction = float(changes.get("friction", self._robot.foot_friction))
        material = np.zeros(self._buffers["material"].shape)
        material[..., :2] = friction
        self._write("material", material)

    def constants(self) -> dict[str, Any]:
        """See ``World.constants``."""
        chosen = [self._link[i] for i in self._robot.collision_links]
        friction = self._read("joint_friction")[self._joint]
        material = self._read("material")
        return {
            "total_mass": float(self._read("mass").sum()),
            "body_mass": self._read("mass")[chosen],
            "body_inertia": self._read("inertia").reshape(-1, 3, 3)[chosen],
            "joint_range": self._read("limit")[self._joint],
            "joint_armature": self._read("armature")[self._joint],
            "joint_friction_loss": friction[:, 0],
            "joint_damping": friction[:, 2],
            "foot_friction": np.full(len(self._feet), material[:, 0].mean()),
            "floor_friction": float(material[:, 0].mean()),
        }

    def close(self) -> None:
        """Free the instance and its stage."""
        for binding in (*self._bindings.values(), self._contact_binding):
            binding.destroy()
        self._physx.wait_task(self._physx.detach_ovstage())
        self._stage.destroy()
        self._physx.destroy()


def _entries(count: NDArray[np.int32], start: NDArray[np.int32]) -> list[tuple[int, int, int]]:
    """Return sensor, filter and slot of each entry of a flat buffer."""
    pairs = zip(*np.nonzero(count), strict=True)
    return [(int(s), int(f), int(start[s, f]) + i) for s, f in pairs for i in range(count[s, f])]
