# mypy: ignore-errors
# ruff: noqa: ANN201
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
"""

# Warp reads the annotations of functions: no ``from __future__ import annotations`` here.
import warp as wp
from mujoco_warp._src import collision_convex, collision_gjk
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import SupportPoint
from mujoco_warp._src.collision_gjk import ccd as plain_ccd
from mujoco_warp._src.collision_gjk import support as plain_support
from mujoco_warp._src.types import GeomType

wp.set_module_options({"enable_backward": False})

_TOUCH = wp.constant(-1.0e-6)
"""Distance between lifted field and inflated geom above which they do not touch [m]; single precision sees no less."""


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
