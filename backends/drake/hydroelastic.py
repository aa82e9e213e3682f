"""Height fields for Drake: a closed mesh, the stiffness of shapes that meet it, and what a contact surface says."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import ContactSurface

from ...terrains.base import HeightField
from ..sequential import Shape

MODULUS = 1e6
"""Hydroelastic modulus of the robot's shapes but the feet [Pa]: a Go2 on its trunk sinks 0.2 mm; at 10⁷ a body that strikes the
ground while it slides at 3 m/s is thrown up by the solver's approximation."""
FOOT_MODULUS = 1e7
"""Hydroelastic modulus of the feet on height fields [Pa]."""
FOOT_RESOLUTION = 0.35
"""Edge length of a foot's tetrahedra over its radius."""
RESOLUTION = 2.0
"""Edge length of the other shapes' tetrahedra over their smallest half size."""


def field_mesh(field: HeightField) -> str:
    """Return a height field as a closed triangle mesh, its faces outwards, in the text of an OBJ file.

    Cells are cut along the same diagonal as MuJoCo's: from the node of the smallest row and column to the opposite one.
    """
    rows, columns = field.heights.shape
    x = field.center[0] + np.linspace(-field.half_size[0], field.half_size[0], columns)
    y = field.center[1] + np.linspace(-field.half_size[1], field.half_size[1], rows)
    grid_x, grid_y = np.meshgrid(x, y)
    top = np.stack([grid_x, grid_y, field.heights], axis=-1).reshape(-1, 3)
    bottom = top * [1.0, 1.0, 0.0] - [0.0, 0.0, field.base]
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    up = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([at[0, :], at[1:, -1], at[-1, -2::-1], at[-2:0:-1, 0]])
    after, below = np.roll(rim, -1), rows * columns
    side = np.concatenate([np.stack([rim + below, after + below, after], 1), np.stack([rim + below, after, rim], 1)])
    faces = np.concatenate([up, up[:, ::-1] + below, side]) + 1
    lines = [f"v {p[0]:.9g} {p[1]:.9g} {p[2]:.9g}" for p in np.concatenate([top, bottom])]
    lines += [f"f {f[0]} {f[1]} {f[2]}" for f in faces]
    return "\n".join(lines) + "\n"


def mean_normal(surface: ContactSurface) -> np.ndarray:
    """Return the mean normal of a contact surface, out of its second geometry into its first, (3,)."""
    normal = sum(surface.area(face) * surface.face_normal(face) for face in range(surface.num_faces()))
    return normal / np.linalg.norm(normal)


def modulus(shape: Shape) -> float:
    """Return the hydroelastic modulus of a robot's shape [Pa]."""
    return FOOT_MODULUS if shape.foot >= 0 else MODULUS


def thickness(shape: Shape) -> float:
    """Return the depth over which the pressure of a robot's shape rises to its modulus [m]."""
    half = np.ptp(shape.vertices, axis=0) / 2.0 if shape.kind == "mesh" else shape.size[shape.size > 0.0]
    return float(half.min())


def deepest(surface: ContactSurface, shape: Shape) -> float:
    """Return the depth of a robot's shape in a rigid one [m], by the largest pressure of their contact surface."""
    pressure = surface.poly_e_MN()
    largest = max(pressure.EvaluateAtVertex(v) for v in range(surface.num_vertices()))
    return largest / modulus(shape) * thickness(shape)
