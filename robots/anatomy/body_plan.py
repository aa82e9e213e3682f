"""Read a legged robot's build off its MuJoCo model in the default pose: legs, mirror images, sizes, joint ranges, mass.

Nothing depends on names. Frames are the base's: x forward, y left, z up, origin at the base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..base import Robot
from ..loading import RobotError
from ..physical import physical_spec
from .limbs import joint_chain, pitch_joints

if TYPE_CHECKING:
    import mujoco

LEG_PARTS = ("hip", "thigh", "calf")
_MIRROR = np.array([1.0, -1.0, 1.0])
_APART = 0.01
"""Largest distance of a joint or foot from the mirror image of its counterpart [m]."""
_ALIGNED = 0.999
"""Smallest cosine between a joint's axis and the mirror image of its counterpart's."""


@dataclass(frozen=True, kw_only=True)
class MirrorImage:
    """Joints and feet of the robot mirrored at its sagittal plane (y to −y)."""

    joint: tuple[int, ...]
    """Counterpart of each joint, an index in the robot's joint order."""
    sign: tuple[float, ...]
    """Factor of each joint's angle from the default pose: −1 where the counterpart turns the other way."""
    foot: tuple[int, ...]
    """Counterpart of each foot."""


@dataclass(frozen=True, kw_only=True)
class BodyPlan:
    """A robot's legs and sizes."""

    legs: tuple[tuple[int, ...], ...]
    """Joints of each foot's leg from the base outwards, without wheels, indices in the robot's joint order."""
    abduction: tuple[int, ...]
    """Joint of each leg that swings it sideways, the first about the x axis; legs without one are left out."""
    limb_bodies: tuple[int, ...]
    """Indices of the ``collision_bodies`` that joints other than abduction move: thighs, calves and bodies below."""
    foot_position: NDArray[np.float64]
    """Centres of the feet in the default pose [m], (F, 3)."""
    standing_height: float
    """Height of the base above level ground that the lowest foot touches in the default pose [m]."""
    stretched_height: float
    """Height of the base above level ground at which all legs hang straight down to it [m], the mean of all legs."""
    leg_length: float
    """Length of a stretched leg [m]: the links from the first joint that bends it to the foot, the mean of all legs."""
    mass: float
    """Of the whole robot [kg]."""

    @property
    def stance(self) -> tuple[float, float]:
        """Return length and width of the rectangle around the feet's centres in the default pose [m]."""
        length, width, _ = np.ptp(self.foot_position, axis=0)
        return float(length), float(width)

    def part(self, joint: int) -> str:
        """Return the leg part of a joint: ``calf`` for a leg's last, ``hip`` for abduction, else ``thigh``; empty for no leg's."""
        for leg in self.legs:
            if joint in leg:
                return "hip" if joint in self.abduction else "calf" if joint == leg[-1] else "thigh"
        return ""


def body_plan(robot: Robot) -> BodyPlan:
    """Read legs and sizes off a robot's model; raise ``RobotError`` where joints of ``joint_names`` do not move a foot."""
    model, data = default_pose(robot)
    order = {model.joint(name).id: i for i, name in enumerate(robot.joint_names)}
    wheels = {model.joint(name).id for name in robot.velocity_joints or ()}
    base = model.body(robot.base_body).id
    soles = sole_geoms(model, robot)
    legs, abduction, lengths, below = [], [], [], []
    for name, sole in zip(robot.foot_names, soles, strict=True):
        chain = joint_chain(model, int(model.geom_bodyid[sole[0]]), base)
        chain = [j for j in chain if j not in wheels]
        if not chain or any(j not in order for j in chain):
            raise RobotError(f"robot '{robot.name}': the foot '{name}' is not moved by joints of joint_names")
        legs.append(tuple(order[j] for j in chain))
        sideways, swinging = sideways_and_swinging(data, chain)
        if sideways is not None:
            abduction.append(order[sideways])
        # from the base down to the leg's first joint, and from the foot's centre to its lowest point
        lowest = min(lowest_point(model, data, geom) for geom in sole)
        center = data.geom_xpos[sole].mean(axis=0)
        below.append(center[2] - lowest - data.xanchor[swinging[0], 2])
        lengths.append(stretched_length(data, swinging, center))
    sideways_ids = {model.joint(robot.joint_names[i]).id for i in abduction}
    bodies = [joint_chain(model, model.body(name).id, base) for name in robot.collision_bodies]
    return BodyPlan(
        legs=tuple(legs),
        abduction=tuple(abduction),
        limb_bodies=tuple(i for i, chain in enumerate(bodies) if set(chain) - sideways_ids),
        foot_position=foot_centers(model, data, robot),
        standing_height=max(-lowest_point(model, data, geom) for sole in soles for geom in sole),
        stretched_height=float(np.mean(below) + np.mean(lengths)),
        leg_length=float(np.mean(lengths)),
        mass=float(model.body_mass.sum()),
    )


def mirror_image(robot: Robot) -> MirrorImage:
    """Find counterparts of joints and feet by place and axis in the default pose; raise ``RobotError`` where one has none."""
    model, data = default_pose(robot)
    joints = [model.joint(name).id for name in robot.joint_names]
    anchors, axes = data.xanchor[joints], data.xaxis[joints]
    # a rotation about an axis, seen in a mirror, is one about minus the axis's image
    images, turned = anchors * _MIRROR, -axes * _MIRROR
    counterpart, sign = [], []
    for i, name in enumerate(robot.joint_names):
        along = axes @ turned[i]
        distance = np.linalg.norm(anchors - images[i], axis=1) + np.where(np.abs(along) >= _ALIGNED, 0.0, np.inf)
        found = int(distance.argmin())
        if distance[found] > _APART:
            raise _no_image(robot, "joint", name, images[i])
        counterpart.append(found)
        sign.append(float(np.sign(along[found])))
    feet = foot_centers(model, data, robot)
    pairs = []
    for name, image in zip(robot.foot_names, feet * _MIRROR, strict=True):
        distance = np.linalg.norm(feet - image, axis=1)
        if distance.min() > _APART:
            raise _no_image(robot, "foot", name, image)
        pairs.append(int(distance.argmin()))
    for what, found_pairs in (("joints", counterpart), ("feet", pairs)):
        if [found_pairs[i] for i in found_pairs] != list(range(len(found_pairs))):
            raise RobotError(
                f"robot '{robot.name}': its {what} do not pair up left and right; train with "
                "training.algorithm.symmetry=none"
            )
    return MirrorImage(joint=tuple(counterpart), sign=tuple(sign), foot=tuple(pairs))


def _no_image(robot: Robot, kind: str, name: str, image: NDArray[np.float64]) -> RobotError:
    x, y, z = (f"{v:.3f}" for v in image)
    return RobotError(
        f"robot '{robot.name}': in the default pose the {kind} '{name}' has no counterpart at its mirror image "
        f"({x}, {y}, {z}) m; mend default_joint_position or the model, or train with training.algorithm.symmetry=none"
    )


def joint_ranges(robot: Robot) -> NDArray[np.float64]:
    """Return the lower and upper limit of every joint in the robot's order [rad], (J, 2); infinite where a joint has none."""
    model = robot_model(robot)
    ids = [model.joint(name).id for name in robot.joint_names]
    return np.where(model.jnt_limited[ids, None], model.jnt_range[ids], [-np.inf, np.inf])


def model_joint_order(robot: Robot) -> list[int]:
    """Return the model's joint order behind the free joint, as indices into ``joint_names``."""
    model = robot_model(robot)
    address = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    return sorted(range(robot.num_joints), key=address.__getitem__)


def stance_span(robot: Robot) -> float:
    """Return the largest horizontal distance between two feet in the default pose [m]: the diagonal stance span."""
    feet = foot_centers(*default_pose(robot), robot)[:, :2]
    return float(max(np.linalg.norm(a - b) for a, b in combinations(feet, 2)))


def total_mass(robot: Robot) -> float:
    """Return the mass of the whole robot [kg]."""
    return float(robot_model(robot).body_mass.sum())


def base_mass(robot: Robot) -> float:
    """Return the mass of the robot's base body [kg]."""
    return float(robot_model(robot).body(robot.base_body).mass[0])


def robot_model(robot: Robot) -> mujoco.MjModel:
    """Compile the robot's model, without visual meshes."""
    return physical_spec(robot.mjcf).compile()


def default_pose(robot: Robot) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the robot's model and its kinematics in the default pose, the base at the origin, level and unturned."""
    import mujoco

    model = robot_model(robot)
    data = mujoco.MjData(model)
    start = model.jnt_qposadr[model.body(robot.base_body).jntadr[0]]
    data.qpos[start : start + 7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    for name, angle in zip(robot.joint_names, robot.default_joint_position, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    return model, data


def sideways_and_swinging(data: mujoco.MjData, chain: Sequence[int]) -> tuple[int | None, list[int]]:
    """Return a leg's first joint that turns mainly about the x axis, None without one, and the joints that bend the leg."""
    sideways = next((j for j in chain if int(np.abs(data.xaxis[j]).argmax()) == 0), None)
    return sideways, pitch_joints(data, chain)


def sole_geoms(model: mujoco.MjModel, robot: Robot) -> list[list[int]]:
    """Return the geoms of each foot."""
    return [[model.geom(name).id for name in sole] for sole in robot.soles]


def foot_centers(model: mujoco.MjModel, data: mujoco.MjData, robot: Robot) -> NDArray[np.float64]:
    """Return the centre of each foot, the mean of its geoms' centres, in the pose of ``data`` [m], (F, 3)."""
    return np.array([data.geom_xpos[sole].mean(axis=0) for sole in sole_geoms(model, robot)])


def stretched_length(data: mujoco.MjData, joints: list[int], foot: NDArray[np.float64]) -> float:
    """Return the length of the links from a leg's first joint to its foot's centre [m]; parts along a hinge do not count."""
    links = np.diff([*data.xanchor[joints], foot], axis=0)
    return sum(float(np.linalg.norm(d - a * (d @ a))) for d, a in zip(links, data.xaxis[joints], strict=True))


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Return the height of a geom's lowest point, or that of its bounding box for other shapes than spheres and cylinders [m]."""
    import mujoco

    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
        return float(data.geom_xpos[geom, 2] - model.geom_size[geom, 0])
    center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    up = data.geom_xmat[geom].reshape(3, 3)[2]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER:
        radius, length = model.geom_size[geom, :2]
        return float(data.geom_xpos[geom, 2] - radius * np.hypot(up[0], up[1]) - length * abs(up[2]))
    return float(data.geom_xpos[geom, 2] + up @ center - np.abs(up) @ half)
