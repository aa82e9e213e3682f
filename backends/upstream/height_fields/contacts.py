# mypy: ignore-errors
# ruff: noqa: RUF046, UP018
"""Choose a shape's contacts with a height field among those of its prisms, and write them as mujoco_warp does."""

# Warp reads the annotations of structs and kernels: no ``from __future__ import annotations`` here.
import warp as wp
from mujoco_warp._src.collision_core import contact_material_params, write_contact
from mujoco_warp._src.math import make_frame
from mujoco_warp._src.types import vec5

from ..order import ContactFields
from .kernels import Lists, Shapes, Touch, margin_gap

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_DOUBLE = wp.constant(1.0e-3)
"""Least distance of a further contact from those before it, as in mujoco_warp."""


@wp.struct
class Materials:
    """Contact parameters of mujoco_warp's model, by its own names."""

    geom_condim: wp.array[int]
    geom_priority: wp.array[int]
    geom_solmix: wp.array2d[float]
    geom_solref: wp.array2d[wp.vec2]
    geom_solimp: wp.array2d[vec5]
    geom_friction: wp.array2d[wp.vec3]
    geom_adhesion: wp.array2d[float]
    pair_dim: wp.array[int]
    pair_solref: wp.array2d[wp.vec2]
    pair_solreffriction: wp.array2d[wp.vec2]
    pair_solimp: wp.array2d[vec5]
    pair_adhesion: wp.array2d[float]
    pair_friction: wp.array2d[vec5]


@wp.struct
class Room:
    """mujoco_warp's room for contacts, by its own names."""

    naconmax: int
    nacon: wp.array[int]
    efc_address: wp.array2d[int]


@wp.func
def write_touch(
    shapes: Shapes, materials: Materials, contacts: ContactFields, room: Room, pair: int, number: int, touch: Touch
) -> None:
    """Write one more of mujoco_warp's contacts."""
    geoms, ids, world = shapes.collision_pair[pair], shapes.collision_pairid[pair], shapes.collision_worldid[pair]
    margin, gap = margin_gap(shapes, pair)
    condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
        materials.geom_condim, materials.geom_priority, materials.geom_solmix, materials.geom_solref,
        materials.geom_solimp, materials.geom_friction, materials.geom_adhesion,
        materials.pair_dim, materials.pair_solref, materials.pair_solreffriction, materials.pair_solimp,
        materials.pair_adhesion, materials.pair_friction, geoms, ids[0], world,
    )  # fmt: skip
    write_contact(
        room.naconmax, number, touch.distance, touch.position, make_frame(touch.normal), margin, gap,
        condim, friction, solref, solreffriction, solimp, adhesion, geoms, ids, world,
        contacts.dist, contacts.pos, contacts.frame, contacts.includemargin, contacts.friction, contacts.solref,
        contacts.solreffriction, contacts.solimp, contacts.dim, contacts.geom, room.efc_address, contacts.worldid,
        contacts.type, contacts.geomcollisionid, contacts.adhesion, room.nacon,
    )  # fmt: skip


@wp.kernel
def write_contacts(shapes: Shapes, lists: Lists, materials: Materials, contacts: ContactFields, room: Room) -> None:
    """Write four of each pair's contacts: the deepest, the farthest from it, and two that span the widest area with these."""
    pair = wp.tid()
    if pair >= shapes.ncollision[0]:
        return
    first, listed = lists.spans[pair][0], lists.spans[pair][1]
    # bring the contacts of the pair's prisms to the front of its places, and find the deepest
    count, chosen, least = int(0), int(-1), float(wp.inf)
    for i in range(listed):
        given = lists.prisms[first + i][1]
        if given < 0:
            continue
        distance = lists.touches[given].distance
        if distance == wp.inf:
            continue
        lists.prisms[first + count] = wp.vec2i(pair, given)
        if distance < least:
            chosen = count
            least = distance
        count += 1
    number, start, second = int(0), wp.vec3(), wp.vec3()
    normal, across, along = wp.vec3(), wp.vec3(), wp.vec3()
    while chosen >= 0 and number < 4:
        given = lists.prisms[first + chosen][1]
        lists.prisms[first + chosen] = wp.vec2i(-1, given)  # marks a chosen contact
        write_touch(shapes, materials, contacts, room, pair, number, lists.touches[given])
        position = lists.touches[given].position
        if number == 0:
            start = position
            normal = lists.touches[given].normal
        elif number == 1:
            second = position
            across = wp.cross(normal, start - second)
        else:
            across = wp.cross(normal, start - position)
            along = wp.cross(normal, second - position)
        number += 1
        chosen = int(-1)
        reach = float(-1.0)
        for i in range(count):
            if lists.prisms[first + i][0] >= 0:
                place = lists.touches[lists.prisms[first + i][1]].position
                far = wp.abs(wp.dot(place - start, across)) + wp.abs(wp.dot(place - second, along))
                if number == 1:
                    far = wp.length(place - start)
                if far > reach:
                    chosen = i
                    reach = far
        if reach > 0.0 and reach < _DOUBLE:
            return
