"""Walk a robot's kinematic tree: chains of joints, the ends of limbs, and the role of every joint.

Nothing depends on names. Axes are those of the model with all joints at zero, in the base's frame: x forward, y left, z up. A joint
about y is a pitch joint, about x roll, about z yaw.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

AXES = ("roll", "pitch", "yaw")
_BESIDE = 0.02
"""Smallest distance from the sagittal plane of a limb that has a side [m]."""
_ON_AXIS = 0.2
"""Largest distance of a wheel's centre from its joint's axis, as a share of the shape's radius."""
_TURN = 2.0 * np.pi


def joint_roles(
    model: mujoco.MjModel, base: int, legs: Sequence[Sequence[int]], feet: Sequence[int], wheels: Container[int] = ()
) -> dict[int, str]:
    """Return the role of each joint that moves something against the base, by MuJoCo's number of the joint.

    Args:
        base: body with the free joint.
        legs: joints of each leg from the base outwards.
        feet: a geom of each leg's foot.
        wheels: joints known to turn wheels; others are told by their shapes.
    """
    import mujoco

    data = mujoco.MjData(model)
    start = int(model.jnt_qposadr[model.body_jntadr[base]])
    data.qpos[start : start + 7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    mujoco.mj_kinematics(model, data)
    axis = {j: AXES[int(np.abs(data.xaxis[j]).argmax())] for j in range(model.njnt)}
    tips = moving_tips(model, base)
    chains = [joint_chain(model, tip, base) for tip in tips]
    # a joint that moves limbs on both sides is the waist's
    sides: dict[int, set[int]] = {}
    for tip, chain in zip(tips, chains, strict=True):
        left = float(data.xipos[tip, 1])
        for joint in chain:
            sides.setdefault(joint, set()).add(int(np.sign(left)) if abs(left) > _BESIDE else 0)
    waist = {joint for joint, found in sides.items() if {-1, 1} <= found}
    roles = {joint: f"waist_{axis[joint]}" for joint in waist}
    for leg, foot in zip(legs, feet, strict=True):
        own = [j for j in leg if j not in waist]
        turning = {j for j in own[-1:] if j in wheels or is_wheel(model, data, j, foot)}
        roles |= dict.fromkeys(turning, "wheel") | _leg_roles(data, [j for j in own if j not in turning], axis)
    limbs: dict[int, list[list[int]]] = {}
    for chain in chains:
        own = [j for j in chain if j not in waist]
        if own and own[0] not in roles:
            limbs.setdefault(own[0], []).append(own)
    for group in limbs.values():
        depth = 0
        while depth < min(map(len, group)) and len({chain[depth] for chain in group}) == 1:
            depth += 1
        head = sides[group[0][0]] == {0} and depth < 3
        names = {j: f"head_{axis[j]}" for j in group[0][:depth]} if head else _arm_roles(group[0][:depth], axis)
        roles |= {j: names.get(j, "hand") for chain in group for j in chain}
    return roles


def moving_tips(model: mujoco.MjModel, base: int) -> list[int]:
    """Return the bodies at the ends of the tree that joints move against the base: nothing that moves hangs on them."""
    moving = {b for b in range(model.nbody) if b != base and model.body_jntnum[b]}
    inner: set[int] = set()
    for body in moving:
        above = int(model.body_parentid[body])
        while above:
            inner.add(above)
            above = int(model.body_parentid[above])
    return sorted(moving - inner)


def joint_chain(model: mujoco.MjModel, body: int, base: int) -> list[int]:
    """Return the joints that move a body against the base, from the base outwards."""
    joints: list[int] = []
    while body not in (base, 0):
        first = int(model.body_jntadr[body])
        joints = [first + i for i in range(model.body_jntnum[body])] + joints
        body = int(model.body_parentid[body])
    return joints


def pitch_joints(data: mujoco.MjData, leg: Sequence[int]) -> list[int]:
    """Return a leg's joints that bend it: those about the y axis, or all but the first where fewer than two turn so."""
    across = [j for j in leg if int(np.abs(data.xaxis[j]).argmax()) == 1]
    return across if len(across) > 1 else list(leg[1:]) or list(leg)


def _leg_roles(data: mujoco.MjData, leg: Sequence[int], axis: Mapping[int, str]) -> dict[int, str]:
    roles = {}
    bends = pitch_joints(data, leg)
    knees = bends[1:2] if len(bends) < 4 else bends[1:-1]
    for place, joint in enumerate(leg):
        if joint in knees:
            roles[joint] = "knee"
        elif knees and place > leg.index(knees[-1]):
            roles[joint] = f"ankle_{'pitch' if joint in bends else axis[joint]}"
        else:
            roles[joint] = f"hip_{'pitch' if joint in bends else axis[joint]}"
    return roles


def _arm_roles(arm: Sequence[int], axis: Mapping[int, str]) -> dict[int, str]:
    """Name an arm's joints: the shoulder turns about each axis once at most, the elbow follows, and the wrist is the rest."""
    shoulder = 0
    while shoulder < min(len(arm), 3) and axis[arm[shoulder]] not in {axis[j] for j in arm[:shoulder]}:
        shoulder += 1
    if shoulder == len(arm) > 2:
        shoulder -= 1
    names = [
        *(f"shoulder_{axis[j]}" for j in arm[:shoulder]),
        "elbow",
        *(f"wrist_{axis[j]}" for j in arm[shoulder + 1 :]),
    ]
    return dict(zip(arm, names, strict=False))


def is_wheel(model: mujoco.MjModel, data: mujoco.MjData, joint: int, foot: int) -> bool:
    """Return whether a joint turns without end about the centre of a foot's shape, a geom."""
    if model.jnt_limited[joint] and float(np.ptp(model.jnt_range[joint])) < _TURN:
        return False
    away = data.geom_xpos[foot] - data.xanchor[joint]
    away = away - data.xaxis[joint] * (away @ data.xaxis[joint])
    return bool(np.linalg.norm(away) < _ON_AXIS * model.geom_rbound[foot])
