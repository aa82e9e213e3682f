"""Compare a robot's description with its MuJoCo model. MuJoCo is imported only when a robot is checked."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ...files.parsing import did_you_mean, one_line
from ..base import Robot
from ..loading import MOST_PARTS, RobotError, robot_digest
from ..physical import physical_spec
from .apart import run_apart

if TYPE_CHECKING:
    import mujoco

DEPTH_TOLERANCE = 1e-3
"""Largest depth of a placed robot in the ground, and of its parts in each other [m]."""
_GRAVITY = (0.0, 0.0, -9.81)
_COUNTS = {"joint": "njnt", "body": "nbody", "geom": "ngeom", "site": "nsite"}
_checked: set[str] = set()
"""Digests of the robots that this process has found sound."""


def check_robot(robot: Robot, *, foreign: bool = False) -> None:
    """Compile the robot's MuJoCo model and check that it has everything that the description names and nothing that carries it.

    The model needs: a free base and nothing outside it; no welds, forces or options that take weight off the robot; the joints
    with one motor each or no motors; the feet's geoms; collision bodies and trunk shapes that meet the ground; the imu site; a
    default pose within the joint ranges; nothing in the ground at ``stand_height``. A process checks unchanged files once.

    Args:
        foreign: compile and check the robot in a process of its own, with limits of time and memory.

    Raises:
        RobotError: the first disagreement found.
    """
    digest = robot_digest(robot)
    if digest in _checked:
        return
    if foreign:
        run_apart(partial(_inspect, robot), robot.mjcf)
    else:
        _inspect(robot)
    _checked.add(digest)


def _inspect(robot: Robot) -> None:
    """Compile and check in this process."""
    checks = ModelChecks(robot)
    for name in ModelChecks.ORDER:
        getattr(checks, name)()


def compiled(mjcf: Path, *, whole: bool = False) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Compile a MuJoCo model's file, without its visual meshes unless ``whole``; raise ``RobotError`` where MuJoCo cannot."""
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(mjcf)) if whole else physical_spec(mjcf)
        return spec, spec.compile()
    except (ValueError, RuntimeError, TypeError, MemoryError, OSError, mujoco.FatalError) as error:
        if isinstance(error, RobotError):
            raise
        reason = one_line(error)
        if "unknown exception" in reason or "allocate memory" in reason:  # MuJoCo's only words for a lack of memory
            reason = "it may need more memory than there is, or than it may use; make it smaller"
        raise RobotError(f"'{one_line(mjcf)}' is not a model that MuJoCo can compile: {reason}") from error


def solid(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom meets the ground, which has contype and conaffinity 1."""
    return bool((model.geom_contype[geom] | model.geom_conaffinity[geom]) & 1)


class ModelChecks:
    """The single checks. Each returns its finding as a sentence, or raises ``RobotError``."""

    ORDER = ("size", "base", "weight", "joints", "motors", "feet", "bodies_and_sites", "standing_pose")

    def __init__(self, robot: Robot) -> None:
        import mujoco

        self.mujoco = mujoco
        self.robot = robot
        self.spec, self.model = compiled(robot.mjcf)

    def _error(self, problem: str) -> RobotError:
        return RobotError(f"robot '{self.robot.name}': {one_line(problem, 400)}")

    def _require(self, names: Iterable[str], key: str, kind: str) -> list[int]:
        """Return the ids of the model objects (``joint``, ``body``, ``geom``, ``site``) that the field ``key`` names; all must exist."""
        view = getattr(self.model, kind)
        known = {view(i).name: i for i in range(getattr(self.model, _COUNTS[kind]))}
        for name in names:
            if name not in known:
                hint = did_you_mean(name, known)
                raise self._error(f"{key} names '{name}' but {self.robot.mjcf.name} has no {kind} of that name{hint}")
        return [known[name] for name in names]

    def size(self) -> str:
        """Limit the number of parts: a few lines of XML can stand for a million, which every world would simulate."""
        _, model = compiled(self.robot.mjcf, whole=True)  # engines and viewers compile visual meshes too
        counts = {"bodies": model.nbody, "geoms": model.ngeom, "sites": model.nsite, "degrees of freedom": model.nv}
        for kind, count in counts.items():
            if count > MOST_PARTS:
                raise self._error(f"{self.robot.mjcf.name} has {count:,} {kind}; at most {MOST_PARTS:,} are simulated")
        return f"MuJoCo compiles {self.robot.mjcf.name}: {model.nbody - 1} bodies, {model.ngeom} geoms, {model.nv} degrees of freedom"

    def base(self) -> str:
        """Check that the base is free and that the file holds nothing beside the robot."""
        model, robot, file = self.model, self.robot, self.robot.mjcf.name
        (base,) = self._require([robot.base_body], "base_body", "body")
        free = [j for j in range(model.njnt) if model.jnt_type[j] == self.mujoco.mjtJoint.mjJNT_FREE]
        if [model.jnt_bodyid[j] for j in free] != [base]:
            raise self._error(f"{file} must have one free joint, on the base_body '{robot.base_body}'")
        if any(model.geom_bodyid == 0) or any(model.site_bodyid == 0):
            raise self._error(f"{file} has geoms or sites in its worldbody; it must hold the robot alone")
        outside = [i for i in range(1, model.nbody) if model.body_rootid[i] != base]
        if outside:
            name = model.body(outside[0]).name or f"body {outside[0]}"
            raise self._error(f"{file} has the body '{name}' outside '{robot.base_body}'; it must hold the robot alone")
        return f"'{robot.base_body}' is free, and there is nothing beside the robot"

    def weight(self) -> str:
        """Check that nothing but the ground carries the robot."""
        model, option, file = self.model, self.model.opt, self.robot.mjcf.name
        free = slice(0, 6)  # the base's joint comes first: it is the root of the only tree
        passive = model.dof_damping[free].any() or model.dof_frictionloss[free].any() or model.dof_armature[free].any()
        held = (int(self.mujoco.mjtEq.mjEQ_WELD), int(self.mujoco.mjtEq.mjEQ_CONNECT))
        by_world = [
            e
            for e in range(model.neq)
            if int(model.eq_type[e]) in held
            and 0 in (self._body_of(e, model.eq_obj1id[e]), self._body_of(e, model.eq_obj2id[e]))
        ]
        rules = {
            "ties the robot to the world with an equality": not by_world,
            "has damping, friction or armature on the base's free joint": not passive and not model.jnt_stiffness[0],
            f"has a gravity of {option.gravity.tolist()}, not {list(_GRAVITY)}": tuple(option.gravity) == _GRAVITY,
            "has gravity compensation (gravcomp)": not model.body_gravcomp.any(),
            "has a medium or wind": not (option.density or option.viscosity or option.wind.any()),
            "disables or overrides parts of the physics (option flag)": not option.disableflags
            and not option.enableflags & self.mujoco.mjtEnableBit.mjENBL_OVERRIDE,
            "uses engine plug-ins": model.nplugin == 0,
        }
        for problem, kept in rules.items():
            if not kept:
                raise self._error(f"{file} {problem}; take that out")
        return f"nothing but the ground carries its {model.body_mass.sum():.3f} kg"

    def _body_of(self, equality: int, thing: int) -> int:
        """Return the body at one end of an equality; 0 is the world."""
        site = int(self.model.eq_objtype[equality]) == int(self.mujoco.mjtObj.mjOBJ_SITE)
        return int(self.model.site_bodyid[thing]) if site else int(thing)

    def joints(self) -> str:
        """Check that joints are hinges, all named, with the default pose within their ranges."""
        model, robot = self.model, self.robot
        ids = self._require(robot.joint_names, "joint_names", "joint")
        for name, joint in zip(robot.joint_names, ids, strict=True):
            if model.jnt_type[joint] != self.mujoco.mjtJoint.mjJNT_HINGE:
                raise self._error(f"joint_names names '{name}', which is not a hinge in {robot.mjcf.name}")
        others = [
            model.joint(j).name or f"joint {j}"
            for j in range(model.njnt)
            if model.jnt_type[j] != self.mujoco.mjtJoint.mjJNT_FREE and j not in ids
        ]
        if others:
            raise self._error(f"{robot.mjcf.name} has the joint '{others[0]}', which joint_names lacks; add it there")
        for name, joint, angle in zip(robot.joint_names, ids, robot.default_joint_position, strict=True):
            low, high = model.jnt_range[joint]
            if model.jnt_limited[joint] and not low <= angle <= high:
                raise self._error(
                    f"default_joint_position of '{name}' is {angle:g} rad, outside its range {low:g} to {high:g} rad"
                )
        return f"{len(ids)} hinges, all named, with the default pose within their ranges"

    def motors(self) -> str:
        """Check that a model with motors has one on each joint."""
        model, robot, file = self.model, self.robot, self.robot.mjcf.name
        if not model.nu:
            return "the model has no motors; the engines bring their own"
        ids = self._require(robot.joint_names, "joint_names", "joint")
        driven = [
            int(model.actuator_trnid[a, 0])
            for a in range(model.nu)
            if model.actuator_trntype[a] == self.mujoco.mjtTrn.mjTRN_JOINT
        ]
        for name, joint in zip(robot.joint_names, ids, strict=True):
            if driven.count(joint) != 1:
                raise self._error(f"{file} has {driven.count(joint)} actuators on '{name}'; it must have one")
        if model.nu != len(ids):
            raise self._error(f"{file} has {model.nu} actuators for {len(ids)} joints; it must have one for each")
        return "one motor for each joint"

    def feet(self) -> str:
        """Check that feet have shapes that meet the ground."""
        model, robot = self.model, self.robot
        key = "foot_shapes" if robot.foot_shapes else "foot_names"
        for foot, sole in zip(robot.foot_names, robot.soles, strict=True):
            geoms = self._require(sole, key, "geom")
            for name, geom in zip(sole, geoms, strict=True):
                if not solid(model, geom):
                    raise self._error(
                        f"the foot geom '{name}' does not meet the ground; give it contype or conaffinity 1"
                    )
            bodies = {model.body(int(model.geom_bodyid[geom])).name: None for geom in geoms}
            if len(bodies) > 1:
                raise self._error(
                    f"the shapes of the foot '{foot}' lie on the bodies {' and '.join(bodies)}; name shapes of one body"
                )
        return f"{len(robot.foot_names)} feet that meet the ground: {', '.join(robot.foot_names)}"

    def bodies_and_sites(self) -> str:
        """Check the places of bodies, trunk shapes and the gyroscope's site."""
        model, robot = self.model, self.robot
        (base,) = self._require([robot.base_body], "base_body", "body")
        bodies = self._require(robot.collision_bodies, "collision_bodies", "body")
        if base not in bodies:
            raise self._error(f"collision_bodies lacks the base_body '{robot.base_body}'; add it")
        for name, body in zip(robot.collision_bodies, bodies, strict=True):
            first = model.body_geomadr[body]
            if not any(solid(model, g) for g in range(first, first + model.body_geomnum[body])):
                raise self._error(f"no geom of body '{name}' (collision_bodies) meets the ground; give one contype 1")
        shapes = self._require(robot.trunk_shapes, "trunk_shapes", "geom")
        for name, geom in zip(robot.trunk_shapes, shapes, strict=True):
            if model.geom_bodyid[geom] != base:
                raise self._error(f"trunk_shapes names '{name}', which is not on the base_body '{robot.base_body}'")
            if not solid(model, geom):
                raise self._error(f"trunk shape '{name}' does not meet the ground; give it contype or conaffinity 1")
        found = f"{len(bodies)} bodies and {len(shapes)} trunk shapes meet the ground"
        if robot.imu_site is None:
            return f"{found}; no site of a gyroscope is named"
        (imu,) = self._require([robot.imu_site], "imu_site", "site")
        if model.site_bodyid[imu] != base:
            raise self._error(f"imu_site '{robot.imu_site}' must be on the base_body '{robot.base_body}'")
        return f"{found}; the gyroscope sits at '{robot.imu_site}'"

    def standing_pose(self) -> str:
        """Put the robot on a floor at ``stand_height``: nothing may be in it."""
        robot, height, plane = self.robot, self.robot.stand_height, self.mujoco.mjtGeom.mjGEOM_PLANE
        self.spec.worldbody.add_geom(type=plane, size=[0, 0, 1], contype=1, conaffinity=1, margin=0.0)
        model = self.spec.compile()
        data = self.mujoco.MjData(model)
        data.qpos[:7] = (0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0)
        for name, angle in zip(robot.joint_names, robot.default_joint_position, strict=True):
            data.joint(name).qpos[0] = angle
        self.mujoco.mj_fwdPosition(model, data)
        contacts = [data.contact[i] for i in range(data.ncon) if 0 in model.geom_bodyid[data.contact[i].geom]]
        deepest = min(contacts, key=lambda c: c.dist, default=None)
        if deepest is not None and deepest.dist < -DEPTH_TOLERANCE:
            geom = next(int(g) for g in deepest.geom if model.geom_bodyid[g] != 0)
            part, kind = model.geom(geom).name, "geom"
            if not part:
                body = model.body(model.geom_bodyid[geom])
                part, kind = body.name or str(body.id), "body"
            raise self._error(
                f"at stand_height {height:g} m the {kind} '{part}' is {-deepest.dist:.3f} m below the ground; "
                f"raise it to {height - deepest.dist:.3f} m or more"
            )
        return f"at stand_height {height:g} m nothing of it is below the ground"
