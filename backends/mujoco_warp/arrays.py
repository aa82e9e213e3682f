# mypy: disable-error-code="valid-type, assignment"
"""Arrays of the mujoco_warp engine for Warp's kernels, bundled by purpose, and functions that fill the bundles.

N worlds, J joints, F feet, L links, G geoms, T terrains, S terrain slots. Numbers are float32 and int32 unless said otherwise.
"""

# Warp reads the annotations of structs: no ``from __future__ import annotations`` here.
import mujoco_warp
import warp as wp

from ..warp.structures import filled
from .model import SharedModel

_ALARMS = mujoco_warp.OverflowType
DROPPED = int(_ALARMS.ALL & ~(_ALARMS.ITERATIONS | _ALARMS.LS_ITERATIONS))
"""Alarms about dropped contacts or constraints: all but those of a solver at its iteration limit. ``EPA_HORIZON`` leaves a pair of
convex shapes without a contact."""
vec5 = wp.types.vector(length=5, dtype=wp.float32)
"""mujoco_warp's five friction coefficients of a contact: sliding twice, torsional, rolling twice."""


@wp.struct
class Motion:
    """State that mujoco_warp integrates, and forces on it."""

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
    """First link of each foot, and L at the end, (F + 1,)."""
    position: wp.array[wp.vec3]
    """Fixed offset from the link before [m], (L,)."""
    rotation: wp.array[wp.quat]
    """Fixed rotation from the link before, xyzw, (L,)."""
    hinge: wp.array[int]
    """1 where the link ends in a hinge, (L,)."""
    axis: wp.array[wp.vec3]
    """Hinge axis in the link's frame, (L,)."""
    anchor: wp.array[wp.vec3]
    """Point on the hinge axis [m], (L,)."""
    address_q: wp.array[int]
    """Address of the hinge in qpos, (L,)."""
    address_v: wp.array[int]
    """Address of the hinge in qvel, (L,)."""
    zero: wp.array[float]
    """Hinge angle at which the fixed rotation holds [rad], (L,)."""
    foot: wp.array[wp.vec3]
    """Centre of each foot in its last link's frame [m], (F,)."""


@wp.struct
class Roles:
    """Role of each geom, (G,)."""

    foot: wp.array[int]
    """Index of the foot, -1 for other geoms."""
    body: wp.array[int]
    """Index of the collision body, -1 for the ground and bodies that are not reported."""
    trunk: wp.array[int]
    """1 for the trunk's shapes."""
    ground: wp.array[int]
    """1 for floor, walls and terrain."""
    slot: wp.array[int]
    """Index of the terrain slot, the height field's the last; -1 for floor and robot."""


@wp.struct
class Palette:
    """Terrains as slot poses and sizes. Slots are the boxes and, last, the height field if a terrain has one."""

    position: wp.array2d[wp.vec3]
    """[m], (T, S)."""
    rotation: wp.array2d[wp.mat33]
    size: wp.array2d[wp.vec3]
    """Geom sizes as the engine defines them, (T, S)."""
    bound_center: wp.array2d[wp.vec3]
    """Centre of the bounding box in the slot's frame [m], (T, S)."""
    bound_half: wp.array2d[wp.vec3]
    """Half size of the bounding box [m], (T, S)."""
    radius: wp.array2d[float]
    """Radius of the bounding sphere [m], (T, S)."""
    field: wp.array[int]
    """Index of the height field, 0 where there is none and the geom is parked, (T,)."""
    wall: wp.array2d[int]
    """1 for boundary walls, (T, S)."""


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


def motion_arrays(model: mujoco_warp.Model, data: mujoco_warp.Data, shared: SharedModel) -> Motion:
    """Return mujoco_warp's own state arrays."""
    sizes = {"positions": model.nq, "velocities": model.nv, "bodies": model.nbody}
    forces = {"applied": data.qfrc_applied, "external": data.xfrc_applied}
    return filled(Motion, data, shared, **sizes, **forces, warmstart=data.qacc_warmstart)


def contact_arrays(data: mujoco_warp.Data, *, pyramidal: bool) -> ContactArrays:
    """Return mujoco_warp's own contact and constraint arrays."""
    contact = data.contact
    places = {"world": contact.worldid, "distance": contact.dist, "position": contact.pos, "dimension": contact.dim}
    counts = {"count": data.nacon, "row_count": data.nefc, "row_capacity": data.njmax}
    counts |= {"equality_rows": data.ne, "friction_rows": data.nf, "limit_rows": data.nl}
    rows = {"address": contact.efc_address, "row_id": data.efc.id, "row_force": data.efc.force}
    return filled(ContactArrays, contact, **places, **counts, **rows, pyramidal=int(pyramidal))
