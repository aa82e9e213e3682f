# mypy: ignore-errors
# ruff: noqa: ANN201, UP018
"""Warp kernels around a Newton solver: motor law, latency, divergence, resets, terrain slots, pushes.

The kernels use Newton's own arrays only (joint coordinates, body poses and twists, contacts and contact forces) and so serve
every solver. Joints, bodies and shapes of all worlds lie one world after the other: entry ``world * per_world + local``.

Newton's conventions: quaternions xyzw; a free joint's velocity is that of the body's centre of mass and its angular
velocity, both in the world frame; ``body_qd`` likewise. The contract's are wxyz, the base's origin and the body frame.
"""

# Warp reads the annotations of kernels: no ``from __future__ import annotations`` here.
import warp as wp

from ..warp.motors import Motors, begin_world, hold_target, motor_torque, reset_world, take_target
from ..warp.state import POSITION_LIMIT, VELOCITY_LIMIT, StateArrays

wp.set_module_options({"enable_backward": False})

PARKED_HEIGHT = wp.constant(100.0)
"""Height of the base of a diverged world until its reset [m]."""


@wp.struct
class Layout:
    """Places of the robot's parts in a world's share of Newton's arrays."""

    coordinates: int
    dofs: int
    bodies: int
    shapes: int
    base: int
    joint_q: wp.array[int]
    joint_v: wp.array[int]
    foot_body: wp.array[int]
    foot_center: wp.array[wp.vec3]
    """Centre of each foot in the frame of its body [m]."""
    shape_foot: wp.array[int]
    """Index of a shape's foot, -1 for other shapes."""
    shape_body: wp.array[int]
    """Index of a shape's collision body, -1 for the ground and others."""
    shape_trunk: wp.array[int]
    """1 for the trunk's shapes."""
    shape_ground: wp.array[int]
    """1 for floor, walls and terrain."""
    shape_slot: wp.array[int]
    """Terrain slot of a shape, -1 for robot and floor."""


@wp.struct
class Motion:
    """One of Newton's states, with what the solver carries from step to step."""

    joint_q: wp.array[float]
    joint_qd: wp.array[float]
    body_q: wp.array[wp.transform]
    body_qd: wp.array[wp.spatial_vector]
    body_f: wp.array[wp.spatial_vector]
    """External force and torque on each body."""
    warm_start: wp.array2d[float]


@wp.struct
class Palette:
    """Shapes of the palette's terrains, by terrain and slot: the boxes and, where there is one, the height field."""

    pose: wp.array2d[wp.transform]
    scale: wp.array2d[wp.vec3]
    wall: wp.array2d[int]


@wp.struct
class ContactArrays:
    """Newton's contacts of all worlds with the solver's forces."""

    count: wp.array[int]
    shape0: wp.array[int]
    shape1: wp.array[int]
    point0: wp.array[wp.vec3]
    point1: wp.array[wp.vec3]
    margin0: wp.array[float]
    margin1: wp.array[float]
    normal: wp.array[wp.vec3]
    force: wp.array[wp.spatial_vector]
    shape_body: wp.array[int]
    """Newton's body of each shape, -1 for the ground."""


@wp.func
def root_rotation(joint_q: wp.array[float], start: int) -> wp.quat:
    """Return the orientation of the base."""
    return wp.normalize(wp.quat(joint_q[start + 3], joint_q[start + 4], joint_q[start + 5], joint_q[start + 6]))


@wp.func
def root_origin_velocity(layout: Layout, world: int, motion: Motion, com: wp.array[wp.vec3]) -> wp.vec3:
    """Return the velocity of the base's origin, world frame, from that of its centre of mass."""
    v = world * layout.dofs
    spin = wp.vec3(motion.joint_qd[v + 3], motion.joint_qd[v + 4], motion.joint_qd[v + 5])
    rotation = root_rotation(motion.joint_q, world * layout.coordinates)
    arm = wp.quat_rotate(rotation, com[world * layout.bodies + layout.base])
    return wp.vec3(motion.joint_qd[v], motion.joint_qd[v + 1], motion.joint_qd[v + 2]) - wp.cross(spin, arm)


@wp.func
def park(layout: Layout, world: int, motion: Motion):
    """Put a diverged world at rest, high above the ground."""
    for i in range(layout.coordinates):
        motion.joint_q[world * layout.coordinates + i] = 0.0
    motion.joint_q[world * layout.coordinates + 2] = PARKED_HEIGHT
    motion.joint_q[world * layout.coordinates + 6] = 1.0
    for i in range(layout.dofs):
        motion.joint_qd[world * layout.dofs + i] = 0.0
    for i in range(layout.bodies):
        body = world * layout.bodies + i
        motion.body_q[body] = wp.transform(wp.vec3(0.0, 0.0, PARKED_HEIGHT), wp.quat_identity())
        motion.body_qd[body] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@wp.func
def state_is_valid(layout: Layout, world: int, motion: Motion) -> bool:
    """Return whether all coordinates and velocities of a world are finite and within the limits."""
    valid = bool(True)
    for i in range(layout.coordinates):
        if not (wp.abs(motion.joint_q[world * layout.coordinates + i]) < POSITION_LIMIT):  # false for NaN, too
            valid = False
    for i in range(layout.dofs):
        if not (wp.abs(motion.joint_qd[world * layout.dofs + i]) < VELOCITY_LIMIT):
            valid = False
    return valid


@wp.kernel
def begin_period(
    layout: Layout,
    active: wp.array[int],
    has_request: wp.array[int],
    joints: int,
    motors: Motors,
    motion: Motion,
    state: StateArrays,
):
    """Shift the targets and clear the watches of the worlds that will step; park invalid ones."""
    world = wp.tid()
    if active[world] == 0:
        return
    valid = state_is_valid(layout, world, motion)
    for joint in range(joints):
        take_target(motors, world, joint, has_request[0])
        if has_request[0] != 0 and not (wp.abs(motors.requested[world, joint]) < POSITION_LIMIT):
            valid = False
    begin_world(motors, world, has_request[0], state)
    if not valid:
        state.diverged[world] = True
    if state.diverged[world]:
        park(layout, world, motion)


@wp.kernel
def copy_inactive(layout: Layout, active: wp.array[int], source: Motion, target: Motion):
    """Copy the state of the worlds that must not step, away before a step and back after it."""
    world, i = wp.tid()
    if active[world] != 0:
        return
    q = world * layout.coordinates + i
    v = world * layout.dofs + i
    b = world * layout.bodies + i
    if i < layout.coordinates:
        target.joint_q[q] = source.joint_q[q]
    if i < layout.dofs:
        target.joint_qd[v] = source.joint_qd[v]
    if i < layout.bodies:
        target.body_q[b] = source.body_q[b]
        target.body_qd[b] = source.body_qd[b]
    if i < source.warm_start.shape[1]:
        target.warm_start[world, i] = source.warm_start[world, i]


@wp.kernel
def motor_law(
    substep: int,
    layout: Layout,
    motors: Motors,
    dry_friction: wp.array[float],
    dry_slope: wp.array[float],
    diverged: wp.array[wp.bool],
    motion: Motion,
    joint_f: wp.array[float],
):
    """Apply the motor law and, for solvers without it, dry friction [N·m] with its slope around zero speed [N·m·s/rad]."""
    world, joint = wp.tid()
    dof = world * layout.dofs + layout.joint_v[joint]
    position = motion.joint_q[world * layout.coordinates + layout.joint_q[joint]]
    velocity = motion.joint_qd[dof]
    torque = motor_torque(motors, world, joint, substep, position, velocity)
    if diverged[world]:
        torque = 0.0
    motors.torque[world, joint] = torque
    dry = dry_friction[joint]
    joint_f[dof] = torque - wp.clamp(dry_slope[joint] * velocity, -dry, dry)


@wp.kernel
def end_substep(
    substep: int,
    upright_limit: float,
    layout: Layout,
    active: wp.array[int],
    motion: Motion,
    ticks: wp.array[int],
    state: StateArrays,
):
    """Count the time, park worlds with an invalid state, and watch the tilt of the others."""
    world = wp.tid()
    if active[world] == 0:
        return
    ticks[world] = ticks[world] + 1
    if not state_is_valid(layout, world, motion):
        state.diverged[world] = True
    if state.diverged[world]:
        park(layout, world, motion)
        for i in range(motion.warm_start.shape[1]):
            motion.warm_start[world, i] = 0.0
        return
    q = world * layout.coordinates
    x, y = motion.joint_q[q + 3], motion.joint_q[q + 4]
    upright = 1.0 - 2.0 * (x * x + y * y)
    if upright < upright_limit and state.tilt_substep[world] == wp.int64(0):
        state.tilt_substep[world] = wp.int64(substep + 1)


@wp.kernel
def collect_overflow_bits(active: wp.array[int], bits: wp.array[int], mask: int, overflowed: wp.array[wp.bool]):
    """Note the worlds in which a solver reports one of the masked overflows."""
    world = wp.tid()
    if active[world] != 0 and (bits[world] & mask) != 0:
        overflowed[world] = True


@wp.kernel
def collect_overflow_flags(active: wp.array[int], flags: wp.array[wp.bool], overflowed: wp.array[wp.bool]):
    """Note the worlds that a solver flags."""
    world = wp.tid()
    if active[world] != 0 and flags[world]:
        overflowed[world] = True


@wp.kernel
def reset_worlds(
    layout: Layout,
    active: wp.array[int],
    has_held: wp.array[int],
    pose: wp.array2d[float],
    twist: wp.array2d[float],
    joint_position: wp.array2d[float],
    joint_velocity: wp.array2d[float],
    body_com: wp.array[wp.vec3],
    motors: Motors,
    motion: Motion,
    other: Motion,
    ticks: wp.array[int],
    state: StateArrays,
):
    """Put the masked worlds into the given state, without external forces in ``other``, too; ``requested`` holds the held targets."""
    world, joint = wp.tid()
    if active[world] == 0:
        return
    motion.joint_q[world * layout.coordinates + layout.joint_q[joint]] = joint_position[world, joint]
    motion.joint_qd[world * layout.dofs + layout.joint_v[joint]] = joint_velocity[world, joint]
    hold_target(motors, world, joint, has_held[0])
    if joint == 0:
        q = world * layout.coordinates
        v = world * layout.dofs
        rotation = wp.normalize(wp.quat(pose[world, 4], pose[world, 5], pose[world, 6], pose[world, 3]))
        spin = wp.quat_rotate(rotation, wp.vec3(twist[world, 3], twist[world, 4], twist[world, 5]))
        arm = wp.quat_rotate(rotation, body_com[world * layout.bodies + layout.base])
        velocity = wp.vec3(twist[world, 0], twist[world, 1], twist[world, 2]) + wp.cross(spin, arm)
        for i in range(3):
            motion.joint_q[q + i] = pose[world, i]
            motion.joint_qd[v + i] = velocity[i]
            motion.joint_qd[v + 3 + i] = spin[i]
        for i in range(4):
            motion.joint_q[q + 3 + i] = rotation[i]
        for i in range(layout.bodies):
            motion.body_f[world * layout.bodies + i] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            other.body_f[world * layout.bodies + i] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        ticks[world] = 0
        reset_world(motors, world, has_held[0], state)


@wp.kernel
def place_terrain(
    layout: Layout,
    active: wp.array[int],
    requested: wp.array[int],
    terrains: int,
    slot_shape: wp.array[int],
    palette: Palette,
    terrain: wp.array[int],
    shape_transform: wp.array[wp.transform],
    shape_scale: wp.array[wp.vec3],
):
    """Write the boxes and the height field of the masked worlds' new terrains."""
    world, slot = wp.tid()
    if active[world] == 0:
        return
    index = wp.clamp(requested[world], 0, terrains - 1)
    if slot == 0:
        terrain[world] = index
    if slot >= slot_shape.shape[0]:
        return
    shape = world * layout.shapes + slot_shape[slot]
    shape_transform[shape] = palette.pose[index, slot]
    shape_scale[shape] = palette.scale[index, slot]


@wp.kernel
def push_base(
    layout: Layout, active: wp.array[int], twist: wp.array2d[float], body_com: wp.array[wp.vec3], motion: Motion
):
    """Set the base's velocities; NaN keeps the present value."""
    world = wp.tid()
    if active[world] == 0:
        return
    v = world * layout.dofs
    rotation = root_rotation(motion.joint_q, world * layout.coordinates)
    velocity = root_origin_velocity(layout, world, motion, body_com)
    turning = wp.vec3(motion.joint_qd[v + 3], motion.joint_qd[v + 4], motion.joint_qd[v + 5])
    spin = wp.quat_rotate_inv(rotation, turning)
    for i in range(3):
        if not wp.isnan(twist[world, i]):
            velocity[i] = twist[world, i]
        if not wp.isnan(twist[world, 3 + i]):
            spin[i] = twist[world, 3 + i]
    spin = wp.quat_rotate(rotation, spin)
    velocity = velocity + wp.cross(spin, wp.quat_rotate(rotation, body_com[world * layout.bodies + layout.base]))
    for i in range(3):
        motion.joint_qd[v + i] = velocity[i]
        motion.joint_qd[v + 3 + i] = spin[i]


@wp.kernel
def move_center_of_mass(
    layout: Layout, nominal: wp.vec3, offset: wp.array2d[float], body_com: wp.array[wp.vec3], motion: Motion
):
    """Shift the base's centre of mass, and adapt its velocity so that the base's motion stays."""
    world = wp.tid()
    velocity = root_origin_velocity(layout, world, motion, body_com)
    center = nominal + wp.vec3(offset[world, 0], offset[world, 1], offset[world, 2])
    body_com[world * layout.bodies + layout.base] = center
    v = world * layout.dofs
    spin = wp.vec3(motion.joint_qd[v + 3], motion.joint_qd[v + 4], motion.joint_qd[v + 5])
    rotation = root_rotation(motion.joint_q, world * layout.coordinates)
    velocity = velocity + wp.cross(spin, wp.quat_rotate(rotation, center))
    for i in range(3):
        motion.joint_qd[v + i] = velocity[i]
