# mypy: ignore-errors
# ruff: noqa: UP018, RUF046 - a variable that changes in a kernel's loop must be made by float(), int() or bool()
"""Warp kernels that read the state of chosen worlds out of mujoco_warp's data.

Floating-point sums run inside one thread in the order of the constraint rows: no atomics.
"""

# Warp reads the annotations of kernels: no ``from __future__ import annotations`` here.
import warp as wp

from ..warp.state import StateArrays, clear_parts
from .arrays import ContactArrays, Links, Motion, Roles

wp.set_module_options({"enable_backward": False})


@wp.kernel
def read_joints(
    select: wp.array[int], value: int, overflow_mask: int, motion: Motion, live: StateArrays, out: StateArrays
) -> None:
    """Read base and joints of the worlds with ``select == value``, and the flags of the live state."""
    world, joint = wp.tid()
    if select[world] != value:
        return
    out.joint_position[world, joint] = motion.qpos[world, motion.joint_q[joint]]
    out.joint_velocity[world, joint] = motion.qvel[world, motion.joint_v[joint]]
    if joint == 0:
        out.time[world] = motion.time[world]
        out.base_position_w[world] = wp.vec3(motion.qpos[world, 0], motion.qpos[world, 1], motion.qpos[world, 2])
        out.base_quaternion_w[world] = wp.vec4(
            motion.qpos[world, 3], motion.qpos[world, 4], motion.qpos[world, 5], motion.qpos[world, 6]
        )
        out.base_linear_velocity_w[world] = wp.vec3(motion.qvel[world, 0], motion.qvel[world, 1], motion.qvel[world, 2])
        out.base_angular_velocity_b[world] = wp.vec3(
            motion.qvel[world, 3], motion.qvel[world, 4], motion.qvel[world, 5]
        )
        out.tilt_substep[world] = live.tilt_substep[world]
        out.penetration_substep[world] = live.penetration_substep[world]
        out.diverged[world] = live.diverged[world]
        out.overflowed[world] = (motion.overflow[world] & overflow_mask) != 0


@wp.kernel
def read_feet(select: wp.array[int], value: int, links: Links, motion: Motion, out: StateArrays) -> None:
    """Read positions and velocities of the feet by forward kinematics along each foot's chain of links."""
    world, foot = wp.tid()
    if select[world] != value:
        return
    position = wp.vec3(motion.qpos[world, 0], motion.qpos[world, 1], motion.qpos[world, 2])
    rotation = wp.quat(motion.qpos[world, 4], motion.qpos[world, 5], motion.qpos[world, 6], motion.qpos[world, 3])
    velocity = wp.vec3(motion.qvel[world, 0], motion.qvel[world, 1], motion.qvel[world, 2])
    spin = wp.quat_rotate(rotation, wp.vec3(motion.qvel[world, 3], motion.qvel[world, 4], motion.qvel[world, 5]))
    for link in range(links.start[foot], links.start[foot + 1]):
        step = wp.quat_rotate(rotation, links.position[link])
        velocity = velocity + wp.cross(spin, step)
        position = position + step
        rotation = rotation * links.rotation[link]
        if links.hinge[link] != 0:
            axis = wp.quat_rotate(rotation, links.axis[link])
            to_anchor = wp.quat_rotate(rotation, links.anchor[link])
            velocity = velocity + wp.cross(spin, to_anchor)
            spin = spin + axis * motion.qvel[world, links.address_v[link]]
            angle = motion.qpos[world, links.address_q[link]] - links.zero[link]
            rotation = rotation * wp.quat_from_axis_angle(links.axis[link], angle)
            back = -wp.quat_rotate(rotation, links.anchor[link])
            velocity = velocity + wp.cross(spin, back)
            position = position + to_anchor + back
    reach = wp.quat_rotate(rotation, links.foot[foot])
    out.foot_position_w[world, foot] = position + reach
    out.foot_velocity_w[world, foot] = velocity + wp.cross(spin, reach)


@wp.func
def row_force(contacts: ContactArrays, world: int, contact: int, row: int) -> float:
    """Return the force of one constraint row of a contact; zero for a dropped row."""
    address = contacts.address[contact, row]
    if address < 0 or address >= contacts.row_capacity:
        return 0.0
    return contacts.row_force[world, address]


@wp.func
def local_wrench(contacts: ContactArrays, world: int, contact: int) -> wp.spatial_vector:
    """Return force and torque of a contact on the second geom, in the contact's frame (normal first).

    An elliptic cone has one row per direction. A pyramidal one has two opposite edges per tangential direction: their
    sum is normal force, their difference times the friction coefficient is the tangential one.
    """
    wrench = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    dimension = contacts.dimension[contact]
    if dimension == 1 or contacts.pyramidal == 0:
        for i in range(dimension):
            wrench[i] = row_force(contacts, world, contact, i)
    else:
        for i in range(dimension - 1):
            plus = row_force(contacts, world, contact, 2 * i)
            minus = row_force(contacts, world, contact, 2 * i + 1)
            wrench[0] += plus + minus
            wrench[i + 1] = (plus - minus) * contacts.friction[contact][i]
    return wrench


@wp.kernel
def read_contacts(
    select: wp.array[int],
    value: int,
    feet: int,
    bodies: int,
    contacts: ContactArrays,
    roles: Roles,
    motion: Motion,
    out: StateArrays,
) -> None:
    """Sum the ground's contact forces on each foot, body and the whole robot, row by row of the world's constraints."""
    world = wp.tid()
    if select[world] != value:
        return
    clear_parts(world, feet, bodies, out)
    # sum moments about the base, near the contacts, for precision, and move the sum afterwards
    base = wp.vec3(motion.qpos[world, 0], motion.qpos[world, 1], motion.qpos[world, 2])
    force = wp.vec3(0.0)
    moment = wp.vec3(0.0)
    center = wp.vec3(0.0)
    count = int(0)
    first = contacts.equality_rows[world] + contacts.friction_rows[world] + contacts.limit_rows[world]
    last = wp.min(contacts.row_count[world], contacts.row_capacity)
    if out.diverged[world]:
        last = 0
    for row in range(first, last):
        contact = contacts.row_id[world, row]
        if contacts.address[contact, 0] == row:  # count a contact at its first row
            pair = contacts.geom[contact]
            ground_first = roles.ground[pair[0]]
            if ground_first + roles.ground[pair[1]] == 1:
                sign = float(1.0)
                geom = pair[1]
                if ground_first == 0:
                    sign = -1.0
                    geom = pair[0]
                wrench = local_wrench(contacts, world, contact)
                frame = wp.transpose(contacts.frame[contact])
                push = frame * wp.spatial_top(wrench) * sign
                turn = frame * wp.spatial_bottom(wrench) * sign
                point = contacts.position[contact]
                force = force + push
                moment = moment + turn + wp.cross(point - base, push)
                if wrench[0] > 0.0:
                    center = center + (point - base)
                    count += 1
                foot = roles.foot[geom]
                body = roles.body[geom]
                if foot >= 0:
                    out.foot_contact_force_w[world, foot] = out.foot_contact_force_w[world, foot] + push
                    out.foot_normal_force[world, foot] = out.foot_normal_force[world, foot] + wrench[0]
                    out.foot_tangential_force[world, foot] = out.foot_tangential_force[world, foot] + wp.sqrt(
                        wrench[1] * wrench[1] + wrench[2] * wrench[2]
                    )
                elif body >= 0:
                    out.body_contact_force_w[world, body] = out.body_contact_force_w[world, body] + push
                    if roles.trunk[geom] == 1:
                        out.trunk_contact_force_w[world] = out.trunk_contact_force_w[world] + push
    if count > 0:
        center = center / float(count)
        moment = moment - wp.cross(center, force)
        center = center + base
    else:
        moment = moment + wp.cross(base, force)
    out.ground_force_w[world] = force
    out.ground_moment_w[world] = moment
    out.contact_center_w[world] = center
    out.contact_count[world] = wp.int64(count)
