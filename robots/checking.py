"""Compares a robot's description with its MuJoCo model. MuJoCo is imported only when a robot is checked."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from .base import Robot
from .loading import RobotError, did_you_mean

if TYPE_CHECKING:
    import mujoco

_SITE_TOLERANCE = 1e-4
"""Largest distance between a foot's site and its geom's centre [m]."""


def check_robot(robot: Robot) -> None:
    """Compile the robot's MuJoCo model and check that it has everything that the description names.

    That is: the free base, the joints with one motor each, the feet (a geom and a site at its centre), the collision
    bodies, the trunk's shapes and the imu site; that the default pose is within the joint ranges; that no foot is in the ground at
    ``stand_height``; that the model brings no ground of its own.

    Raises:
        RobotError: the first disagreement found.
    """
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    except ValueError as error:
        raise RobotError(
            f"'{robot.mjcf}' is not a model that MuJoCo can compile: {' '.join(str(error).split())}"
        ) from error
    check = _Check(robot, model)
    check.base()
    check.joints()
    check.motors()
    check.feet()
    check.bodies_and_sites()
    check.standing_pose()


class _Check:
    """The single checks, each of which raises ``RobotError``."""

    def __init__(self, robot: Robot, model: mujoco.MjModel) -> None:
        import mujoco

        self.mujoco = mujoco
        self.robot = robot
        self.model = model

    def error(self, problem: str) -> RobotError:
        return RobotError(f"robot '{self.robot.name}': {problem}")

    def require(self, names: Iterable[str], key: str, kind: str) -> list[int]:
        """Ids of named model objects (``joint``, ``body``, ``geom``, ``site``); those of ``key`` must all exist."""
        object_type = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        known = self.names(object_type)
        for name in names:
            if name not in known:
                hint = did_you_mean(name, known)
                raise self.error(f"{key} names '{name}' but {self.robot.mjcf.name} has no {kind} of that name{hint}")
        return [self.mujoco.mj_name2id(self.model, object_type, name) for name in names]

    def names(self, object_type: mujoco.mjtObj) -> list[str]:
        count = {
            self.mujoco.mjtObj.mjOBJ_JOINT: self.model.njnt,
            self.mujoco.mjtObj.mjOBJ_BODY: self.model.nbody,
            self.mujoco.mjtObj.mjOBJ_GEOM: self.model.ngeom,
            self.mujoco.mjtObj.mjOBJ_SITE: self.model.nsite,
        }[object_type]
        found = (self.mujoco.mj_id2name(self.model, object_type, i) for i in range(count))
        return [name for name in found if name is not None]

    def base(self) -> None:
        model, robot = self.model, self.robot
        (base,) = self.require([robot.base_body], "base_body", "body")
        free = [j for j in range(model.njnt) if model.jnt_type[j] == self.mujoco.mjtJoint.mjJNT_FREE]
        if [model.jnt_bodyid[j] for j in free] != [base]:
            raise self.error(f"{robot.mjcf.name} must have one free joint, on the base_body '{robot.base_body}'")
        if any(model.geom_bodyid == 0):
            raise self.error(f"{robot.mjcf.name} has geoms in its worldbody; it must hold the robot alone")

    def joints(self) -> None:
        model, robot = self.model, self.robot
        ids = self.require(robot.joint_names, "joint_names", "joint")
        for name, joint in zip(robot.joint_names, ids, strict=True):
            if model.jnt_type[joint] != self.mujoco.mjtJoint.mjJNT_HINGE:
                raise self.error(f"joint_names names '{name}', which is not a hinge in {robot.mjcf.name}")
        others = [
            self.mujoco.mj_id2name(model, self.mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint {j}"
            for j in range(model.njnt)
            if model.jnt_type[j] != self.mujoco.mjtJoint.mjJNT_FREE and j not in ids
        ]
        if others:
            raise self.error(f"{robot.mjcf.name} has the joint '{others[0]}', which joint_names lacks; add it there")
        for name, joint, angle in zip(robot.joint_names, ids, robot.default_joint_position, strict=True):
            low, high = model.jnt_range[joint]
            if model.jnt_limited[joint] and not low <= angle <= high:
                raise self.error(
                    f"default_joint_position of '{name}' is {angle:g} rad, outside its range {low:g} to {high:g} rad"
                )

    def motors(self) -> None:
        model, robot = self.model, self.robot
        ids = self.require(robot.joint_names, "joint_names", "joint")
        driven = [
            int(model.actuator_trnid[a, 0])
            for a in range(model.nu)
            if model.actuator_trntype[a] == self.mujoco.mjtTrn.mjTRN_JOINT
        ]
        for name, joint in zip(robot.joint_names, ids, strict=True):
            if driven.count(joint) != 1:
                raise self.error(f"{robot.mjcf.name} has {driven.count(joint)} actuators on '{name}'; it must have one")
        if model.nu != len(ids):
            raise self.error(
                f"{robot.mjcf.name} has {model.nu} actuators for {len(ids)} joints; it must have one for each"
            )

    def feet(self) -> None:
        model, robot = self.model, self.robot
        geoms = self.require(robot.foot_names, "foot_names", "geom")
        sites = self.require(robot.foot_names, "foot_names", "site")
        for name, geom, site in zip(robot.foot_names, geoms, sites, strict=True):
            apart = math.dist(model.geom_pos[geom], model.site_pos[site])
            if model.geom_bodyid[geom] != model.site_bodyid[site] or apart > _SITE_TOLERANCE:
                raise self.error(f"the site '{name}' must be at the centre of the foot geom '{name}', on the same body")
            if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                raise self.error(f"the foot geom '{name}' collides with nothing; give it contype or conaffinity 1")

    def bodies_and_sites(self) -> None:
        (base,) = self.require([self.robot.base_body], "base_body", "body")
        self.require(self.robot.collision_bodies, "collision_bodies", "body")
        shapes = self.require(self.robot.trunk_shapes, "trunk_shapes", "geom")
        for name, geom in zip(self.robot.trunk_shapes, shapes, strict=True):
            if self.model.geom_bodyid[geom] != base:
                raise self.error(f"trunk_shapes names '{name}', which is not on the base_body '{self.robot.base_body}'")
            if not (self.model.geom_contype[geom] or self.model.geom_conaffinity[geom]):
                raise self.error(f"the trunk shape '{name}' collides with nothing; give it contype or conaffinity 1")
        (imu,) = self.require([self.robot.imu_site], "imu_site", "site")
        if self.model.site_bodyid[imu] != base:
            raise self.error(f"imu_site '{self.robot.imu_site}' must be on the base_body '{self.robot.base_body}'")

    def standing_pose(self) -> None:
        model, robot = self.model, self.robot
        data = self.mujoco.MjData(model)
        joints = self.require(robot.joint_names, "joint_names", "joint")
        data.qpos[model.jnt_qposadr[joints]] = robot.default_joint_position
        self.mujoco.mj_kinematics(model, data)
        (base,) = self.require([robot.base_body], "base_body", "body")
        for name, geom in zip(robot.foot_names, self.require(robot.foot_names, "foot_names", "geom"), strict=True):
            # Of feet that are no balls only the centre is checked: their lowest point depends on the shape.
            is_ball = model.geom_type[geom] == self.mujoco.mjtGeom.mjGEOM_SPHERE
            reach = data.xpos[base][2] - data.geom_xpos[geom][2] + (model.geom_size[geom][0] if is_ball else 0.0)
            if reach > robot.stand_height:
                raise self.error(
                    f"at stand_height {robot.stand_height:g} m the foot '{name}' is {reach - robot.stand_height:.3f} m "
                    f"below the ground; raise it to {reach:.3f} m or more"
                )
