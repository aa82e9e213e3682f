# mypy: disable-error-code="valid-type, assignment"
"""Arrays of the mujoco_warp engine as Warp's kernels see them, bundled by purpose, and what fills the bundles.

N worlds, J joints, F feet, G geoms, S terrain slots. Numbers are float32 and int32 unless said otherwise.
"""

# Warp reads the annotations of structs: no ``from __future__ import annotations`` here.
from typing import Any

import mujoco_warp
import numpy as np
import warp as wp

from .model import FootChains, PaletteTables, SharedModel

vec5 = wp.types.vector(length=5, dtype=wp.float32)
"""mujoco_warp's five friction coefficients of a contact: sliding twice, torsional, rolling twice."""


@wp.struct
class Motion:
    """What mujoco_warp integrates, and the forces handed to it."""

    positions: int
    """Length of qpos."""
    velocities: int
    """Length of qvel."""
    bodies: int
    joint_q: wp.array[int]
    """Address of each joint in qpos."""
    joint_v: wp.array[int]
    """Address of each joint in qvel."""
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    warmstart: wp.array2d[float]
    """Accelerations from which the solver starts."""
    applied: wp.array2d[float]
    """Generalized forces: the motors' torques."""
    external: wp.array2d[wp.spatial_vector]
    """Force and torque on each body, at its centre of mass."""
    time: wp.array[float]
    overflow: wp.array[int]
    """mujoco_warp's alarms, one bit each."""


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
    trunk: wp.array[int]
    """1 for the trunk's shapes."""
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
    margin: wp.array[float]
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


def to_warp(values: np.ndarray, dtype: type) -> Any:
    """Copy a constant table to the current Warp device."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype)


def motion_arrays(model: mujoco_warp.Model, data: mujoco_warp.Data, shared: SharedModel) -> Motion:
    """mujoco_warp's own state arrays."""
    motion = Motion()
    motion.positions, motion.velocities, motion.bodies = model.nq, model.nv, model.nbody
    motion.joint_q, motion.joint_v = to_warp(shared.joint_q, int), to_warp(shared.joint_v, int)
    motion.qpos, motion.qvel, motion.warmstart = data.qpos, data.qvel, data.qacc_warmstart
    motion.applied, motion.external = data.qfrc_applied, data.xfrc_applied
    motion.time, motion.overflow = data.time, data.overflow
    return motion


def palette_arrays(tables: PaletteTables) -> Palette:
    """The palette on the current Warp device."""
    palette = Palette()
    for name in ("position", "size", "bound_center", "bound_half"):
        setattr(palette, name, to_warp(getattr(tables, name), wp.vec3))
    palette.rotation = to_warp(tables.rotation, wp.mat33)
    palette.radius = to_warp(tables.radius, float)
    palette.field, palette.wall = to_warp(tables.field, int), to_warp(tables.wall, int)
    return palette


def link_arrays(chains: FootChains) -> Links:
    """The chains of links on the current Warp device."""
    links = Links()
    for name in ("position", "axis", "anchor", "foot"):
        setattr(links, name, to_warp(getattr(chains, name), wp.vec3))
    links.rotation = to_warp(np.roll(chains.quaternion, -1, axis=1), wp.quat)  # Warp's quaternions are xyzw
    for name in ("start", "hinge", "address_q", "address_v"):
        setattr(links, name, to_warp(getattr(chains, name), int))
    links.zero = to_warp(chains.zero, float)
    return links


def role_arrays(shared: SharedModel) -> Roles:
    """What each geom is, on the current Warp device."""
    roles = Roles()
    for name in ("foot", "body", "trunk", "ground", "slot"):
        setattr(roles, name, to_warp(getattr(shared, f"geom_{name}"), int))
    return roles


def contact_arrays(data: mujoco_warp.Data, *, pyramidal: bool) -> ContactArrays:
    """mujoco_warp's own contact and constraint arrays."""
    contact, contacts = data.contact, ContactArrays()
    contacts.count, contacts.world, contacts.geom = data.nacon, contact.worldid, contact.geom
    contacts.distance, contacts.position, contacts.frame = contact.dist, contact.pos, contact.frame
    contacts.margin, contacts.friction, contacts.dimension = contact.includemargin, contact.friction, contact.dim
    contacts.address, contacts.row_id, contacts.row_force = contact.efc_address, data.efc.id, data.efc.force
    contacts.row_count, contacts.equality_rows = data.nefc, data.ne
    contacts.friction_rows, contacts.limit_rows = data.nf, data.nl
    contacts.row_capacity = data.njmax
    contacts.pyramidal = int(pyramidal)
    return contacts
