# mypy: ignore-errors
# ruff: noqa: UP018 - a variable that changes in a kernel's loop must be made by float(), int() or bool()
"""Warp kernels around mujoco_warp's step: motor law, latency, watches, terrain slots, pushes and resets.

One thread per world, or per world and joint or terrain slot. Every kernel takes masks from device memory, without the host.
"""

# Warp reads the annotations of kernels: no ``from __future__ import annotations`` here.
import warp as wp

from ..warp.motors import Motors, begin_world, hold_target, motor_torque, reset_world, take_target
from ..warp.state import POSITION_LIMIT, VELOCITY_LIMIT, StateArrays
from .arrays import ContactArrays, Motion, Palette, Roles

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_period(active: wp.array[int], has_request: wp.array[int], motors: Motors, state: StateArrays) -> None:
    """Shift the targets and clear the watches of the worlds that will step."""
    world, joint = wp.tid()
    if active[world] == 0:
        return
    take_target(motors, world, joint, has_request[0])
    if joint == 0:
        begin_world(motors, world, has_request[0], state)


@wp.kernel
def copy_inactive(active: wp.array[int], source: Motion, target: Motion) -> None:
    """Copy the state of the worlds that must not step, away before a step and back after it."""
    world, i = wp.tid()
    if active[world] != 0:
        return
    if i < source.positions:
        target.qpos[world, i] = source.qpos[world, i]
    if i < source.velocities:
        target.qvel[world, i] = source.qvel[world, i]
        target.warmstart[world, i] = source.warmstart[world, i]
    if i == 0:
        target.time[world] = source.time[world]
        target.overflow[world] = source.overflow[world]


@wp.func
def park(world: int, parked_qpos: wp.array[float], motion: Motion) -> None:
    """Put a robot at rest, out of reach."""
    for i in range(motion.positions):
        motion.qpos[world, i] = parked_qpos[i]
    for i in range(motion.velocities):
        motion.qvel[world, i] = 0.0
        motion.warmstart[world, i] = 0.0


@wp.kernel
def park_inactive(active: wp.array[int], parked_qpos: wp.array[float], motion: Motion) -> None:
    """Park the robots that must not step, to save collision time."""
    world = wp.tid()
    if active[world] == 0:
        park(world, parked_qpos, motion)


@wp.kernel
def motor_law(substep: int, motors: Motors, motion: Motion) -> None:
    """Apply the motor law with the target of this substep (from 0)."""
    world, joint = wp.tid()
    position, velocity = motion.qpos[world, motion.joint_q[joint]], motion.qvel[world, motion.joint_v[joint]]
    torque = motor_torque(motors, world, joint, substep, position, velocity)
    motors.torque[world, joint] = torque
    motion.applied[world, motion.joint_v[joint]] = torque


@wp.kernel
def end_substep(
    substep: int,
    upright_limit: float,
    active: wp.array[int],
    parked_qpos: wp.array[float],
    motion: Motion,
    state: StateArrays,
) -> None:
    """Mark worlds with an invalid state, park them out of reach, and watch the tilt of the others."""
    world = wp.tid()
    if active[world] == 0:
        return
    valid = bool(True)
    for i in range(motion.positions):
        if not (wp.abs(motion.qpos[world, i]) < POSITION_LIMIT):  # false for NaN, too
            valid = False
    for i in range(motion.velocities):
        if not (wp.abs(motion.qvel[world, i]) < VELOCITY_LIMIT):
            valid = False
    if state.diverged[world] or not valid:
        state.diverged[world] = True
        park(world, parked_qpos, motion)
        return
    x, y = motion.qpos[world, 4], motion.qpos[world, 5]
    upright = 1.0 - 2.0 * (x * x + y * y)
    if upright < upright_limit and state.tilt_substep[world] == wp.int64(0):
        state.tilt_substep[world] = wp.int64(substep + 1)


@wp.kernel
def watch_penetration(
    substep: int,
    depth: float,
    active: wp.array[int],
    contacts: ContactArrays,
    roles: Roles,
    palette: Palette,
    terrain: wp.array[int],
    state: StateArrays,
) -> None:
    """Record the first substep with a part of the robot deeper than ``depth`` in a terrain box or height field."""
    contact = wp.tid()
    if contact >= contacts.count[0]:
        return
    if contacts.distance[contact] >= -depth:
        return
    world = contacts.world[contact]
    if active[world] == 0 or state.diverged[world]:
        return
    pair = contacts.geom[contact]
    slot = wp.max(roles.slot[pair[0]], roles.slot[pair[1]])
    if slot < 0:
        return
    if palette.wall[terrain[world], slot] != 0:
        return
    # several contacts of one world write the same number
    if state.penetration_substep[world] == wp.int64(0):
        state.penetration_substep[world] = wp.int64(substep + 1)


@wp.kernel
def reset_worlds(
    active: wp.array[int],
    has_held: wp.array[int],
    pose: wp.array2d[float],
    twist: wp.array2d[float],
    joint_position: wp.array2d[float],
    joint_velocity: wp.array2d[float],
    motors: Motors,
    motion: Motion,
    state: StateArrays,
) -> None:
    """Put the masked worlds into the given state. ``requested`` holds the held targets."""
    world, joint = wp.tid()
    if active[world] == 0:
        return
    motion.qpos[world, motion.joint_q[joint]] = joint_position[world, joint]
    motion.qvel[world, motion.joint_v[joint]] = joint_velocity[world, joint]
    hold_target(motors, world, joint, has_held[0])
    if joint == 0:
        w, x, y, z = pose[world, 3], pose[world, 4], pose[world, 5], pose[world, 6]
        length = wp.sqrt(w * w + x * x + y * y + z * z)
        for i in range(3):
            motion.qpos[world, i] = pose[world, i]
        for i in range(3, 7):
            motion.qpos[world, i] = pose[world, i] / length
        for i in range(6):
            motion.qvel[world, i] = twist[world, i]
        for i in range(motion.velocities):
            motion.warmstart[world, i] = 0.0
            motion.applied[world, i] = 0.0
        for i in range(motion.bodies):
            motion.external[world, i] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        motion.time[world] = 0.0
        motion.overflow[world] = 0
        reset_world(motors, world, has_held[0], state)


@wp.kernel
def place_terrain(
    active: wp.array[int],
    requested: wp.array[int],
    terrains: int,
    slots: int,
    slot_geom: wp.array[int],
    palette: Palette,
    terrain: wp.array[int],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    geom_size: wp.array2d[wp.vec3],
    geom_aabb: wp.array3d[wp.vec3],
    geom_rbound: wp.array2d[float],
    geom_dataid: wp.array2d[int],
    has_field: int,
) -> None:
    """Write the boxes and the height field of the masked worlds' new terrains.

    mujoco_warp computes poses of static geoms only once, when its data are made, so that poses written here last.
    """
    world, slot = wp.tid()
    if active[world] == 0:
        return
    index = wp.clamp(requested[world], 0, terrains - 1)
    if slot == 0:
        terrain[world] = index
    if slot >= slots:
        return
    geom = slot_geom[slot]
    geom_xpos[world, geom] = palette.position[index, slot]
    geom_xmat[world, geom] = palette.rotation[index, slot]
    geom_size[world, geom] = palette.size[index, slot]
    geom_aabb[world, geom, 0] = palette.bound_center[index, slot]
    geom_aabb[world, geom, 1] = palette.bound_half[index, slot]
    geom_rbound[world, geom] = palette.radius[index, slot]
    if has_field != 0 and slot == slots - 1:
        geom_dataid[world, geom] = palette.field[index]


@wp.kernel
def push_base(active: wp.array[int], twist: wp.array2d[float], motion: Motion) -> None:
    """Set the base's velocities; NaN keeps the present value."""
    world, i = wp.tid()
    if active[world] == 0:
        return
    value = twist[world, i]
    if not wp.isnan(value):
        motion.qvel[world, i] = value
