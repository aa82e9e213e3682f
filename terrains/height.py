"""Compute the height of the ground above a point of the plane, exact for the floor, boxes of any orientation and height fields."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .shapes import Box, FloatArray, HeightField

# A point on the edge of a solid counts as above it, whichever way the edge's coordinate was rounded [m].
EDGE_TOLERANCE = 1e-9


def ground_height(boxes: Sequence[Box], height_field: HeightField | None, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of the highest solid on the vertical line through (x, y); the floor plane z = 0 is everywhere.

    Args:
        boxes: the terrain's boxes; walls do not count.
        height_field: the terrain's height field, where it has one.
        x: forward coordinate, world frame [m], any shape.
        y: leftward coordinate, world frame [m], a shape that broadcasts with ``x``.

    Returns:
        Height [m], the broadcast shape of ``x`` and ``y``; NaN where a coordinate is NaN.
    """
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    height: FloatArray = np.where(np.isnan(x) | np.isnan(y), np.nan, 0.0)
    for box in boxes:
        if not box.wall:
            height = np.maximum(height, box_top(box, x, y))
    if height_field is not None:
        height = np.maximum(height, height_field_top(height_field, x, y))
    return height


def grid_height(boxes: Sequence[Box], height_field: HeightField | None, axis: FloatArray) -> FloatArray:
    """Return ``ground_height`` at the nodes of a square grid, (y, x), of the same ascending coordinates on both axes, (n,) [m]. Each
    box is evaluated at the few nodes that it may cover.
    """
    x, y = axis[None, :], axis[:, None]
    height: FloatArray = np.zeros((len(axis), len(axis)))
    for box in boxes:
        if not box.wall:
            reach = np.abs(rotation_matrix(box.quaternion)) @ box.half_size + 1e-6
            columns, rows = (
                slice(*np.searchsorted(axis, (box.center[i] - reach[i], box.center[i] + reach[i]))) for i in (0, 1)
            )
            part = height[rows, columns]
            np.maximum(part, box_top(box, x[:, columns], y[rows]), out=part)
    if height_field is not None:
        np.maximum(height, height_field_top(height_field, x, y), out=height)
    return height


def box_top(box: Box, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height at which the vertical line through (x, y) leaves a box [m]; -inf where the line misses the box.

    ``x`` and ``y`` are in the world frame [m], of shapes that broadcast to that of the heights.
    """
    offset_x, offset_y = x - box.center[0], y - box.center[1]
    if box.quaternion == (1.0, 0.0, 0.0, 0.0):
        reach_x, reach_y = box.half_size[0] + EDGE_TOLERANCE, box.half_size[1] + EDGE_TOLERANCE
        hit = (np.abs(offset_x) <= reach_x) & (np.abs(offset_y) <= reach_y)
        return np.where(hit, box.center[2] + box.half_size[2], -np.inf)
    rotation = rotation_matrix(box.quaternion)
    lowest, highest = np.float64(-np.inf), np.float64(np.inf)
    inside: NDArray[np.bool_] = np.ones((), dtype=bool)
    for axis, half in enumerate(box.half_size):
        # Coordinate along the box's axis: start at the height of the centre, climb by `rise` per metre of height.
        start = rotation[0, axis] * offset_x + rotation[1, axis] * offset_y
        rise = rotation[2, axis]
        if abs(rise) < 1e-12:
            inside = inside & (np.abs(start) <= half + EDGE_TOLERANCE)
            continue
        middle, span = -start / rise, half / abs(rise)
        # The tolerance decides only whether a line hits, not the height at which it leaves.
        lowest = np.maximum(lowest, middle - span - EDGE_TOLERANCE)
        highest = np.minimum(highest, middle + span)
    hit = inside & (lowest <= highest)
    return np.where(hit, box.center[2] + highest, -np.inf)


def height_field_top(field: HeightField, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of a height field's surface at (x, y) [m]; -inf outside of the grid.

    MuJoCo's collision and ray functions split the surface into the same flat triangles: each cell has the diagonal from its
    node of lowest x and y to its node of highest. ``x`` and ``y`` are in the world frame [m], of shapes that broadcast to that of
    the heights.
    """
    rows, columns = field.heights.shape
    # Grid coordinates: columns count along +x, rows along +y, from the corner of lowest x and y.
    along_x = (x - field.center[0] + field.half_size[0]) * ((columns - 1) / (2.0 * field.half_size[0]))
    along_y = (y - field.center[1] + field.half_size[1]) * ((rows - 1) / (2.0 * field.half_size[1]))
    reach_x, reach_y = (half + EDGE_TOLERANCE for half in field.half_size)
    inside_x, inside_y = np.abs(x - field.center[0]) <= reach_x, np.abs(y - field.center[1]) <= reach_y
    along_x, along_y = np.where(inside_x, along_x, 0.0), np.where(inside_y, along_y, 0.0)
    column = np.clip(np.floor(along_x), 0, columns - 2).astype(np.int64)
    row = np.clip(np.floor(along_y), 0, rows - 2).astype(np.int64)
    u, v = along_x - column, along_y - row
    near, far = field.heights[row, column], field.heights[row + 1, column + 1]
    # The triangle's third corner lies on the +x side of the diagonal where u >= v, else on the +y side.
    right, left = field.heights[row, column + 1], field.heights[row + 1, column]
    below_diagonal = near + u * (right - near) + v * (far - right)
    above_diagonal = near + v * (left - near) + u * (far - left)
    return np.where(inside_x & inside_y, np.where(u >= v, below_diagonal, above_diagonal), -np.inf)


def rotation_matrix(quaternion: tuple[float, float, float, float]) -> FloatArray:
    """Return the rotation matrix (3, 3) of a quaternion wxyz of any length; columns are the rotated axes."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
