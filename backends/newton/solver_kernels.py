# mypy: ignore-errors
# ruff: noqa: ANN201
"""Warp kernels for the internals of single Newton solvers."""

# Warp reads the annotations of kernels: no ``from __future__ import annotations`` here.
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def place_mujoco_field(
    terrain: wp.array[int],
    geom: int,
    asset: wp.array[int],
    position: wp.array[wp.vec3],
    box: wp.array2d[wp.vec3],
    radius: wp.array[float],
    geom_dataid: wp.array2d[int],
    geom_pos: wp.array2d[wp.vec3],
    geom_xpos: wp.array2d[wp.vec3],
    geom_aabb: wp.array3d[wp.vec3],
    geom_rbound: wp.array2d[float],
):
    """Give each world's height-field geom the field of the world's terrain."""
    world = wp.tid()
    index = terrain[world]
    geom_dataid[world % geom_dataid.shape[0], geom] = asset[index]
    geom_pos[world, geom] = position[index]
    geom_xpos[world, geom] = position[index]
    geom_aabb[world % geom_aabb.shape[0], geom, 0] = box[index, 0]
    geom_aabb[world % geom_aabb.shape[0], geom, 1] = box[index, 1]
    geom_rbound[world % geom_rbound.shape[0], geom] = radius[index]


@wp.kernel
def place_newton_field(
    terrain: wp.array[int],
    shapes: int,
    shape: int,
    from_index: wp.array[int],
    from_source: wp.array[wp.uint64],
    from_lower: wp.array[wp.vec3],
    from_upper: wp.array[wp.vec3],
    from_radius: wp.array[float],
    index: wp.array[int],
    source: wp.array[wp.uint64],
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    radius: wp.array[float],
):
    """Give each world's height-field shape the field of the world's terrain."""
    world = wp.tid()
    field = terrain[world]
    at = world * shapes + shape
    index[at] = from_index[field]
    source[at] = from_source[field]
    lower[at] = from_lower[field]
    upper[at] = from_upper[field]
    radius[at] = from_radius[field]
