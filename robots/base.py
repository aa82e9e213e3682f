"""What a robot is: a MuJoCo model file and the data that the other rooms need to know about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class JointParameters:
    """One named set of joint and motor constants. Every tuple has one entry per joint, in the robot's joint order.

    The motor law is ``torque = stiffness * (target - q) - damping * qd``, clipped to ``torque_limit`` where the physics
    options ask for torque limits, then multiplied by the motor strength. Where they ask for limits by speed, the torque
    in the direction of motion falls from ``driving_torque_limit`` at ``full_torque_speed`` to zero at ``no_load_speed``.
    """

    stiffness: tuple[float, ...]
    """Proportional gain kp of the motor [N·m/rad]."""
    damping: tuple[float, ...]
    """Derivative gain kd of the motor [N·m·s/rad]."""
    torque_limit: tuple[float, ...]
    """Largest motor torque [N·m]."""
    armature: tuple[float, ...]
    """Rotor inertia seen at the joint [kg·m²]."""
    joint_damping: tuple[float, ...]
    """Passive viscous damping of the joint [N·m·s/rad]."""
    friction_loss: tuple[float, ...]
    """Dry friction of the joint [N·m]."""
    driving_torque_limit: tuple[float, ...] | None = None
    """Largest motor torque in the direction of motion [N·m]; None where it is ``torque_limit``, as against it."""
    full_torque_speed: tuple[float, ...] | None = None
    """Joint speed up to which the driving torque is there [rad/s]; None where it is not known."""
    no_load_speed: tuple[float, ...] | None = None
    """Joint speed from which the motor drives no more [rad/s]; None where it is not known."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A legged robot as data. Joint, foot and body orders given here hold in every room of the project."""

    name: str
    title: str
    """Name for people, for example ``Unitree Go2``."""
    mjcf: Path
    """MuJoCo model of the robot alone: one free base, hinge joints, no ground."""
    joint_names: tuple[str, ...]
    default_joint_position: tuple[float, ...]
    """Standing pose [rad]."""
    base_body: str
    """Body that carries the free joint; its origin is the base position."""
    foot_names: tuple[str, ...]
    """Name of each foot; both the collision geom and the site at its centre bear it."""
    collision_bodies: tuple[str, ...]
    """Bodies whose contacts with the ground are reported one by one; their foot geoms are reported apart."""
    trunk_shapes: tuple[str, ...]
    """Collision geoms of the base body that are its trunk, without head or sensors: what must not touch the ground."""
    imu_site: str
    stand_height: float
    """Height of the base above the ground at which an episode starts [m]."""
    default_parameters: str
    """Name of the parameter set used where none is asked for."""
    parameters: Mapping[str, JointParameters]
    """Named parameter sets (``gauge``, ``training`` …)."""
    command_limits: tuple[float, float, float]
    """Largest commanded forward, lateral [m/s] and yaw [rad/s] speed that the robot is meant for."""

    @property
    def num_joints(self) -> int:
        """Number of actuated joints."""
        return len(self.joint_names)
