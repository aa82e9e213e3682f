"""An example of a third party's engine: MuJoCo's C API, one model and one data per world."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from gaitgauge.backends import Capability, Scene, Support
from gaitgauge.backends.sequential import Base, Contact, RobotModel, SequentialBackend, World
from gaitgauge.terrains.base import Terrain

Array = np.ndarray[Any, np.dtype[np.float64]]


class PlainMujocoBackend(SequentialBackend):
    """The engine: how it is named, where it is limited, and how a world is made."""

    name: ClassVar[str] = "plain-mujoco"
    family: ClassVar[str] = "MuJoCo"
    own_dry_friction: ClassVar[bool] = True  # MuJoCo's solver holds the joints' dry friction
    limits: ClassVar[Mapping[str, Capability]] = {
        name: Capability(support=Support.NONE, note=note)
        for name, note in {
            "gpu": "runs on the CPU",
            "foot_contact": "feet's contacts are the same in all worlds",
        }.items()
    }

    def build(self, terrain: int) -> World:
        """Build a world on a terrain of the palette."""
        ground = self.scene.terrains[terrain]
        return PlainWorld(build_model(self.scene, ground), self.scene, self.robot, ground)


class PlainWorld(World):
    """One robot on one terrain."""

    def __init__(self, model: mujoco.MjModel, scene: Scene, robot: RobotModel, terrain: Terrain) -> None:
        self.nominal, self.model, self.data = model, copy.copy(model), mujoco.MjData(model)
        self.robot = robot
        joints = [model.joint(name) for name in scene.robot.joint_names]
        self.at_q = np.array([joint.qposadr[0] for joint in joints])
        self.at_v = np.array([joint.dofadr[0] for joint in joints])
        ground = int((model.geom_bodyid == 0).sum())  # MuJoCo puts the world's own geoms first
        meets = [g for g in range(ground, model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
        self.shape_of = {geom: shape for shape, geom in enumerate(meets)}
        self.centers = robot.feet
        self.flat = {0} | {1 + i for i, box in enumerate(terrain.boxes) if box.wall}  # the floor and walls

    def place(self, base: Base, joint_position: Array, joint_velocity: Array) -> None:
        """Put the robot into a state."""
        mujoco.mj_resetData(self.model, self.data)
        q, v = self.data.qpos, self.data.qvel
        q[0:3], q[3:7], q[self.at_q] = base.position, base.quaternion, joint_position
        v[0:3], v[3:6], v[self.at_v] = base.linear_velocity, base.angular_velocity, joint_velocity

    def step(self, torque: Array, force_w: Array) -> None:
        """Take one physics step; raise ``RuntimeError`` where MuJoCo warns of a bad state or a full buffer."""
        self.data.qfrc_applied[self.at_v] = torque
        self.data.xfrc_applied[1, :3] = force_w
        mujoco.mj_step(self.model, self.data)
        if self.data.warning.number.any():
            raise RuntimeError("MuJoCo warned")

    def joints(self) -> tuple[Array, Array]:
        """Return joint positions and velocities."""
        return self.data.qpos[self.at_q], self.data.qvel[self.at_v]

    def base(self) -> Base:
        """Return pose and velocity of the base."""
        q, v = self.data.qpos.copy(), self.data.qvel.copy()
        return Base(position=q[0:3], quaternion=q[3:7], linear_velocity=v[0:3], angular_velocity=v[3:6])

    def feet(self) -> tuple[Array, Array]:
        """Return positions and velocities of the feet; only the kinematics are computed, so that reading changes nothing."""
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            update(self.model, self.data)
        positions, velocities, twist = [], [], np.zeros(6)
        for foot in self.centers:
            body = 1 + foot.link  # MuJoCo's body 0 is the world
            arm = self.data.xmat[body].reshape(3, 3) @ foot.position
            mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
            positions.append(self.data.xpos[body] + arm)
            velocities.append(twist[3:] + np.cross(twist[:3], arm))
        return np.array(positions), np.array(velocities)

    def contacts(self) -> list[Contact]:
        """Return the ground contacts that carry load."""
        found, local = [], np.zeros(6)
        for index, contact in enumerate(self.data.contact):
            first, second = int(contact.geom1), int(contact.geom2)
            if (first in self.shape_of) == (second in self.shape_of):
                continue  # two bodies of the robot
            mujoco.mj_contactForce(self.model, self.data, index, local)
            # MuJoCo gives the force on the second geom
            sign, mine, other = (1.0, second, first) if second in self.shape_of else (-1.0, first, second)
            turn = sign * contact.frame.reshape(3, 3).T
            found.append(
                Contact(
                    shape=self.shape_of[mine],
                    terrain=other not in self.flat,
                    point_w=contact.pos.copy(),
                    force_w=turn @ local[:3],
                    moment_w=turn @ local[3:],
                    normal=local[0],
                    tangential=float(np.hypot(local[1], local[2])),
                    depth=-contact.dist,
                )
            )
        return found

    def change(self, changes: Mapping[str, Array]) -> None:
        """Write a world's randomization into its model, from the nominal values."""
        model, nominal, scale = self.model, self.nominal, changes.get("link_mass_scale")
        model.geom_friction[:, 0] = changes.get("friction", nominal.geom_friction[:, 0])
        for body, (mass, center, _) in enumerate(self.robot.inertias(changes), start=1):
            link = self.robot.links[body - 1]
            model.body_mass[body], model.body_ipos[body] = mass, center
            if scale is not None and link.parent >= 0 and link.collision_body >= 0:
                model.body_inertia[body] = nominal.body_inertia[body] * scale[link.collision_body]
        mujoco.mj_setConst(model, mujoco.MjData(model))


def build_model(scene: Scene, terrain: Terrain) -> mujoco.MjModel:
    """Return the model of the robot on one terrain; geoms of the world body are ground."""
    robot, physics, constants = scene.robot, scene.physics, scene.parameters
    spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    for option in ("timestep", "impratio", "iterations", "ls_iterations", "tolerance"):
        setattr(spec.option, option, getattr(physics, option))
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # the motor law is not MuJoCo's, and a bad state is reported instead of being reset behind our back
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    for geom in spec.geoms:
        if geom.name in robot.foot_geoms and physics.foot_condim is not None:
            geom.condim = physics.foot_condim
        if not physics.self_collision and (geom.contype or geom.conaffinity):
            geom.contype, geom.conaffinity = 2, 1
    for j, name in enumerate(robot.joint_names):
        joint = spec.joint(name)
        joint.armature, joint.frictionloss = constants.armature[j], constants.friction_loss[j]
        joint.damping = np.array([constants.joint_damping[j], 0.0, 0.0])
    world, kinds = spec.worldbody, mujoco.mjtGeom
    world.add_geom(type=kinds.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    for box in terrain.boxes:
        world.add_geom(type=kinds.mjGEOM_BOX, size=box.half_size, pos=box.center, quat=box.quaternion)
    if terrain.height_field is not None:
        field = terrain.height_field
        top = max(float(field.heights.max()), 1e-6)
        rows, columns = field.heights.shape
        size = np.array([*field.half_size, top, field.base])
        spec.add_hfield(name="field", nrow=rows, ncol=columns, size=size, userdata=field.heights.ravel())
        world.add_geom(type=kinds.mjGEOM_HFIELD, hfieldname="field", pos=[*field.center, 0.0])
    model = spec.compile()
    if terrain.height_field is not None:
        model.hfield_data[:] = (field.heights / top).ravel()  # again: the compiler normalizes them
    return model
