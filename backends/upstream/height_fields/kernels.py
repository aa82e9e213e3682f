# mypy: ignore-errors
# ruff: noqa: RUF046, UP018, ANN201
"""Kernels that collide shapes with height fields: a thread for each prism, where mujoco_warp has one for each shape.

``list_prisms`` lists the prisms under each shape, ``test_prisms`` drops those behind a separating plane and solves spheres,
``search_prisms`` finds the other contacts by GJK and EPA; ``write_contacts`` (in ``contacts.py``) chooses up to four for each
shape. Threads take places in the lists in any order, and nothing else depends on it: a pair's prisms lie together, in the order
of their numbers.
"""

# Warp reads the annotations of structs and kernels: no ``from __future__ import annotations`` here.
import functools

import warp as wp
from mujoco_warp._src.collision_convex import _hfield_filter as field_filter
from mujoco_warp._src.collision_core import contact_margin_gap, geom_collision_pair_from_types
from mujoco_warp._src.collision_gjk import ccd
from mujoco_warp._src.types import GeomType, OverflowType, mat63

from .prisms import TOUCH, prism_of, sphere_on_prism, stays_clear, without_margin

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

PRISMS = wp.constant(0)
"""Index of a counter: listed prisms."""
TOUCHES = wp.constant(1)
"""Index of a counter: taken places for contacts."""
SEARCHES = wp.constant(2)
"""Index of a counter: places that wait for a search."""
_WARP = wp.constant(32)
"""Threads that a GPU runs in step."""


@wp.struct
class Shapes:
    """Input from mujoco_warp's model, data and broad phase, by their own names."""

    ccd_tolerance: wp.array[float]
    geom_type: wp.array[int]
    geom_dataid: wp.array2d[int]
    geom_size: wp.array2d[wp.vec3]
    geom_rbound: wp.array2d[float]
    geom_margin: wp.array2d[float]
    geom_gap: wp.array2d[float]
    mesh_vertadr: wp.array[int]
    mesh_vertnum: wp.array[int]
    mesh_graphadr: wp.array[int]
    mesh_vert: wp.array[wp.vec3]
    mesh_graph: wp.array[int]
    mesh_polynum: wp.array[int]
    mesh_polyadr: wp.array[int]
    mesh_polynormal: wp.array[wp.vec3]
    mesh_polyvertadr: wp.array[int]
    mesh_polyvertnum: wp.array[int]
    mesh_polyvert: wp.array[int]
    mesh_polymapadr: wp.array[int]
    mesh_polymapnum: wp.array[int]
    mesh_polymap: wp.array[int]
    hfield_size: wp.array[wp.vec4]
    hfield_nrow: wp.array[int]
    hfield_ncol: wp.array[int]
    hfield_adr: wp.array[int]
    hfield_data: wp.array[float]
    pair_margin: wp.array2d[float]
    pair_gap: wp.array2d[float]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]
    ncollision: wp.array[int]
    collision_pair: wp.array[wp.vec2i]
    collision_pairid: wp.array[wp.vec2i]
    collision_worldid: wp.array[int]
    overflow: wp.array[int]


@wp.struct
class Touch:
    """Contact of a prism and a shape, in the world's frame; the distance is infinite for none."""

    distance: float
    position: wp.vec3
    normal: wp.vec3


@wp.struct
class Lists:
    """Lists that the kernels pass to each other."""

    counts: wp.array[int]
    """Taken places in the lists below; more than the capacity where a list is full."""
    spans: wp.array[wp.vec2i]
    """First listed prism and number of prisms of each pair."""
    prisms: wp.array[wp.vec2i]
    """Pair and number of a prism; after its test, pair and place of its contact or -1. Pair -1 marks a place left empty."""
    touches: wp.array[Touch]
    searches: wp.array[wp.vec3i]
    """Pair, number of the prism, and place of the contact."""


@wp.struct
class Scratch:
    """Memory of the expanding polytopes, a row for each thread that searches."""

    vertices: wp.array2d[wp.vec3]
    vertex_numbers: wp.array2d[int]
    faces: wp.array2d[int]
    projections: wp.array2d[wp.vec3]
    squares: wp.array2d[float]
    horizon: wp.array2d[int]


@wp.func
def report_overflow(shapes: Shapes, world: int, warn: bool):
    """Mark a world with lost contacts."""
    if warn:
        wp.printf("height field collision overflow: room for more contacts is needed, please increase naconmax\n")
    wp.atomic_or(shapes.overflow, world, int(OverflowType.HFIELD))


@wp.func
def field_of(shapes: Shapes, pair: int) -> int:
    """Return the height field of a pair's first geom."""
    world = shapes.collision_worldid[pair]
    return shapes.geom_dataid[world % shapes.geom_dataid.shape[0], shapes.collision_pair[pair][0]]


@wp.func
def margin_gap(shapes: Shapes, pair: int):
    """Return the contact margin and gap of a pair."""
    geoms, number = shapes.collision_pair[pair], shapes.collision_pairid[pair][0]
    world = shapes.collision_worldid[pair]
    return contact_margin_gap(
        shapes.geom_margin, shapes.geom_gap, shapes.pair_margin, shapes.pair_gap, geoms, number, world
    )


@wp.func
def reaches_up(shapes: Shapes, field: int, row: int, column: int, lift: float, bottom: float) -> int:
    """Return the sum of 1 and 2 for the first and second of a cell's prisms that has a lifted corner as high as ``bottom``."""
    columns, scale = shapes.hfield_ncol[field], shapes.hfield_size[field][2]
    node = shapes.hfield_adr[field] + row * columns + column
    near, near_next = shapes.hfield_data[node], shapes.hfield_data[node + 1]
    far, far_next = shapes.hfield_data[node + columns], shapes.hfield_data[node + columns + 1]
    shared = wp.max(near, far_next) * scale + lift
    first, second = wp.max(shared, far * scale + lift), wp.max(shared, near_next * scale + lift)
    return wp.where(first < bottom, 0, 1) + wp.where(second < bottom, 0, 2)


@wp.kernel
def list_prisms(shapes: Shapes, lists: Lists, warn: bool) -> None:
    """List, for each pair with a height field, the prisms that reach into the bounding box of its second geom."""
    pair = wp.tid()
    if pair >= shapes.ncollision[0]:
        return
    lists.spans[pair] = wp.vec2i(0, 0)
    geoms, world = shapes.collision_pair[pair], shapes.collision_worldid[pair]
    kind = shapes.geom_type[geoms[1]]
    if shapes.geom_type[geoms[0]] != int(GeomType.HFIELD) or kind < int(GeomType.SPHERE) or kind > int(GeomType.MESH):
        return
    apart, x_min, x_max, y_min, y_max, z_min, _ = field_filter(
        shapes.geom_type, shapes.geom_dataid, shapes.geom_size, shapes.geom_rbound, shapes.geom_margin,
        shapes.mesh_vertadr, shapes.mesh_vertnum, shapes.mesh_graphadr, shapes.mesh_vert, shapes.mesh_graph,
        shapes.hfield_size, shapes.geom_xpos, shapes.geom_xmat, world, geoms[0], geoms[1],
    )  # fmt: skip
    if apart:
        return
    margin, _ = margin_gap(shapes, pair)
    field = field_of(shapes, pair)
    size, rows, columns = shapes.hfield_size[field], shapes.hfield_nrow[field], shapes.hfield_ncol[field]
    per_x, per_y = 0.5 * float(columns - 1) / size[0], 0.5 * float(rows - 1) / size[1]
    left = wp.max(0, int(wp.floor((x_min + size[0]) * per_x)))
    right = wp.min(columns - 1, int(wp.ceil((x_max + size[0]) * per_x)))
    near = wp.max(0, int(wp.floor((y_min + size[1]) * per_y)))
    far = wp.min(rows - 1, int(wp.ceil((y_max + size[1]) * per_y)))

    count = int(0)
    for row in range(near, far):
        for column in range(left, right):
            tall = reaches_up(shapes, field, row, column, margin, z_min)
            count += tall % 2 + tall // 2
    if count == 0:
        return
    capacity = lists.prisms.shape[0]
    first = wp.atomic_add(lists.counts, PRISMS, count)
    if first > capacity - count:
        report_overflow(shapes, world, warn)
        for place in range(first, capacity):
            lists.prisms[place] = wp.vec2i(-1, -1)
        return
    lists.spans[pair] = wp.vec2i(first, count)
    place = int(first)
    for row in range(near, far):
        for column in range(left, right):
            tall = reaches_up(shapes, field, row, column, margin, z_min)
            number = 2 * (row * (columns - 1) + column)
            if tall % 2 == 1:
                lists.prisms[place] = wp.vec2i(pair, number)
                place += 1
            if tall // 2 == 1:
                lists.prisms[place] = wp.vec2i(pair, number + 1)
                place += 1


@wp.func
def listed_prism(shapes: Shapes, pair: int, number: int, margin: float) -> mat63:
    """Return a prism of a pair's field, lifted by the margin."""
    field = field_of(shapes, pair)
    start, size = shapes.hfield_adr[field], shapes.hfield_size[field]
    columns, rows = shapes.hfield_ncol[field], shapes.hfield_nrow[field]
    return prism_of(shapes.hfield_data, start, columns, rows, size, number, margin)


@wp.func
def in_field_frame(shapes: Shapes, pair: int, kind: int, margin: float):
    """Return the geoms of a pair for mujoco_warp's functions, in the field's frame, without the prism."""
    geoms, world = shapes.collision_pair[pair], shapes.collision_worldid[pair]
    field, shape = geom_collision_pair_from_types(
        shapes.geom_dataid, shapes.geom_size, shapes.mesh_vertadr, shapes.mesh_vertnum, shapes.mesh_graphadr,
        shapes.mesh_vert, shapes.mesh_graph, shapes.mesh_polynum, shapes.mesh_polyadr, shapes.mesh_polynormal,
        shapes.mesh_polyvertadr, shapes.mesh_polyvertnum, shapes.mesh_polyvert,
        shapes.mesh_polymapadr, shapes.mesh_polymapnum, shapes.mesh_polymap,
        shapes.geom_xpos, shapes.geom_xmat, int(GeomType.HFIELD), kind, geoms, world,
    )  # fmt: skip
    into = wp.transpose(field.rot)
    shape.pos = into @ (shape.pos - field.pos)
    shape.rot = into @ shape.rot
    shape.margin = margin
    field.pos = wp.vec3(0.0, 0.0, 0.0)
    field.rot = wp.identity(n=3, dtype=float)
    return field, shape


@wp.func
def touch_of(shapes: Shapes, pair: int, distance: float, first: wp.vec3, second: wp.vec3) -> Touch:
    """Return the result of a test of lifted field and inflated shape as a contact in the world's frame."""
    touch = Touch()
    touch.distance = wp.inf
    if distance <= TOUCH:
        margin, gap = margin_gap(shapes, pair)
        plain, middle, normal = without_margin(distance, first, second, margin)
        if plain < margin + gap:
            world, geom = shapes.collision_worldid[pair], shapes.collision_pair[pair][0]
            pose = shapes.geom_xmat[world, geom]
            touch.distance = plain
            touch.normal = pose @ normal
            touch.position = pose @ middle + shapes.geom_xpos[world, geom]
    return touch


@functools.cache
def prism_kernels(kinds: tuple[int, ...]) -> tuple[wp.Kernel, wp.Kernel]:
    """Build ``test_prisms`` and ``search_prisms`` for these types of geoms, so that they hold no code for others."""
    first_kind, number_of_kinds = kinds[0], len(kinds)

    @wp.func
    def kind_of(shapes: Shapes, pair: int) -> int:
        """Return the type of a pair's second geom, as a choice between constants."""
        found, kind = shapes.geom_type[shapes.collision_pair[pair][1]], int(wp.static(first_kind))
        for i in range(wp.static(number_of_kinds)):
            if found == wp.static(kinds[i]):
                kind = wp.static(kinds[i])
        return kind

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def test_prisms(shapes: Shapes, lists: Lists, threads: int, warn: bool) -> None:
        """Give each listed prism that may touch its shape a place for a contact: a sphere's at once, others by search."""
        for place in range(wp.tid(), wp.min(lists.counts[PRISMS], lists.prisms.shape[0]), threads):
            pair, number = lists.prisms[place][0], lists.prisms[place][1]
            if pair < 0:
                continue
            kind = kind_of(shapes, pair)
            margin, _ = margin_gap(shapes, pair)
            prism = listed_prism(shapes, pair, number, margin)
            _field, shape = in_field_frame(shapes, pair, kind, margin)
            solved, touch = bool(False), Touch()
            touch.distance = wp.inf
            if kind == int(GeomType.SPHERE):
                solved, distance, first, second = sphere_on_prism(prism, shape)
                if solved:
                    touch = touch_of(shapes, pair, distance, first, second)
            wanted = bool(touch.distance < wp.inf)
            if not solved:
                wanted = not stays_clear(prism, shape, kind)
            given = int(-1)
            if wanted:
                given = wp.atomic_add(lists.counts, TOUCHES, 1)
                if given >= lists.touches.shape[0]:
                    report_overflow(shapes, shapes.collision_worldid[pair], warn)
                    given = -1
            lists.prisms[place] = wp.vec2i(pair, given)
            if given >= 0:
                if solved:
                    lists.touches[given] = touch
                else:
                    lists.searches[wp.atomic_add(lists.counts, SEARCHES, 1)] = wp.vec3i(pair, number, given)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def search_prisms(
        shapes: Shapes,
        lists: Lists,
        scratch: Scratch,
        threads: int,
        gjk_iterations: int,
        epa_iterations: int,
        warn_horizon: bool,
    ) -> None:
        """Find the contacts that need GJK and EPA; few searches are spread over many warps, where they do not wait for each other."""
        count, thread = lists.counts[SEARCHES], wp.tid()
        spread = wp.clamp(threads // wp.max(count, 1), 1, _WARP)
        worker, workers = thread // spread, threads // spread
        if thread % spread != 0 or worker >= workers:
            return
        for i in range(worker, count, workers):
            search = lists.searches[i]
            pair = search[0]
            kind, world = kind_of(shapes, pair), shapes.collision_worldid[pair]
            margin, _ = margin_gap(shapes, pair)
            field, shape = in_field_frame(shapes, pair, kind, margin)
            prism = listed_prism(shapes, pair, search[1], margin)
            field.polyvert = prism
            tolerance = shapes.ccd_tolerance[world % shapes.ccd_tolerance.shape[0]]
            middle = (prism[0] + prism[1] + prism[2] + prism[3] + prism[4] + prism[5]) * (1.0 / 6.0)
            distance, found, first, second, _index = ccd(
                tolerance, 0.0, gjk_iterations, epa_iterations,
                field, shape, int(GeomType.HFIELD), kind, middle, shape.pos,
                scratch.vertices[worker], scratch.vertex_numbers[worker], scratch.faces[worker],
                scratch.projections[worker], scratch.squares[worker], scratch.horizon[worker],
                warn_horizon, world, shapes.overflow,
            )  # fmt: skip
            if found == 0:
                distance = wp.inf
            lists.touches[search[2]] = touch_of(shapes, pair, distance, first, second)

    return test_prisms, search_prisms
