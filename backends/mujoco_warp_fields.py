# mypy: ignore-errors
# ruff: noqa: ANN201, RUF046, SIM102, UP018
"""Repairs the height-field contacts of mujoco_warp 3.17, for every engine that steps it.

Height fields are collided prism by prism, in a copy of MuJoCo's algorithm with three differences that matter:

- The support function labels a prism's vertex as top or bottom by the sign of the search direction, not by the vertex. A
  closest feature with both labels is taken for the prism's side, and its contact is replaced by a vertical one whose
  depth is the unsigned height between the geom's lowest point and a corner of the prism. On uneven ground this happens
  on top faces and edges, too: contacts that are centimetres too deep, or have a normal that points into the ground.
- Prisms that are a little apart from the geom count as contacts, with the normal turned round: a foot is pulled down.
- The field's surface is lifted by the contact margin and the geom inflated by half of it, but the distance between these
  is reported: contacts would begin with a jolt, and feet stand that much too high.

MuJoCo does none of this. Two functions of mujoco_warp are wrapped: one label for all vertices, so that the plain contact
is used; and after the test of a prism, no contact where it is apart, and distances without the margin.

Of the prisms under a geom's bounding box most do not touch it. Where the plane of a prism's top or one of its upright sides
lies between the two, the search for their distance (GJK) is left out: a geom's prisms are tested by one thread, in turn.
For spheres (feet, which touch most) the distance is found in closed form.
"""

# Warp reads the annotations of functions: no ``from __future__ import annotations`` here.
import warp as wp
from mujoco_warp._src import collision_convex, collision_gjk
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import SupportPoint
from mujoco_warp._src.collision_gjk import ccd as plain_ccd
from mujoco_warp._src.collision_gjk import support as plain_support
from mujoco_warp._src.types import GeomType, mat63

wp.set_module_options({"enable_backward": False})

_TOUCH = wp.constant(-1.0e-6)
"""Distance between lifted field and inflated geom above which they do not touch [m]; single precision sees no less."""


_CLEAR = wp.constant(1.0e-5)
"""Gap to one of a prism's planes above which it does not touch [m]; wide enough for the rounding of positions."""


@wp.func
def stays_clear(prism: mat63, geom: Geom, geomtype: int) -> bool:
    """Whether the plane of the prism's top, or of a side, separates it from a geom that is given in the field's frame."""
    top = wp.cross(prism[4] - prism[3], prism[5] - prism[3])
    top = wp.normalize(wp.where(top[2] < 0.0, -top, top))
    if wp.dot(plain_support(geom, geomtype, -top).point - prism[3], top) > _CLEAR:
        return True
    for i in range(3):
        corner = prism[3 + i]
        edge = prism[3 + (i + 1) % 3] - corner
        side = wp.normalize(wp.vec3(edge[1], -edge[0], 0.0))
        if wp.dot(prism[3 + (i + 2) % 3] - corner, side) > 0.0:
            side = -side
        if wp.dot(plain_support(geom, geomtype, -side).point - corner, side) > _CLEAR:
            return True
    return False


@wp.func
def nearest_on_triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3) -> wp.vec3:
    """The point of a triangle that is nearest to ``p``: under it on the plane, or else on one of the three edges."""
    normal = wp.cross(b - a, c - a)
    if (
        wp.dot(wp.cross(b - a, p - a), normal) >= 0.0
        and wp.dot(wp.cross(c - b, p - b), normal) >= 0.0
        and wp.dot(wp.cross(a - c, p - c), normal) >= 0.0
    ):
        return p - normal * (wp.dot(p - a, normal) / wp.dot(normal, normal))
    nearest, smallest = a, float(wp.inf)
    for i in range(3):
        start = wp.where(i == 0, a, wp.where(i == 1, b, c))
        edge = wp.where(i == 0, b, wp.where(i == 1, c, a)) - start
        point = start + edge * wp.clamp(wp.dot(p - start, edge) / wp.dot(edge, edge), 0.0, 1.0)
        if wp.length_sq(p - point) < smallest:
            nearest, smallest = point, wp.length_sq(p - point)
    return nearest


@wp.func
def sphere_on_prism(prism: mat63, sphere: Geom):
    """Distance and nearest points of prism and sphere in closed form, where that is so simple; the flag says whether."""
    # of a triangle and all that lies straight below it, nothing is nearer to a point that looks down on the triangle
    first = nearest_on_triangle(prism[3], prism[4], prism[5], sphere.pos)
    apart = sphere.pos - first
    away = wp.length(apart)
    radius = sphere.size[0] + 0.5 * sphere.margin
    simple = apart[2] >= 0.0 and away > _CLEAR
    return simple, away - radius, first, sphere.pos - apart * (radius / wp.max(away, _CLEAR))


@wp.func
def support(geom: Geom, geomtype: int, dir: wp.vec3) -> SupportPoint:
    """mujoco_warp's support point, with one label for all vertices of a height field's prism."""
    point = plain_support(geom, geomtype, dir)
    if geomtype == int(GeomType.HFIELD):
        point.vertex_index = -1
    return point


@wp.func
def ccd(
    tolerance: float,
    cutoff: float,
    gjk_iterations: int,
    epa_iterations: int,
    geom1: Geom,
    geom2: Geom,
    geomtype1: int,
    geomtype2: int,
    x_1: wp.vec3,
    x_2: wp.vec3,
    vert: wp.array[wp.vec3],
    vert_index: wp.array[int],
    face: wp.array[int],
    face_pr: wp.array[wp.vec3],
    face_norm2: wp.array[float],
    horizon: wp.array[int],
    warn_overflow: bool,
    worldid: int,
    overflow_out: wp.array[int],
):
    """mujoco_warp's distance of two convex shapes; of a field's prism (frame: the field's) as MuJoCo reports it."""
    if geomtype1 == int(GeomType.HFIELD):
        if stays_clear(geom1.polyvert, geom2, geomtype2):
            return _CLEAR, 0, wp.vec3(), wp.vec3(), -1
    index, count, simple = int(-1), int(1), bool(False)
    distance, first, second = float(0.0), wp.vec3(), wp.vec3()
    if geomtype1 == int(GeomType.HFIELD) and geomtype2 == int(GeomType.SPHERE):
        simple, distance, first, second = sphere_on_prism(geom1.polyvert, geom2)
    if not simple:
        distance, count, first, second, index = plain_ccd(
            tolerance,
            cutoff,
            gjk_iterations,
            epa_iterations,
            geom1,
            geom2,
            geomtype1,
            geomtype2,
            x_1,
            x_2,
            vert,
            vert_index,
            face,
            face_pr,
            face_norm2,
            horizon,
            warn_overflow,
            worldid,
            overflow_out,
        )
    if geomtype1 == int(GeomType.HFIELD):
        if distance > _TOUCH:
            count = 0
        else:
            # of shapes that overlap, the first's witness point lies ahead of the second's along the normal
            apart = first - second
            normal = wp.normalize(apart)
            lift, inflation = geom2.margin * normal[2], 0.5 * geom2.margin
            shift = -0.5 * (lift - inflation) * normal
            first, second = first + shift, second + shift
            distance += lift + inflation
    return distance, count, first, second, index


def repair_height_fields() -> None:
    """Let mujoco_warp use the functions above. To be called before its first collision kernel is built; idempotent."""
    collision_gjk.support = collision_convex.support = support
    collision_convex.ccd = ccd
