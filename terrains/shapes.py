"""Shapes of the ground, in metres; x forward, y left, z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class TerrainError(ValueError):
    """A terrain or level that does not exist or cannot be built; the message says what is allowed."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """A solid box."""

    center: tuple[float, float, float]
    """Centre [m]."""
    half_size: tuple[float, float, float]
    """Half extents along the box's own axes [m]."""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation, wxyz."""
    wall: bool = False
    """True for boundary walls, which stop the robot but are no ground to walk on (``height`` ignores them)."""


@dataclass(frozen=True, kw_only=True)
class HeightField:
    """A rectangular grid of heights, axis-aligned, linear between nodes as MuJoCo triangulates it."""

    center: tuple[float, float]
    """Middle of the grid [m]."""
    half_size: tuple[float, float]
    """Half extents in x and y [m]; the outermost nodes lie on the edge."""
    heights: FloatArray
    """Node heights [m], shape (rows, columns): rows run along +y, columns along +x; the lowest must be 0,
    because MuJoCo shifts every field so that it is."""
    base: float = 0.1
    """Thickness of the solid below height 0 [m]."""
