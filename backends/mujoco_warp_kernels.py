# mypy: ignore-errors
"""Warp kernels around mujoco_warp's step: motor law, latency, watches, terrain slots, resets and the read-out of the state.

One thread per world, or per world and joint, foot or terrain slot. Every kernel takes masks from device memory, so that none of
them needs the host. Floating-point sums run inside one thread in a fixed order: no atomics.
"""

# Warp reads the annotations of kernels: no ``from __future__ import annotations`` here.
import warp as wp

wp.set_module_options({"enable_backward": False})

vec5 = wp.types.vector(length=5, dtype=wp.float32)

POSITION_LIMIT = wp.constant(1.0e5)
"""A position beyond this [m, rad] means that the world has diverged."""
VELOCITY_LIMIT = wp.constant(1.0e4)
"""A velocity beyond this [m/s, rad/s] means that the world has diverged."""


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
    ground_force_w: wp.array[wp.vec3]
    ground_moment_w: wp.array[wp.vec3]
    contact_center_w: wp.array[wp.vec3]
    contact_count: wp.array[wp.int64]
    tilt_substep: wp.array[wp.int64]
    penetration_substep: wp.array[wp.int64]
    diverged: wp.array[wp.bool]
    overflowed: wp.array[wp.bool]


@wp.struct
class Motors:
    """Motor law and targets of every world and joint."""

    joint_q: wp.array[int]
    """Address of each joint in qpos."""
    joint_v: wp.array[int]
    """Address of each joint in qvel."""
    limit: wp.array[float]
    stiffness: wp.array2d[float]
    damping: wp.array2d[float]
    strength: wp.array2d[float]
    offset: wp.array2d[float]
    requested: wp.array2d[float]
    """Targets handed to the present step."""
    current: wp.array2d[float]
    previous: wp.array2d[float]
    """Target that still acts while the delay lasts."""
    limp: wp.array[int]
    limp_before: wp.array[int]
    delay: wp.array[int]
    torque: wp.array2d[float]


@wp.struct
class Links:
    """Chains of links from the base to each foot, one after the other."""

    start: wp.array[int]
    """First link of each foot, and the total at the end."""
    position: wp.array[wp.vec3]
    rotation: wp.array[wp.quat]
    hinge: wp.array[int]
    """Whether the link ends in a hinge."""
    axis: wp.array[wp.vec3]
    anchor: wp.array[wp.vec3]
    address_q: wp.array[int]
    address_v: wp.array[int]
    zero: wp.array[float]
    """Joint angle at which the link's fixed rotation holds."""
    foot: wp.array[wp.vec3]
    """Centre of each foot in the frame of its last link."""


@wp.struct
class Roles:
    """What each geom is."""

    foot: wp.array[int]
    """Index of the foot, -1 for other geoms."""
    body: wp.array[int]
    """Index of the collision body, -1 for the ground and bodies that are not reported."""
    ground: wp.array[int]
    """1 for floor, walls and terrain."""
    slot: wp.array[int]
    """Index of the terrain slot: boxes 0..S-1, the height field S; -1 for floor and robot."""


@wp.struct
class Palette:
    """Terrain shapes by terrain and slot. Slots are the boxes and, last, the height field."""

    position: wp.array2d[wp.vec3]
    rotation: wp.array2d[wp.mat33]
    size: wp.array2d[wp.vec3]
    bound_center: wp.array2d[wp.vec3]
    bound_half: wp.array2d[wp.vec3]
    radius: wp.array2d[float]
    field: wp.array[int]
    """Height field of the terrain, 0 where it has none (the geom is parked then)."""
    wall: wp.array2d[int]


@wp.struct
class ContactArrays:
    """mujoco_warp's contacts and constraint forces."""

    count: wp.array[int]
    world: wp.array[int]
    geom: wp.array[wp.vec2i]
    distance: wp.array[float]
    position: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    friction: wp.array[vec5]
    dimension: wp.array[int]
    address: wp.array2d[int]
    row_count: wp.array[int]
    equality_rows: wp.array[int]
    friction_rows: wp.array[int]
    limit_rows: wp.array[int]
    row_id: wp.array2d[int]
    row_force: wp.array2d[float]
    row_capacity: int
    pyramidal: int


@wp.kernel
def begin_period(active: wp.array[int], has_request: wp.array[int], motors: Motors, state: StateArrays):
    """Shift the targets and clear the watches of the worlds that will step."""
    world, joint = wp.tid()
    if active[world] == 0:
        return
    motors.previous[world, joint] = motors.current[world, joint]
    if has_request[0] != 0:
        motors.current[world, joint] = motors.requested[world, joint]
    if joint == 0:
        motors.limp_before[world] = motors.limp[world]
        if has_request[0] != 0:
            motors.limp[world] = 0
        state.tilt_substep[world] = wp.int64(0)
        state.penetration_substep[world] = wp.int64(0)


@wp.kernel
def keep_inactive(
    active: wp.array[int],
    restore: int,
    positions: int,
    velocities: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    time: wp.array[float],
    overflow: wp.array[int],
    kept: wp.array2d[float],
    kept_overflow: wp.array[int],
):
    """Save (or restore) what a step changes in the worlds that must not step."""
    world, i = wp.tid()
    if active[world] != 0:
        return
    if restore == 0:
        if i < positions:
            kept[world, i] = qpos[world, i]
        if i < velocities:
            kept[world, positions + i] = qvel[world, i]
            kept[world, positions + velocities + i] = warmstart[world, i]
        if i == 0:
            kept[world, positions + 2 * velocities] = time[world]
            kept_overflow[world] = overflow[world]
    else:
        if i < positions:
            qpos[world, i] = kept[world, i]
        if i < velocities:
            qvel[world, i] = kept[world, positions + i]
            warmstart[world, i] = kept[world, positions + velocities + i]
        if i == 0:
            time[world] = kept[world, positions + 2 * velocities]
            overflow[world] = kept_overflow[world]


@wp.kernel
def motor_law(
    substep: int, motors: Motors, qpos: wp.array2d[float], qvel: wp.array2d[float], applied: wp.array2d[float]
):
    """Torque = clip(kp (target + offset - q) - kd q̇) · strength, with the target that acts in this substep (counted from 0)."""
    world, joint = wp.tid()
    target = motors.current[world, joint]
    limp = motors.limp[world]
    if substep < motors.delay[world]:
        target = motors.previous[world, joint]
        limp = motors.limp_before[world]
    position = qpos[world, motors.joint_q[joint]]
    velocity = qvel[world, motors.joint_v[joint]]
    error = target + motors.offset[world, joint] - position
    torque = motors.stiffness[world, joint] * error - motors.damping[world, joint] * velocity
    torque = wp.clamp(torque, -motors.limit[joint], motors.limit[joint]) * motors.strength[world, joint]
    if limp != 0:
        torque = 0.0
    motors.torque[world, joint] = torque
    applied[world, motors.joint_v[joint]] = torque


@wp.kernel
def end_substep(
    substep: int,
    upright_limit: float,
    active: wp.array[int],
    parked_qpos: wp.array[float],
    positions: int,
    velocities: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    state: StateArrays,
):
    """Catch worlds whose state became invalid, park them out of reach of the ground, and watch the tilt of the others."""
    world = wp.tid()
    if active[world] == 0:
        return
    valid = bool(True)
    for i in range(positions):
        if not (wp.abs(qpos[world, i]) < POSITION_LIMIT):  # false for NaN, too
            valid = False
    for i in range(velocities):
        if not (wp.abs(qvel[world, i]) < VELOCITY_LIMIT):
            valid = False
    if state.diverged[world] or not valid:
        state.diverged[world] = True
        for i in range(positions):
            qpos[world, i] = parked_qpos[i]
        for i in range(velocities):
            qvel[world, i] = 0.0
            warmstart[world, i] = 0.0
        return
    upright = 1.0 - 2.0 * (qpos[world, 4] * qpos[world, 4] + qpos[world, 5] * qpos[world, 5])
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
):
    """Record the substep in which a part of the robot is deeper than ``depth`` in a terrain box or height field."""
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
def correct_field_contacts(
    count: wp.array[int],
    geom: wp.array[wp.vec2i],
    frame: wp.array[wp.mat33],
    margin: wp.array[float],
    field: int,
    distance: wp.array[float],
    position: wp.array[wp.vec3],
):
    """Take the contact margin out of the distances of height-field contacts.

    mujoco_warp 3.17 lifts the field's surface by the margin and inflates the other geom by half of it, but reports the distance
    between these: contacts would begin with a jolt, and feet would stand that much too high. (Its other shapes are right.)
    """
    contact = wp.tid()
    if contact >= count[0]:
        return
    if geom[contact][0] != field:
        return
    normal = wp.vec3(frame[contact][0, 0], frame[contact][0, 1], frame[contact][0, 2])
    lift = margin[contact] * normal[2]
    inflation = 0.5 * margin[contact]
    distance[contact] = distance[contact] + lift + inflation
    position[contact] = position[contact] - normal * (0.5 * (lift - inflation))


@wp.kernel
def read_joints(
    select: wp.array[int],
    value: int,
    motors: Motors,
    time: wp.array[float],
    overflow: wp.array[int],
    overflow_mask: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    live: StateArrays,
    out: StateArrays,
):
    """Base and joints of the worlds whose ``select`` equals ``value``, and the flags of the live state."""
    world, joint = wp.tid()
    if select[world] != value:
        return
    out.joint_position[world, joint] = qpos[world, motors.joint_q[joint]]
    out.joint_velocity[world, joint] = qvel[world, motors.joint_v[joint]]
    if joint == 0:
        out.time[world] = time[world]
        out.base_position_w[world] = wp.vec3(qpos[world, 0], qpos[world, 1], qpos[world, 2])
        out.base_quaternion_w[world] = wp.vec4(qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6])
        out.base_linear_velocity_w[world] = wp.vec3(qvel[world, 0], qvel[world, 1], qvel[world, 2])
        out.base_angular_velocity_b[world] = wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5])
        out.tilt_substep[world] = live.tilt_substep[world]
        out.penetration_substep[world] = live.penetration_substep[world]
        out.diverged[world] = live.diverged[world]
        out.overflowed[world] = (overflow[world] & overflow_mask) != 0


@wp.kernel
def read_feet(
    select: wp.array[int],
    value: int,
    links: Links,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    out: StateArrays,
):
    """Positions and velocities of the feet: forward kinematics along each foot's own chain of links."""
    world, foot = wp.tid()
    if select[world] != value:
        return
    position = wp.vec3(qpos[world, 0], qpos[world, 1], qpos[world, 2])
    rotation = wp.quat(qpos[world, 4], qpos[world, 5], qpos[world, 6], qpos[world, 3])
    velocity = wp.vec3(qvel[world, 0], qvel[world, 1], qvel[world, 2])
    spin = wp.quat_rotate(rotation, wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5]))
    for link in range(links.start[foot], links.start[foot + 1]):
        step = wp.quat_rotate(rotation, links.position[link])
        velocity = velocity + wp.cross(spin, step)
        position = position + step
        rotation = rotation * links.rotation[link]
        if links.hinge[link] != 0:
            axis = wp.quat_rotate(rotation, links.axis[link])
            to_anchor = wp.quat_rotate(rotation, links.anchor[link])
            velocity = velocity + wp.cross(spin, to_anchor)
            spin = spin + axis * qvel[world, links.address_v[link]]
            angle = qpos[world, links.address_q[link]] - links.zero[link]
            rotation = rotation * wp.quat_from_axis_angle(links.axis[link], angle)
            back = -wp.quat_rotate(rotation, links.anchor[link])
            velocity = velocity + wp.cross(spin, back)
            position = position + to_anchor + back
    reach = wp.quat_rotate(rotation, links.foot[foot])
    out.foot_position_w[world, foot] = position + reach
    out.foot_velocity_w[world, foot] = velocity + wp.cross(spin, reach)


@wp.func
def row_force(contacts: ContactArrays, world: int, contact: int, row: int) -> float:
    """Force of one constraint row of a contact; zero where the row was dropped."""
    address = contacts.address[contact, row]
    if address < 0 or address >= contacts.row_capacity:
        return 0.0
    return contacts.row_force[world, address]


@wp.func
def local_wrench(contacts: ContactArrays, world: int, contact: int) -> wp.spatial_vector:
    """Force and torque of a contact in its own frame (normal first) on the second geom.

    An elliptic cone has one row per direction. A pyramidal one has two opposite edges per tangential direction: their sum is
    normal force, their difference times the friction coefficient is the tangential one.
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
    qpos: wp.array2d[float],
    out: StateArrays,
):
    """Sum the ground's contact forces on each foot, body and the robot as a whole, row by row of the world's constraints."""
    world = wp.tid()
    if select[world] != value:
        return
    for foot in range(feet):
        out.foot_contact_force_w[world, foot] = wp.vec3(0.0)
        out.foot_normal_force[world, foot] = 0.0
        out.foot_tangential_force[world, foot] = 0.0
    for body in range(bodies):
        out.body_contact_force_w[world, body] = wp.vec3(0.0)
    # moments are summed about the base, which is near the contacts, to keep single precision, and then moved
    base = wp.vec3(qpos[world, 0], qpos[world, 1], qpos[world, 2])
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
        if contacts.address[contact, 0] == row:  # the first row of a contact stands for all of it
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


@wp.kernel
def read_torques(select: wp.array[int], value: int, motors: Motors, out: StateArrays):
    """Motor torques of the last substep; zero in a world that diverged."""
    world, joint = wp.tid()
    if select[world] != value:
        return
    torque = motors.torque[world, joint]
    if out.diverged[world]:
        torque = 0.0
    out.joint_torque[world, joint] = torque


@wp.kernel
def reset_worlds(
    active: wp.array[int],
    has_held: wp.array[int],
    pose: wp.array2d[float],
    twist: wp.array2d[float],
    joint_position: wp.array2d[float],
    joint_velocity: wp.array2d[float],
    velocities: int,
    bodies: int,
    motors: Motors,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    applied: wp.array2d[float],
    external: wp.array2d[wp.spatial_vector],
    time: wp.array[float],
    overflow: wp.array[int],
    state: StateArrays,
):
    """Put the masked worlds into the given state. ``requested`` holds the held targets."""
    world, joint = wp.tid()
    if active[world] == 0:
        return
    qpos[world, motors.joint_q[joint]] = joint_position[world, joint]
    qvel[world, motors.joint_v[joint]] = joint_velocity[world, joint]
    held = float(0.0)
    if has_held[0] != 0:
        held = motors.requested[world, joint]
    motors.current[world, joint] = held
    motors.previous[world, joint] = held
    motors.torque[world, joint] = 0.0
    if joint == 0:
        w, x, y, z = pose[world, 3], pose[world, 4], pose[world, 5], pose[world, 6]
        length = wp.sqrt(w * w + x * x + y * y + z * z)
        for i in range(3):
            qpos[world, i] = pose[world, i]
        for i in range(3, 7):
            qpos[world, i] = pose[world, i] / length
        for i in range(6):
            qvel[world, i] = twist[world, i]
        for i in range(velocities):
            warmstart[world, i] = 0.0
            applied[world, i] = 0.0
        for i in range(bodies):
            external[world, i] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        motors.limp[world] = 1 - has_held[0]
        motors.limp_before[world] = 1 - has_held[0]
        time[world] = 0.0
        overflow[world] = 0
        state.diverged[world] = False
        state.overflowed[world] = False
        state.tilt_substep[world] = wp.int64(0)
        state.penetration_substep[world] = wp.int64(0)


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
):
    """Write the boxes and the height field of the masked worlds' new terrains.

    mujoco_warp computes poses of static geoms once, when its data are made, and never again: writing them here is enough.
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
def push_base(active: wp.array[int], twist: wp.array2d[float], qvel: wp.array2d[float]):
    """Set the base's velocities; NaN keeps the present value."""
    world, i = wp.tid()
    if active[world] == 0:
        return
    value = twist[world, i]
    if not wp.isnan(value):
        qvel[world, i] = value


@wp.kernel
def clear_forces(active: wp.array[int], joints: int, feet: int, bodies: int, out: StateArrays):
    """Zero all forces of the masked worlds' state."""
    world = wp.tid()
    if active[world] == 0:
        return
    for joint in range(joints):
        out.joint_torque[world, joint] = 0.0
    for foot in range(feet):
        out.foot_contact_force_w[world, foot] = wp.vec3(0.0)
        out.foot_normal_force[world, foot] = 0.0
        out.foot_tangential_force[world, foot] = 0.0
    for body in range(bodies):
        out.body_contact_force_w[world, body] = wp.vec3(0.0)
    out.ground_force_w[world] = wp.vec3(0.0)
    out.ground_moment_w[world] = wp.vec3(0.0)
    out.contact_center_w[world] = wp.vec3(0.0)
    out.contact_count[world] = wp.int64(0)
