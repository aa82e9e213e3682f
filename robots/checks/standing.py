"""Let a robot stand: whether its legs are folded, how far they sink under its weight, whether it stands, and balances, alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..anatomy.body_plan import body_plan, default_pose, lowest_point, sole_geoms
from ..anatomy.roles import anatomy
from ..base import JointParameters, Robot
from ..loading import RobotError
from ..physical import physical_spec

if TYPE_CHECKING:
    import mujoco

STANDING_SECONDS = 2.0
"""Duration of standing [s]."""
FOLDED = 0.5
"""Smallest height of a leg's hip above its foot's lowest point over leg length: below, the robot lies."""
MOST_SAG = 0.1
"""Largest way that the base sinks under the robot's weight, over leg length."""
_TIMESTEP = 0.002
_MOST_TILT = 0.3
"""Largest tilt of a standing robot [rad]."""
_LOWEST = 0.7
"""Smallest height of a standing robot, as a share of its first one."""
_STRATEGY = (1.5, 0.5)
"""Torque of the ankles over weight times way [1], and over weight times speed [s], of the centre of mass from above the feet."""


@dataclass(frozen=True, kw_only=True)
class Stance:
    """Stance of a robot that was left standing in a pose."""

    height: float
    """Of its base at the end [m]."""
    start: float
    """Of its base at the beginning [m]."""
    tilt: float
    """Of its base at the end [rad]."""
    torque: float
    """Largest share of a motor's torque limit at the end."""
    apart_after: float | None = None
    """Time at which the robot flew apart [s]; None where it did not."""

    def stands(self, *, lowest: float = _LOWEST, most_tilt: float = _MOST_TILT) -> bool:
        """Return whether the robot is whole, at least ``lowest`` of its first height high, and tilted by ``most_tilt`` [rad] at most."""
        return self.apart_after is None and self.tilt <= most_tilt and self.height >= lowest * self.start

    def __str__(self) -> str:
        return f"after {STANDING_SECONDS:g} s its base is {self.height:.3f} m high and leans by {self.tilt:.2f} rad"


@dataclass(frozen=True, kw_only=True)
class Ankles:
    """Joints and shapes with which a biped balances, by name."""

    pitch: Sequence[str]
    roll: Sequence[str]
    feet: Sequence[str]


def folded(robot: Robot) -> str:
    """Check that the hips stay over half of the legs' length above the ground; raise ``RobotError`` with legs that are folded or weak."""
    model, data = default_pose(robot)
    build, soles, lying = anatomy(robot), sole_geoms(model, robot), []
    for leg in build.legs:
        hip = model.joint(robot.joint_names[leg.joints[0]]).id
        height = float(data.xanchor[hip, 2]) - min(lowest_point(model, data, geom) for geom in soles[leg.foot])
        if height < FOLDED * build.leg_length:
            lying.append(f"{leg.name} ({height:.3f} m from hip to ground)")
    if lying:
        named = keyframe_of(model, robot)
        raise RobotError(
            f"robot '{robot.name}': in its default pose{named} the robot lies: of its legs of {build.leg_length:.3f} m these are folded: "
            f"{', '.join(lying)}; give default_joint_position a pose on stretched legs, at least half as high"
        )
    stance, hips = (
        _left_standing(robot, upright=True),
        data.xanchor[[model.joint(robot.joint_names[leg.joints[0]]).id for leg in build.legs], 2],
    )
    left = stance.height + float(hips.mean())
    if left < FOLDED * build.leg_length:
        raise RobotError(
            f"robot '{robot.name}': under its weight the hips sink to {left:.3f} m, under half of its legs' length; raise "
            f"stiffness and torque_limit of parameters.{robot.default_parameters}, or stretch the legs in default_joint_position"
        )
    return f"the legs hold the hips {left:.3f} m above the ground, over half of their length"


def keyframe_of(model: mujoco.MjModel, robot: Robot) -> str:
    """Return a remark that names the model's keyframe with the angles of the default pose; empty without one."""
    address = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    for key in range(model.nkey):
        if np.allclose(model.key_qpos[key, address], robot.default_joint_position, atol=1e-3):
            return f", the model's keyframe '{model.key(key).name or key}',"
    return ""


def _left_standing(robot: Robot, *, upright: bool = False, ankles: Ankles | None = None) -> Stance:
    stance = stand_still(
        physical_spec(robot.mjcf),
        dict(zip(robot.joint_names, robot.default_joint_position, strict=True)),
        robot.parameters[robot.default_parameters],
        body_plan(robot).standing_height,
        upright=upright,
        ankles=ankles,
    )
    if stance.apart_after is not None:
        raise RobotError(
            f"robot '{robot.name}': it flies apart within {stance.apart_after:.2f} s of standing; lower stiffness and damping of "
            f"parameters.{robot.default_parameters}, or give its joints armature"
        )
    return stance


def sag(robot: Robot) -> str:
    """Hold the base level and let it sink on the legs; raise ``RobotError`` where it sinks further than the robot may."""
    stance, length = _left_standing(robot, upright=True), anatomy(robot).leg_length
    sunk, most = max(stance.start - stance.height, 0.0), MOST_SAG if robot.most_sag is None else robot.most_sag
    told = f"the legs, {length:.3f} m long, let the base sink by {sunk:.3f} m under its weight"
    if sunk > most * length:
        raise RobotError(
            f"robot '{robot.name}': {told}, over {most:g} of their length; raise the stiffness (and torque_limit) of "
            f"parameters.{robot.default_parameters}, stretch the legs in default_joint_position, or say that it is meant: most_sag = "
            f"{math.ceil(100 * sunk / length) / 100:g}"
        )
    return told


def stand(robot: Robot) -> str:
    """Let a robot stand in its default pose with the gains of its default parameters, and describe its stance.

    Its parts meet, as in training and in the suites.

    Raises:
        RobotError: the robot falls, sinks or flies apart.
    """
    stance = _left_standing(robot)
    if not stance.stands():
        raise RobotError(
            f"robot '{robot.name}': it does not stand: {stance}; raise the stiffness and torque_limit of "
            f"parameters.{robot.default_parameters}, or mend default_joint_position"
        )
    return f"stands in its default pose: {stance}, with up to {100 * stance.torque:.0f} % of a motor's torque"


def balance(robot: Robot) -> str:
    """Let a biped stand with its ankles turned against every sway; raise ``RobotError`` where it falls all the same."""
    build = anatomy(robot)
    named = {kind: [robot.joint_names[j] for j in build.joints(f"ankle_{kind}")] for kind in ("pitch", "roll")}
    if not named["pitch"]:
        raise RobotError(
            f"robot '{robot.name}': it has two legs without ankles, on which no pose stands; a policy has to balance it"
        )
    stance = _left_standing(robot, ankles=Ankles(pitch=named["pitch"], roll=named["roll"], feet=robot.foot_geoms))
    if not stance.stands():
        raise RobotError(
            f"robot '{robot.name}': it does not balance with its ankles: {stance}; a policy may, but look whether the default pose "
            "puts its weight over its soles"
        )
    return f"balances with its ankles in its default pose: {stance}, with up to {100 * stance.torque:.0f} % of a motor's torque"


def stand_still(
    spec: mujoco.MjSpec,
    pose: Mapping[str, float],
    motors: JointParameters,
    height: float,
    *,
    upright: bool = False,
    ankles: Ankles | None = None,
) -> Stance:
    """Leave a robot standing on level ground.

    Args:
        spec: the robot alone; ground is added, and its actuators are switched off.
        pose: the angle that each joint is to keep [rad].
        motors: of the joints, in the order of ``pose``.
        height: of the base at the beginning [m].
        upright: hold the base level, free to move up and down alone.
        ankles: a biped's, which turn against every sway of its centre of mass; None for joints that keep their angles.
    """
    import mujoco

    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)  # sensors may refer to actuators: they stay
    spec.option.timestep = _TIMESTEP
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=1)
    model = spec.compile()
    data = mujoco.MjData(model)
    joints = [model.joint(name).id for name in pose]
    at_q, at_v = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    model.dof_armature[at_v] = motors.armature
    model.dof_damping[at_v] = motors.joint_damping
    model.dof_frictionloss[at_v] = motors.friction_loss
    mujoco.mj_setConst(model, data)
    angles, limit = np.array(list(pose.values())), np.array(motors.torque_limit)
    data.qpos[:7] = (0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0)
    data.qpos[at_q] = angles
    mujoco.mj_forward(model, data)
    turn = _AnkleStrategy(model, data, list(pose), ankles) if ankles is not None else None
    apart_after = None
    for _ in range(round(STANDING_SECONDS / _TIMESTEP)):
        torque = np.multiply(motors.stiffness, angles - data.qpos[at_q]) - np.multiply(motors.damping, data.qvel[at_v])
        if turn is not None:
            torque += turn.torque(data)
        data.qfrc_applied[at_v] = np.clip(torque, -limit, limit)
        mujoco.mj_step(model, data)
        if upright:
            data.qpos[[0, 1, 3, 4, 5, 6]] = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
            data.qvel[[0, 1, 3, 4, 5]] = 0.0
        if not np.isfinite(data.qpos).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            apart_after = float(data.time)
            break
    _, x, y, _ = data.qpos[3:7]
    return Stance(
        height=float(data.qpos[2]),
        start=height,
        tilt=math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y)))),
        torque=float(np.max(np.abs(data.qfrc_applied[at_v]) / np.maximum(limit, 1e-9))),
        apart_after=apart_after,
    )


class _AnkleStrategy:
    """Torque of a biped's ankles in proportion to the way and the speed of its centre of mass from its place at the beginning."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, joints: Sequence[str], ankles: Ankles) -> None:
        self.feet = [model.geom(name).id for name in ankles.feet]
        self.share = np.zeros((len(joints), 2))
        weight = float(model.body_mass.sum()) * 9.81
        for axis, names in ((1, ankles.pitch), (0, ankles.roll)):
            for name in names:
                # a centre of mass before the feet needs the toes down, about +y; one to their left the left edge down, about −x
                about = float(data.xaxis[model.joint(name).id, axis])
                self.share[joints.index(name), 1 - axis] = (
                    (1.0 if axis == 1 else -1.0) * np.sign(about) * weight / len(names)
                )
        self.model = model
        self.aside = self._aside(data)
        self.before = self.aside

    def _aside(self, data: mujoco.MjData) -> np.ndarray:
        return np.array(data.subtree_com[1][:2] - data.geom_xpos[self.feet, :2].mean(axis=0))

    def torque(self, data: mujoco.MjData) -> np.ndarray:
        """Return the torque to add to each joint's [N·m], (J,)."""
        aside = self._aside(data)
        speed, self.before = (aside - self.before) / _TIMESTEP, aside
        gain, damping = _STRATEGY
        return np.asarray(self.share @ (gain * (aside - self.aside) + damping * speed))
