"""Repair the height-field contacts of mujoco_warp 3.17, for every engine that steps it.

mujoco_warp collides height fields prism by prism, in a copy of MuJoCo's algorithm with three harmful differences:

- The support function labels a prism's vertex as top or bottom by the sign of the search direction, not by the vertex. A
  closest feature with both labels counts as the prism's side, and a vertical contact takes its place, with the unsigned height
  between the geom's lowest point and a corner of the prism as its depth. On uneven ground this happens on top faces and edges,
  too: contacts are centimetres too deep, or have a normal into the ground.
- Prisms that are a little apart from the geom count as contacts with a reversed normal, which pulls a foot down.
- The field's surface is lifted by the contact margin and the geom inflated by half of it, and the distance between these is
  reported: contacts begin with a jolt, and feet stand too high by as much.

The repair replaces two functions of mujoco_warp. The new support function has one label for all vertices, which keeps the plain
contact. The new narrow phase collides height fields itself, without contacts of separate prisms and with distances without the
margin, before mujoco_warp collides the rest.

The new narrow phase is also faster. In mujoco_warp one thread tests a geom's prisms in turn: of thousands of robots one always
lies on the ground, and all others wait for its thread. Here every prism has a thread, and searches for a distance (GJK) run only
where no plane of the prism separates the two shapes and no closed form is known.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from mujoco_warp import Data, Model
from mujoco_warp._src import collision_convex, collision_driver, collision_gjk
from mujoco_warp._src.collision_convex import convex_narrowphase as plain_narrowphase
from mujoco_warp._src.collision_core import CollisionContext
from mujoco_warp._src.math import upper_trid_index
from mujoco_warp._src.types import MJ_MAX_EPAFACES, MJ_MAX_EPAHORIZON, GeomType, OverflowType

from ...warp.structures import filled
from ..order import ContactFields
from ..repair import Repair
from . import kernels
from .contacts import Materials, Room, write_contacts
from .prisms import support

_PRISMS = (8, 64)
"""Capacity for listed prisms, for each contact of the capacity and for each world."""
_TOUCHES = (2, 64)
"""Capacity for listed prisms that may touch, likewise; more than contacts, since a shape has four at most."""
_WARP = 32
"""Threads that a GPU runs in step."""
_SERIAL_THREADS = 64
"""Number of threads on a CPU, where they run in turn."""
_TEST_THREADS = 512
"""Threads for each multiprocessor of a GPU that test prisms, each a few in turn."""
SEARCH_THREADS = 256
"""Threads for each multiprocessor that search, as many as fit at 255 registers, each with its own scratch memory."""


def colliding_kinds(model: Model, table: list[tuple[GeomType, GeomType]]) -> tuple[int, ...]:
    """Return the types of the geoms that may meet a height field in this model."""
    counts = model.geom_pair_type_count
    return tuple(
        int(other)
        for field, other in table
        if field == GeomType.HFIELD and counts[upper_trid_index(len(GeomType), int(field), int(other))]
    )


def scratch_memory(rows: int, iterations: int) -> kernels.Scratch:
    """Allocate memory for polytopes of so many expansions."""
    vertices, faces = 10 + 2 * iterations, 6 + MJ_MAX_EPAFACES * iterations
    points = wp.empty((rows, vertices + faces), dtype=wp.vec3)
    numbers = wp.empty((rows, vertices + faces + MJ_MAX_EPAHORIZON), dtype=int)
    scratch: Any = kernels.Scratch()
    scratch.vertices, scratch.projections = points[:, :vertices], points[:, vertices:]
    scratch.vertex_numbers, scratch.faces = numbers[:, :vertices], numbers[:, vertices : vertices + faces]
    scratch.horizon = numbers[:, vertices + faces :]
    scratch.squares = wp.empty((rows, faces), dtype=float)
    return scratch


def scratch_bytes(iterations: int) -> int:
    """Return the size of the memory of one search [bytes]."""
    with wp.ScopedDevice("cpu"):
        scratch = scratch_memory(1, iterations)
    kind: Any = kernels.Scratch
    parts = [getattr(scratch, name) for name in kind.vars]
    return sum(part.size * wp.types.type_size_in_bytes(part.dtype) for part in parts)


def empty_lists(contacts: int, worlds: int) -> kernels.Lists:
    """Allocate lists for so many worlds with room for so many contacts together."""
    prisms, touches = (each * contacts + spare * worlds for each, spare in (_PRISMS, _TOUCHES))
    return filled(
        kernels.Lists,
        counts=wp.zeros(3, dtype=int),
        spans=wp.empty(contacts, dtype=wp.vec2i),
        prisms=wp.empty(prisms, dtype=wp.vec2i),
        touches=wp.empty(touches, dtype=kernels.Touch),
        searches=wp.empty(touches, dtype=wp.vec3i),
    )


def collide_fields(model: Model, data: Data, context: CollisionContext, kinds: tuple[int, ...]) -> None:
    """Write the contacts between height fields and geoms of these types.

    Worlds that lose contacts to a full list get mujoco_warp's alarm ``HFIELD``.
    """
    multiprocessors = data.ncollision.device.sm_count
    testing = multiprocessors * _TEST_THREADS or _SERIAL_THREADS
    searching = max(1, min(multiprocessors * SEARCH_THREADS or _SERIAL_THREADS, data.naccdmax))
    shapes = filled(kernels.Shapes, model, model.opt, data, context)
    written = [filled(Materials, model), filled(ContactFields, data.contact), filled(Room, data.contact, data)]
    lists = empty_lists(data.naconmax, data.nworld)
    scratch = scratch_memory(searching, model.opt.ccd_iterations)
    test_prisms, search_prisms = kernels.prism_kernels(kinds)
    printed = model.opt.warn_overflow
    warn, warn_horizon = (bool(printed & bit) for bit in (OverflowType.HFIELD, OverflowType.EPA_HORIZON))
    wp.launch(kernels.list_prisms, dim=data.naconmax, inputs=[shapes, lists, warn])
    wp.launch(test_prisms, dim=testing, inputs=[shapes, lists, testing, warn])
    iterations = [model.opt.ccd_iterations] * 2
    inputs = [shapes, lists, scratch, searching, *iterations, warn_horizon]
    # in small blocks, so that few searches still reach many processors
    wp.launch(search_prisms, dim=searching, inputs=inputs, block_dim=_WARP)
    wp.launch(write_contacts, dim=data.naconmax, inputs=[shapes, lists, *written])


def convex_narrowphase(
    model: Model, data: Data, context: CollisionContext, table: list[tuple[GeomType, GeomType]]
) -> None:
    """Collide height fields with the repair's kernels, and all other convex shapes of the table in mujoco_warp."""
    kinds = colliding_kinds(model, table)
    if kinds:
        collide_fields(model, data, context, kinds)
    plain_narrowphase(model, data, context, [pair for pair in table if pair[0] != GeomType.HFIELD])


def _install() -> None:
    collision_gjk.support = collision_convex.support = support
    collision_driver.convex_narrowphase = convex_narrowphase


HEIGHT_FIELDS = Repair(
    project="mujoco-warp", versions=">=3.17,<3.18", fault="its contact with height fields", install=_install
)
