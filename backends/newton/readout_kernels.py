# mypy: ignore-errors
# ruff: noqa: ANN201, UP018
"""Warp kernels that read Newton's state and contacts into the contract's tensors, and watch for deep penetration."""

# Warp reads the annotations of kernels: no ``from __future__ import annotations`` here.
import warp as wp

from ..warp.state import StateArrays
from .kernels import ContactArrays, Layout, Motion, Palette, root_origin_velocity, root_rotation

wp.set_module_options({"enable_backward": False})


@wp.func
def world_point(contacts: ContactArrays, shape: int, point: wp.vec3, body_q: wp.array[wp.transform]) -> wp.vec3:
    """Return a contact point in the world frame."""
    body = contacts.shape_body[shape]
    if body < 0:
        return point
    return wp.transform_point(body_q[body], point)


@wp.kernel
def watch_penetration(
    substep: int,
    depth: float,
    layout: Layout,
    active: wp.array[int],
    contacts: ContactArrays,
    palette: Palette,
    terrain: wp.array[int],
    body_q: wp.array[wp.transform],
    state: StateArrays,
):
    """Record the first substep with a part of the robot deeper than ``depth`` in a terrain box or height field."""
    c = wp.tid()
    if c >= contacts.count[0]:
        return
    first, second = contacts.shape0[c], contacts.shape1[c]
    if first < 0 or second < 0:
        return
    slot = wp.max(layout.shape_slot[first % layout.shapes], layout.shape_slot[second % layout.shapes])
    if slot < 0:
        return
    world = first / layout.shapes
    if active[world] == 0 or state.diverged[world] or palette.wall[terrain[world], slot] != 0:
        return
    one = world_point(contacts, first, contacts.point0[c], body_q)
    two = world_point(contacts, second, contacts.point1[c], body_q)
    distance = wp.dot(two - one, contacts.normal[c]) - contacts.margin0[c] - contacts.margin1[c]
    # several contacts of one world write the same number
    if distance < -depth and state.penetration_substep[world] == wp.int64(0):
        state.penetration_substep[world] = wp.int64(substep + 1)


@wp.kernel
def read_base_and_joints(
    select: wp.array[int],
    value: int,
    timestep: float,
    layout: Layout,
    ticks: wp.array[int],
    motion: Motion,
    body_com: wp.array[wp.vec3],
    live: StateArrays,
    out: StateArrays,
):
    """Read base and joints of the worlds with ``select == value``, and the flags of the live state."""
    world, joint = wp.tid()
    if select[world] != value:
        return
    out.joint_position[world, joint] = motion.joint_q[world * layout.coordinates + layout.joint_q[joint]]
    out.joint_velocity[world, joint] = motion.joint_qd[world * layout.dofs + layout.joint_v[joint]]
    if joint == 0:
        q = world * layout.coordinates
        v = world * layout.dofs
        rotation = root_rotation(motion.joint_q, q)
        spin = wp.vec3(motion.joint_qd[v + 3], motion.joint_qd[v + 4], motion.joint_qd[v + 5])
        out.time[world] = float(ticks[world]) * timestep
        out.base_position_w[world] = wp.vec3(motion.joint_q[q], motion.joint_q[q + 1], motion.joint_q[q + 2])
        out.base_quaternion_w[world] = wp.vec4(rotation[3], rotation[0], rotation[1], rotation[2])
        out.base_linear_velocity_w[world] = root_origin_velocity(layout, world, motion, body_com)
        out.base_angular_velocity_b[world] = wp.quat_rotate_inv(rotation, spin)
        out.tilt_substep[world] = live.tilt_substep[world]
        out.penetration_substep[world] = live.penetration_substep[world]
        out.diverged[world] = live.diverged[world]
        out.overflowed[world] = live.overflowed[world]


@wp.kernel
def read_feet(
    select: wp.array[int], value: int, layout: Layout, motion: Motion, body_com: wp.array[wp.vec3], out: StateArrays
):
    """Read positions and velocities of the feet."""
    world, foot = wp.tid()
    if select[world] != value:
        return
    body = world * layout.bodies + layout.foot_body[foot]
    position = wp.transform_point(motion.body_q[body], layout.foot_center[foot])
    arm = position - wp.transform_point(motion.body_q[body], body_com[body])
    twist = motion.body_qd[body]
    out.foot_position_w[world, foot] = position
    out.foot_velocity_w[world, foot] = wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)


@wp.kernel
def add_contacts(
    select: wp.array[int],
    value: int,
    layout: Layout,
    contacts: ContactArrays,
    body_q: wp.array[wp.transform],
    diverged: wp.array[wp.bool],
    out: StateArrays,
):
    """Add each ground contact's force to its foot, body and world.

    ``body_q`` are the poses of the collision detection. Moments and the centre are summed about the base in these poses, near
    the contacts, for precision; ``finish_contacts`` moves the sums.
    """
    c = wp.tid()
    if c >= wp.min(contacts.count[0], contacts.normal.shape[0]):
        return
    first, second = contacts.shape0[c], contacts.shape1[c]
    if first < 0 or second < 0:
        return
    world = first / layout.shapes
    if select[world] != value or diverged[world]:
        return
    ground_first = layout.shape_ground[first % layout.shapes]
    if ground_first + layout.shape_ground[second % layout.shapes] != 1:
        return
    # Newton reports the wrench on shape 0, at the contact point
    wrench = contacts.force[c]
    sign = float(1.0)
    shape = first % layout.shapes
    if ground_first == 1:
        sign = -1.0
        shape = second % layout.shapes
    force = wp.spatial_top(wrench) * sign
    normal = contacts.normal[c]
    along = wp.abs(wp.dot(force, normal))
    across = wp.length(force - normal * wp.dot(force, normal))
    if along <= 0.0 and across <= 0.0:
        return
    one = world_point(contacts, first, contacts.point0[c], body_q) + normal * contacts.margin0[c]
    two = world_point(contacts, second, contacts.point1[c], body_q) - normal * contacts.margin1[c]
    arm = 0.5 * (one + two) - wp.transform_get_translation(body_q[world * layout.bodies + layout.base])
    wp.atomic_add(out.ground_force_w, world, force)
    wp.atomic_add(out.ground_moment_w, world, wp.spatial_bottom(wrench) * sign + wp.cross(arm, force))
    if along > 0.0:
        wp.atomic_add(out.contact_center_w, world, arm)
        wp.atomic_add(out.contact_count, world, wp.int64(1))
    foot = layout.shape_foot[shape]
    body = layout.shape_body[shape]
    if foot >= 0:
        wp.atomic_add(out.foot_contact_force_w, world, foot, force)
        wp.atomic_add(out.foot_normal_force, world, foot, along)
        wp.atomic_add(out.foot_tangential_force, world, foot, across)
    elif body >= 0:
        wp.atomic_add(out.body_contact_force_w, world, body, force)
        if layout.shape_trunk[shape] == 1:
            wp.atomic_add(out.trunk_contact_force_w, world, force)


@wp.kernel
def finish_contacts(
    select: wp.array[int], value: int, layout: Layout, body_q: wp.array[wp.transform], out: StateArrays
):
    """Turn the sums of ``add_contacts`` into the mean contact point and the moment about it."""
    world = wp.tid()
    if select[world] != value:
        return
    count = int(out.contact_count[world])
    if count == 0:
        out.contact_center_w[world] = wp.vec3(0.0)
        return
    base = wp.transform_get_translation(body_q[world * layout.bodies + layout.base])
    center = out.contact_center_w[world] / float(count)
    out.ground_moment_w[world] = out.ground_moment_w[world] - wp.cross(center, out.ground_force_w[world])
    out.contact_center_w[world] = center + base
