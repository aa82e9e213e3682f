"""A robot as data: a MuJoCo model file and the values that the other packages need to know about it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from ..files.parsing import Name, Text

Angle = Annotated[float, Field(strict=True, ge=-12.6, le=12.6)]
"""A joint's angle [rad]."""
Speed = Annotated[float, Field(strict=True, ge=0.0, le=100.0)]
"""A command's limit [m/s, rad/s]."""
Stiffness = Annotated[float, Field(strict=True, ge=0.0, le=10_000.0)]
"""kp [N·m/rad]."""
Damping = Annotated[float, Field(strict=True, ge=0.0, le=1_000.0)]
"""A motor's kd, or damping of the joint itself [N·m·s/rad]."""
Torque = Annotated[float, Field(strict=True, ge=0.0, le=10_000.0)]
"""[N·m]."""
Inertia = Annotated[float, Field(strict=True, ge=0.0, le=100.0)]
"""A rotor's inertia, seen at the joint [kg·m²]."""
_Factor = Annotated[float, Field(strict=True, ge=0.0, le=10.0)]
_Offset = Annotated[float, Field(strict=True, ge=-1.0, le=1.0)]
_ActionScale = Annotated[float, Field(ge=0.0, le=100.0)]
_JointSpeed = Annotated[float, Field(ge=0.0, le=1_000.0)]
_Names = Annotated[tuple[Text, ...], Field(min_length=1, max_length=1000)]


@dataclass(frozen=True, kw_only=True)
class JointParameters:
    """One named set of joint and motor constants. Every tuple has one entry per joint, in the robot's joint order.

    The motor law is ``torque = stiffness * (target - q) - damping * qd``, for a joint of ``Robot.velocity_joints``
    ``damping * (target - qd)``, clipped to ``torque_limit`` where the physics options ask for torque limits, then
    multiplied by the motor strength. Where they ask for limits by speed, the torque in the direction of motion falls from
    ``driving_torque_limit`` at ``full_torque_speed`` to zero at ``no_load_speed``. ``commanded`` turns gains that were
    sent to a measured robot into those that act.
    """

    stiffness: tuple[Stiffness, ...]
    """Proportional gain kp of the motor [N·m/rad]."""
    damping: tuple[Damping, ...]
    """Derivative gain kd of the motor [N·m·s/rad]."""
    torque_limit: tuple[Torque, ...]
    """Largest motor torque [N·m]."""
    armature: tuple[Inertia, ...]
    """Rotor inertia seen at the joint [kg·m²]."""
    joint_damping: tuple[Damping, ...]
    """Passive viscous damping of the joint [N·m·s/rad]."""
    friction_loss: tuple[Torque, ...]
    """Dry friction of the joint [N·m]."""
    driving_torque_limit: tuple[Torque, ...] | None = None
    """Largest motor torque in the direction of motion [N·m]; None for ``torque_limit``, the limit against the motion."""
    full_torque_speed: tuple[_JointSpeed, ...] | None = None
    """Largest joint speed with the whole driving torque [rad/s]; None where it is not known."""
    no_load_speed: tuple[_JointSpeed, ...] | None = None
    """Joint speed beyond which the motor does not drive [rad/s]; None where it is not known."""
    stiffness_factor: tuple[_Factor, ...] | None = None
    """Share of the commanded kp that acts at the joint; None for 1."""
    damping_factor: tuple[_Factor, ...] | None = None
    """Share of the commanded kd that acts at the joint; None for 1."""
    target_offset: tuple[_Offset, ...] | None = None
    """Angle that the motor adds to its target [rad]: errors of its zero and of the pose; None for 0."""
    delay: Annotated[float, Field(ge=0.0, le=0.1)] | None = None
    """Time from sending a target until it acts [s]; None where it was not measured."""
    motor: Literal["law", "network", "torque"] = "law"
    """``law``: the motor law above; ``network``: the network of ``network``, which knows no gains; ``torque``: what is commanded
    is the torque [N·m], before limits and strength."""
    network: Annotated[str, Field(min_length=1, max_length=4000)] | None = None
    """Path of the network's file (``gaitgauge robot motor``)."""
    measured: Annotated[str, Field(min_length=1, max_length=4000)] | None = None
    """Provenance of a set that was measured: recordings, method, version. Such a set does not count for the robot's digest."""

    def commanded(self, stiffness: Sequence[float], damping: Sequence[float]) -> JointParameters:
        """Return the set with the gains that act where these were sent, in the joints' order; both factors are spent."""
        acting = [
            tuple(gain * factor for gain, factor in zip(gains, factors or (1.0,) * len(gains), strict=True))
            for gains, factors in ((stiffness, self.stiffness_factor), (damping, self.damping_factor))
        ]
        return replace(self, stiffness=acting[0], damping=acting[1], stiffness_factor=None, damping_factor=None)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A set of joints that policies drive, for example legs alone; the robot's other joints are held."""

    driven_joints: _Names
    """In the order that policies use."""
    default_joint_position: tuple[Angle, ...] | None = None
    """Pose of all joints of the robot [rad], the held ones' included; None for the robot's own."""


@dataclass(frozen=True, kw_only=True)
class HeldJoint:
    """A joint that no policy drives: its motor holds it at an angle."""

    name: Text
    position: Angle
    """[rad]."""
    stiffness: Stiffness
    """[N·m/rad]."""
    damping: Damping
    """[N·m·s/rad]."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A legged robot as data. Joint, foot and body orders given here hold in all packages."""

    name: Name
    title: Text
    """Name for people, for example ``Unitree Go2``."""
    mjcf: Path
    """MuJoCo model of the robot alone: one free base, hinge joints, no ground."""
    joint_names: _Names
    default_joint_position: tuple[Angle, ...]
    """Standing pose [rad]."""
    base_body: Text
    """Body that carries the free joint; its origin is the base position."""
    foot_names: _Names
    """Name of each foot, and of its collision geom where ``foot_shapes`` is None."""
    collision_bodies: _Names
    """Bodies with contacts of their own in the state; foot geoms are reported apart."""
    trunk_shapes: _Names
    """Collision geoms of the base body that form its trunk, without head or sensors, and must not touch the ground."""
    imu_site: Text | None = None
    """Site on the base where the gyroscope sits; None where the model has none."""
    stand_height: Annotated[float, Field(gt=0.0, le=10.0)]
    """Height of the base above the ground at which an episode starts [m]."""
    default_parameters: Text
    """Name of the parameter set used where none is asked for."""
    parameters: Annotated[Mapping[Name, JointParameters], Field(min_length=1)]
    """Named parameter sets (``gauge``, ``training`` …)."""
    command_limits: tuple[Speed, Speed, Speed]
    """Largest commanded forward, lateral [m/s] and yaw [rad/s] speed that the robot is meant for."""
    sdk_joint_names: _Names | None = None
    """Joints in the motor order of the maker's SDK, which a ``deploy.yaml`` refers to; None where it is not known."""
    action_scale: Annotated[tuple[_ActionScale, ...], Field(min_length=1)] | None = None
    """Change of a joint's target for an output of 1 of a standard policy [rad; rad/s]; None for 0.25."""
    foot_shapes: Annotated[tuple[Text | _Names, ...], Field(min_length=1, max_length=1000)] | None = None
    """Collision geom of each foot, or for a sole the names of several on one body; None where the geoms bear the feet's names.
    The mean of the geoms' centres is the foot's position."""
    velocity_joints: _Names | None = None
    """Joints with targets of velocity [rad/s] instead of angle, as wheels have; None for none."""
    most_sag: Annotated[float, Field(ge=0.0, le=0.5)] | None = None
    """Largest way that the base may sink under the robot's weight, over leg length, where its gains are meant to let it; None for
    0.1. For ``robot check`` alone: it does not count for the digest."""
    driven_joints: _Names | None = None
    """Joints that a policy drives, in the order that policies use; the others are held at ``default_joint_position`` with the
    gains of the parameter set. None for all of ``joint_names``."""
    variants: Mapping[Name, Variant] | None = None
    """Other sets of driven joints, by name; a policy for the joints of one makes the robot this variant."""

    @property
    def num_joints(self) -> int:
        """Return the number of actuated joints."""
        return len(self.joint_names)

    @property
    def driven_by_velocity(self) -> tuple[bool, ...]:
        """Return, for each joint, whether its target is a velocity."""
        return tuple(name in (self.velocity_joints or ()) for name in self.joint_names)

    @property
    def soles(self) -> tuple[tuple[str, ...], ...]:
        """Return the names of each foot's collision geoms."""
        return tuple((each,) if isinstance(each, str) else each for each in self.foot_shapes or self.foot_names)

    @property
    def foot_geoms(self) -> tuple[str, ...]:
        """Return the names of all collision geoms of feet, foot by foot."""
        return tuple(name for sole in self.soles for name in sole)

    @property
    def held(self) -> tuple[HeldJoint, ...]:
        """Return the joints that no policy drives, with pose and gains of ``default_parameters``, in the joints' order."""
        driven, motors = self.driven_joints or self.joint_names, self.parameters[self.default_parameters]
        rows = zip(self.joint_names, self.default_joint_position, motors.stiffness, motors.damping, strict=True)
        return tuple(
            HeldJoint(name=name, position=angle, stiffness=kp, damping=kd)
            for name, angle, kp, kd in rows
            if name not in driven
        )

    def driving(self, joints: Collection[str]) -> Robot | None:
        """Return the robot as the variant of which a policy drives these joints, in any order; None where there is none."""
        if set(joints) == set(self.driven_joints or self.joint_names):
            return self
        every = Variant(driven_joints=self.joint_names)
        for each in (*(self.variants or {}).values(), every):
            if set(joints) == set(each.driven_joints):
                pose = each.default_joint_position or self.default_joint_position
                return replace(self, driven_joints=each.driven_joints, default_joint_position=pose)
        return None
