"""Tell a robot's build from its model: the body plan, the legs, and the role of every joint. Nothing depends on names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..base import Robot
from ..loading import RobotError
from .body_plan import body_plan, default_pose, foot_centers
from .limbs import joint_chain, joint_roles

Plan = Literal["quadruped", "biped", "humanoid", "wheeled", "hexapod"]
PLANS: Mapping[int, Plan] = {2: "biped", 4: "quadruped", 6: "hexapod"}
"""Body plans by number of legs; a biped with arms is a humanoid, and a robot on wheels is wheeled."""
WORDS: Mapping[str, str] = {
    "quadruped": "a quadruped",
    "biped": "a biped",
    "humanoid": "a biped with arms",
    "wheeled": "legs on wheels",
    "hexapod": "a hexapod",
}


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One leg of a robot."""

    name: str
    """``left``, ``right``; ``front left``, ``rear right`` …; ``middle left`` of six."""
    side: Literal["left", "right"]
    joints: tuple[int, ...]
    """From the hip to the ankle or wheel, indices in the robot's joint order."""
    foot: int
    """Index in ``foot_names``."""


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """Build of a robot."""

    plan: Plan
    legs: tuple[Leg, ...]
    """In the order of ``foot_names``."""
    roles: tuple[str, ...]
    """Role of each joint, in the robot's joint order: ``hip_roll``, ``hip_pitch``, ``hip_yaw``, ``knee``, ``ankle_pitch``,
    ``ankle_roll``, ``ankle_yaw``, ``wheel``; ``waist_*``; ``shoulder_*``, ``elbow``, ``wrist_*``, ``hand``; ``head_*``; ``other``.
    A quadruped's hip, thigh and calf are ``hip_roll``, ``hip_pitch`` and ``knee``."""
    leg_length: float
    """Length of a stretched leg [m], the mean of all legs."""

    def joints(self, role: str) -> tuple[int, ...]:
        """Return the joints of a role, or of all roles that begin with it (``hip``), as indices in the robot's joint order."""
        return tuple(i for i, own in enumerate(self.roles) if own == role or own.startswith(f"{role}_"))


def anatomy(robot: Robot) -> Anatomy:
    """Read a robot's build off its model and feet; raise ``RobotError`` where no body plan fits."""
    sizes = body_plan(robot)
    model, data = default_pose(robot)
    order = {model.joint(name).id: i for i, name in enumerate(robot.joint_names)}
    ids = {i: joint for joint, i in order.items()}
    feet = [model.geom(sole[0]).id for sole in robot.soles]
    base = model.body(robot.base_body).id
    chains = [joint_chain(model, int(model.geom_bodyid[foot]), base) for foot in feet]
    legs = [tuple(order[j] for j in chain) for chain in chains]
    wheels = {model.joint(name).id for name in robot.velocity_joints or ()}
    roles = joint_roles(model, base, chains, feet, wheels)
    who = f"robot '{robot.name}'"
    plan = plan_of(len(legs), roles.values(), who)
    return Anatomy(
        plan=plan,
        legs=tuple(
            Leg(
                name=name,
                side="left" if name.endswith("left") else "right",
                joints=tuple(i for i in joints if not roles[ids[i]].startswith("waist")),
                foot=foot,
            )
            for foot, (name, joints) in enumerate(
                zip(leg_names(foot_centers(model, data, robot), who), legs, strict=True)
            )
        ),
        roles=tuple(roles.get(ids[i], "other") for i in range(robot.num_joints)),
        leg_length=sizes.leg_length,
    )


def plan_of(legs: int, roles: Iterable[str], who: str) -> Plan:
    """Return the plan of a robot with so many legs and these roles of joints; raise ``RobotError`` where there is none."""
    roles = set(roles)
    if legs not in PLANS:
        counted = f"{legs} leg{'' if legs == 1 else 's'}"
        raise RobotError(
            f"{who} has {counted}; 2, 4 or 6 are possible: name the feet (--feet, foot_names) or legs (--legs)"
        )
    if "wheel" in roles:
        return "wheeled"
    return "humanoid" if legs == 2 and any(role.startswith("shoulder") for role in roles) else PLANS[legs]


def leg_names(feet: NDArray[np.float64], who: str) -> list[str]:
    """Return names for legs by the places of their feet [m], (F, 3); raise ``RobotError`` for two legs of one place."""
    forward, left = feet[:, 0] - feet[:, 0].mean(), feet[:, 1] - feet[:, 1].mean()
    sides = ["left" if y > 0.0 else "right" for y in left]
    rows = {2: ("",), 4: ("front", "rear"), 6: ("front", "middle", "rear")}.get(len(feet), ("",))
    names = [""] * len(feet)
    for side in ("left", "right"):
        own = sorted((i for i, s in enumerate(sides) if s == side), key=lambda i: -forward[i])
        if len(own) != len(rows):
            raise RobotError(f"{who}: {len(own)} of its {len(feet)} feet are on the {side}; half of them must be")
        for i, row in zip(own, rows, strict=True):
            names[i] = f"{row} {side}".strip()
    return names
