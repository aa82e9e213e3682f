"""The expected motion: plain MuJoCo (C) on the robot's own file, one world, one loop, the motor law written out.

The reference shares no code with the engines of this package, on purpose.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...robots.base import JointParameters, Robot
from ..base import PhysicsOptions

GRAVITY = 9.81
"""Acceleration of free fall [m/s²]; the contract's worlds have no other."""

Array = NDArray[np.float64]


class Reference:
    """One robot under gravity, in empty space or, with ``ground``, over a plane with those contact options."""

    def __init__(
        self,
        robot: Robot,
        parameters: JointParameters,
        *,
        timestep: float = 0.002,
        ground: PhysicsOptions | None = None,
    ) -> None:
        spec = mujoco.MjSpec.from_file(str(robot.mjcf))
        spec.option.timestep = timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        if ground is not None:
            _add_ground(spec, robot, ground)
        self.model = spec.compile()
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        if ground is None:
            self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.data = mujoco.MjData(self.model)
        self.robot, self.parameters = robot, parameters
        joints = [self.model.joint(name) for name in robot.joint_names]
        self.at_position = np.array([j.qposadr[0] for j in joints])
        self.at_velocity = np.array([j.dofadr[0] for j in joints])
        self.joint_range = np.array([j.range for j in joints])
        self.model.dof_armature[self.at_velocity] = parameters.armature
        self.model.dof_damping[self.at_velocity] = parameters.joint_damping
        self.model.dof_frictionloss[self.at_velocity] = parameters.friction_loss
        self.base = self.model.body(robot.base_body).id
        self.bodies = np.array([self.model.body(name).id for name in robot.collision_bodies])
        self.soles = [[self.model.geom(name).id for name in sole] for sole in robot.soles]
        self.feet = np.array([geom for sole in self.soles for geom in sole])
        self.foot_radius = float(self.model.geom_size[self.feet[0], 0])
        self.torque = np.zeros(robot.num_joints)
        self.force_w = np.zeros(3)
        mujoco.mj_setConst(self.model, self.data)

    @property
    def mass(self) -> float:
        """Return the mass of the robot [kg]."""
        return float(self.model.body_mass.sum())

    def change(
        self,
        *,
        base_mass: float = 0.0,
        base_com: ArrayLike = (0.0, 0.0, 0.0),
        link_scale: ArrayLike = 1.0,
        foot_torsion: float = 1.0,
        foot_softness: float = 1.0,
    ) -> None:
        """Change the model as ``Randomization`` says; ``link_scale`` is (B,), its entry for the base is ignored."""
        self.model.geom_friction[self.feet, 1:] *= foot_torsion
        self.model.geom_solref[self.feet, 0] *= foot_softness
        scale = np.broadcast_to(np.asarray(link_scale, dtype=np.float64), self.bodies.shape)
        for body, factor in zip(self.bodies, scale, strict=True):
            if body != self.base:
                self.model.body_mass[body] *= factor
                self.model.body_inertia[body] *= factor
        self.model.body_mass[self.base] += base_mass
        self.model.body_ipos[self.base] += np.asarray(base_com)
        mujoco.mj_setConst(self.model, self.data)

    def place(
        self,
        base_position: ArrayLike = (0.0, 0.0, 1.0),
        base_quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        joint_position: ArrayLike | None = None,
        *,
        base_linear_velocity: ArrayLike = (0.0, 0.0, 0.0),
        base_angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
        joint_velocity: ArrayLike | float = 0.0,
    ) -> None:
        """Put the robot into a state: linear velocity in the world frame, angular velocity in the body frame."""
        mujoco.mj_resetData(self.model, self.data)
        qpos, qvel = self.data.qpos, self.data.qvel
        qpos[0:3], qpos[3:7] = base_position, base_quaternion
        qpos[self.at_position] = self.robot.default_joint_position if joint_position is None else joint_position
        # MuJoCo's free joint: velocity of the body's origin in the world frame, angular velocity in the body frame
        qvel[0:3], qvel[3:6] = base_linear_velocity, base_angular_velocity
        qvel[self.at_velocity] = joint_velocity
        mujoco.mj_forward(self.model, self.data)

    def step(self, target: ArrayLike | None = None, *, substeps: int = 1, finer: int = 1) -> None:
        """Integrate with the motor law evaluated at the start of each substep of ``finer`` steps; None leaves the motors limp."""
        kp, kd = np.asarray(self.parameters.stiffness), np.asarray(self.parameters.damping)
        for _ in range(substeps):
            if target is not None:
                q, qd = self.data.qpos[self.at_position], self.data.qvel[self.at_velocity]
                by_velocity = np.array(self.robot.driven_by_velocity)
                self.torque = np.where(by_velocity, kd * np.asarray(target), kp * (np.asarray(target) - q)) - kd * qd
            else:
                self.torque = np.zeros(self.robot.num_joints)
            self.data.qfrc_applied[self.at_velocity] = self.torque
            self.data.xfrc_applied[self.base, :3] = self.force_w
            mujoco.mj_step(self.model, self.data, finer)
        mujoco.mj_forward(self.model, self.data)

    @property
    def base_position(self) -> Array:
        """Return the position of the base [m], (3,)."""
        return self.data.qpos[0:3].copy()

    @property
    def base_quaternion(self) -> Array:
        """Return the orientation of the base, wxyz, (4,)."""
        return self.data.qpos[3:7].copy()

    @property
    def base_angular_velocity(self) -> Array:
        """Return the angular velocity of the base, body frame [rad/s], (3,)."""
        return self.data.qvel[3:6].copy()

    @property
    def joint_position(self) -> Array:
        """Return the joint positions [rad], (J,)."""
        return self.data.qpos[self.at_position]

    @property
    def joint_velocity(self) -> Array:
        """Return the joint velocities [rad/s], (J,)."""
        return self.data.qvel[self.at_velocity]

    @property
    def foot_position(self) -> Array:
        """Return the centres of the feet, the means of their geoms' centres, world frame [m], (F, 3)."""
        return np.array([self.data.geom_xpos[sole].mean(axis=0) for sole in self.soles])

    @property
    def foot_jacobian(self) -> Array:
        """Return the Jacobian of the foot centres, world frame, by the model's degrees of freedom, (F, 3, V)."""
        jacobian = np.zeros((len(self.soles), 3, self.model.nv))
        for of_foot, point, sole in zip(jacobian, self.foot_position, self.soles, strict=True):
            mujoco.mj_jac(self.model, self.data, of_foot, None, point, int(self.model.geom_bodyid[sole[0]]))
        return jacobian

    @property
    def foot_velocity(self) -> Array:
        """Return the velocities of the foot centres, world frame [m/s], (F, 3)."""
        return self.foot_jacobian @ self.data.qvel

    @property
    def foot_force(self) -> Array:
        """Return the magnitude of all contact forces on each foot [N], (F,)."""
        force = np.zeros((len(self.soles), 3))
        for i, contact in enumerate(self.data.contact[: self.data.ncon]):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            for foot, sole in enumerate(self.soles):
                if set(sole) & {int(geom) for geom in contact.geom}:
                    force[foot] += contact.frame.reshape(3, 3).T @ wrench[:3]
        return np.linalg.norm(force, axis=1)

    @property
    def center_of_mass(self) -> Array:
        """Return the centre of mass of the whole robot, world frame [m], (3,)."""
        return self.data.subtree_com[self.base].copy()

    @property
    def center_of_mass_velocity(self) -> Array:
        """Return the velocity of the centre of mass of the whole robot, world frame [m/s], (3,)."""
        mujoco.mj_subtreeVel(self.model, self.data)
        return self.data.subtree_linvel[self.base].copy()


def _add_ground(spec: mujoco.MjSpec, robot: Robot, physics: PhysicsOptions) -> None:
    """Add a plane and a solver that iterates until it has converged."""
    for geom in spec.geoms:
        if geom.name in robot.foot_geoms and physics.foot_condim is not None:
            geom.condim = physics.foot_condim
        if not physics.self_collision and (geom.contype or geom.conaffinity):
            geom.contype, geom.conaffinity = 0, 1
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    option, pyramidal = spec.option, physics.cone == "pyramidal"
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL if pyramidal else mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio, option.solver = physics.impratio, mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations, option.ls_iterations, option.tolerance = 200, 100, 1e-10


@dataclass(frozen=True, kw_only=True)
class Stance:
    """The base pose in which all feet of the default joint position touch level ground at height 0."""

    height: float
    """Height of the base origin [m]."""
    quaternion: Array
    """Orientation, wxyz."""


def level_stance(reference: Reference, *, clearance: float = 0.0005) -> Stance:
    """Turn the base so that the plane through the foot centres is level, the lowest foot ``clearance`` [m] above the ground."""
    reference.place((0.0, 0.0, 0.0))
    feet = reference.foot_position
    slope_x, slope_y, _ = np.linalg.lstsq(np.c_[feet[:, :2], np.ones(len(feet))], feet[:, 2], rcond=None)[0]
    normal = np.array([-slope_x, -slope_y, 1.0])
    normal /= np.linalg.norm(normal)
    # the shortest turn that brings the feet's normal upright
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    quaternion = axis_angle(axis, float(np.arctan2(np.linalg.norm(axis), normal[2])))
    lowest = min(float(rotated(quaternion, foot)[2]) for foot in feet)
    return Stance(height=reference.foot_radius - lowest + clearance, quaternion=quaternion)


def axis_angle(axis: ArrayLike, angle: float) -> Array:
    """Return the quaternion wxyz of a turn by ``angle`` [rad] about ``axis`` (any length; zero for no turn)."""
    direction = np.asarray(axis, dtype=np.float64)
    length = np.linalg.norm(direction)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    if length > 1e-12:
        mujoco.mju_axisAngle2Quat(quaternion, direction / length, angle)
    return quaternion


def composed(*quaternions: ArrayLike) -> Array:
    """Return the product of quaternions wxyz; the leftmost turn is the outermost."""
    product = np.array([1.0, 0.0, 0.0, 0.0])
    for quaternion in quaternions:
        mujoco.mju_mulQuat(product, product.copy(), np.asarray(quaternion, dtype=np.float64))
    return product


def rotated(quaternion: ArrayLike, vector: ArrayLike) -> Array:
    """Turn a vector from the body frame into the world frame."""
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, np.asarray(vector, dtype=np.float64), np.asarray(quaternion, dtype=np.float64))
    return result


def angle_between(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the angle of the turn between pairs of quaternions (N, 4) [rad], (N,)."""
    a, b = np.asarray(first), np.asarray(second)
    a, b = a / np.linalg.norm(a, axis=-1, keepdims=True), b / np.linalg.norm(b, axis=-1, keepdims=True)
    # 4 atan2(|a-b|, |a+b|) keeps its precision at small angles, where arccos loses it
    angle = 4.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return np.minimum(angle, 4.0 * np.arctan2(np.linalg.norm(a + b, axis=-1), np.linalg.norm(a - b, axis=-1)))
