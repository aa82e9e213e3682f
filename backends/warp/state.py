# mypy: ignore-errors
"""The memory of a ``PhysicsState``: tensors for torch, arrays for kernels."""

# Warp reads the annotations of structs and kernels: no ``from __future__ import annotations`` here.
from dataclasses import fields

import torch
import warp as wp

from ..base import PhysicsState

wp.set_module_options({"enable_backward": False})

POSITION_LIMIT = wp.constant(1.0e5)
"""Largest position of a world that has not diverged [m, rad]."""
VELOCITY_LIMIT = wp.constant(1.0e4)
"""Largest velocity of a world that has not diverged [m/s, rad/s]."""


@wp.struct
class StateArrays:
    """The tensors of a ``PhysicsState``, seen by Warp."""

    time: wp.array[float]
    base_position_w: wp.array[wp.vec3]
    base_quaternion_w: wp.array[wp.vec4]
    base_linear_velocity_w: wp.array[wp.vec3]
    base_angular_velocity_b: wp.array[wp.vec3]
    joint_position: wp.array2d[float]
    joint_velocity: wp.array2d[float]
    joint_torque: wp.array2d[float]
    foot_position_w: wp.array2d[wp.vec3]
    foot_velocity_w: wp.array2d[wp.vec3]
    foot_contact_force_w: wp.array2d[wp.vec3]
    foot_normal_force: wp.array2d[float]
    foot_tangential_force: wp.array2d[float]
    body_contact_force_w: wp.array2d[wp.vec3]
    trunk_contact_force_w: wp.array[wp.vec3]
    ground_force_w: wp.array[wp.vec3]
    ground_moment_w: wp.array[wp.vec3]
    contact_center_w: wp.array[wp.vec3]
    contact_count: wp.array[wp.int64]
    tilt_substep: wp.array[wp.int64]
    penetration_substep: wp.array[wp.int64]
    diverged: wp.array[wp.bool]
    overflowed: wp.array[wp.bool]


def allocate_state(
    worlds: int, *, joints: int, feet: int, bodies: int, device: torch.device
) -> tuple[PhysicsState, StateArrays]:
    """Return a state of zeros as tensors, and the same memory for the kernels."""
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("joint_position", "joint_velocity", "joint_torque"), (joints,))
    shapes |= dict.fromkeys(("foot_position_w", "foot_velocity_w", "foot_contact_force_w"), (feet, 3))
    shapes |= dict.fromkeys(("foot_normal_force", "foot_tangential_force"), (feet,))
    shapes |= {"body_contact_force_w": (bodies, 3), "base_quaternion_w": (4,)}
    scalars = {"time": torch.float32, "diverged": torch.bool, "overflowed": torch.bool}
    scalars |= dict.fromkeys(("contact_count", "tilt_substep", "penetration_substep"), torch.int64)
    tensors, arrays = {}, StateArrays()
    for item in fields(PhysicsState):
        shape = () if item.name in scalars else shapes.get(item.name, (3,))
        tensor = torch.zeros((worlds, *shape), dtype=scalars.get(item.name, torch.float32), device=device)
        vector = item.name not in scalars and item.name.endswith(("_w", "_b"))
        kind = (wp.vec4 if shape == (4,) else wp.vec3) if vector else None
        setattr(arrays, item.name, wp.from_torch(tensor, dtype=kind))
        tensors[item.name] = tensor
    return PhysicsState(**tensors), arrays


@wp.func
def clear_parts(world: int, feet: int, bodies: int, out: StateArrays) -> None:
    """Zero the contact forces of a world's feet and bodies."""
    for foot in range(feet):
        out.foot_contact_force_w[world, foot] = wp.vec3(0.0)
        out.foot_normal_force[world, foot] = 0.0
        out.foot_tangential_force[world, foot] = 0.0
    for body in range(bodies):
        out.body_contact_force_w[world, body] = wp.vec3(0.0)
    out.trunk_contact_force_w[world] = wp.vec3(0.0)


@wp.kernel
def clear_forces(select: wp.array[int], value: int, joints: int, feet: int, bodies: int, out: StateArrays) -> None:
    """Zero all forces of the worlds with ``select == value``."""
    world = wp.tid()
    if select[world] != value:
        return
    for joint in range(joints):
        out.joint_torque[world, joint] = 0.0
    clear_parts(world, feet, bodies, out)
    out.ground_force_w[world] = wp.vec3(0.0)
    out.ground_moment_w[world] = wp.vec3(0.0)
    out.contact_center_w[world] = wp.vec3(0.0)
    out.contact_count[world] = wp.int64(0)
