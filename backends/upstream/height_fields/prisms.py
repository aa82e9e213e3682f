# mypy: ignore-errors
# ruff: noqa: ANN201
"""Collide one prism of a height field with one shape as MuJoCo does. Functions for Warp's kernels.

A prism lies below one triangle of the field's surface, down to the field's base. Everything is in the field's frame, with the
surface lifted by the contact margin and the shape inflated by half of the margin, as in MuJoCo.
"""

# Warp reads the annotations of functions: no ``from __future__ import annotations`` here.
import warp as wp
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import SupportPoint
from mujoco_warp._src.collision_gjk import support as plain_support
from mujoco_warp._src.types import GeomType, mat63

wp.set_module_options({"enable_backward": False})

TOUCH = wp.constant(-1.0e-6)
"""Largest distance of a contact between lifted field and inflated shape [m], the limit of single precision."""

_CLEAR = wp.constant(1.0e-5)
"""Largest gap of a contact to one of a prism's planes [m]; wide enough for the rounding of positions."""


@wp.func
def field_point(
    heights: wp.array[float], start: int, columns: int, rows: int, size: wp.vec4, row: int, column: int, lift: float
) -> wp.vec3:
    """Return a lifted node of a field's surface."""
    x = (2.0 * size[0]) / float(columns - 1) * float(column) - size[0]
    y = (2.0 * size[1]) / float(rows - 1) * float(row) - size[1]
    return wp.vec3(x, y, heights[start + row * columns + column] * size[2] + lift)


@wp.func
def prism_of(
    heights: wp.array[float], start: int, columns: int, rows: int, size: wp.vec4, number: int, lift: float
) -> mat63:
    """Return a prism's corners, three at the base and three on top: two prisms to a cell, cells numbered along the rows."""
    second = number % 2
    row, column = (number // 2) // (columns - 1), (number // 2) % (columns - 1)
    # the diagonal of a cell goes from its corner with the lower column and the higher row to the opposite one
    a = field_point(heights, start, columns, rows, size, row + 1 - second, column, lift)
    b = field_point(heights, start, columns, rows, size, row + second, column + second, lift)
    c = field_point(heights, start, columns, rows, size, row + 1 - second, column + 1, lift)
    prism = mat63()
    prism[0] = wp.vec3(a[0], a[1], -size[3])
    prism[1] = wp.vec3(b[0], b[1], -size[3])
    prism[2] = wp.vec3(c[0], c[1], -size[3])
    prism[3] = a
    prism[4] = b
    prism[5] = c
    return prism


@wp.func
def stays_clear(prism: mat63, geom: Geom, kind: int) -> bool:
    """Return whether the plane of the prism's top or of a side separates the prism from a shape."""
    top = wp.cross(prism[4] - prism[3], prism[5] - prism[3])
    top = wp.normalize(wp.where(top[2] < 0.0, -top, top))
    if wp.dot(plain_support(geom, kind, -top).point - prism[3], top) > _CLEAR:
        return True
    for i in range(3):
        corner = prism[3 + i]
        edge = prism[3 + (i + 1) % 3] - corner
        side = wp.normalize(wp.vec3(edge[1], -edge[0], 0.0))
        if wp.dot(prism[3 + (i + 2) % 3] - corner, side) > 0.0:
            side = -side
        if wp.dot(plain_support(geom, kind, -side).point - corner, side) > _CLEAR:
            return True
    return False


@wp.func
def nearest_on_triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3) -> wp.vec3:
    """Return the point of a triangle nearest to ``p``: under ``p`` on the plane, or else on one of the three edges."""
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
    """Return a flag for a closed form, and by it distance and nearest points of prism and sphere."""
    # for a point above a triangle, the nearest point of the prism below lies on the triangle
    first = nearest_on_triangle(prism[3], prism[4], prism[5], sphere.pos)
    apart = sphere.pos - first
    away = wp.length(apart)
    radius = sphere.size[0] + 0.5 * sphere.margin
    simple = apart[2] >= 0.0 and away > _CLEAR
    return simple, away - radius, first, sphere.pos - apart * (radius / wp.max(away, _CLEAR))


@wp.func
def without_margin(distance: float, first: wp.vec3, second: wp.vec3, margin: float):
    """Return distance, middle and normal (out of the ground) of a contact, with lift and inflation undone."""
    # where shapes overlap, the first shape's witness point lies ahead of the second's along the normal
    normal = wp.normalize(first - second)
    lift, inflation = margin * normal[2], 0.5 * margin
    middle = 0.5 * (first + second) - 0.5 * (lift - inflation) * normal
    return distance + lift + inflation, middle, normal


@wp.func
def support(geom: Geom, kind: int, dir: wp.vec3) -> SupportPoint:
    """Return mujoco_warp's support point, with one label for all vertices of a height field's prism."""
    point = plain_support(geom, kind, dir)
    if kind == int(GeomType.HFIELD):
        point.vertex_index = -1
    return point
