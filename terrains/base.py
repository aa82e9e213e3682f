"""Terrain as data: boxes, an optional height field, the floor plane, and the start and end of episodes.

Frame: x forward, y left, z up, metres. A terrain sits in one world of its own; nothing here knows an engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from .height import ground_height
from .shapes import Box, FloatArray, HeightField, TerrainError


@dataclass(frozen=True, kw_only=True)
class Pose:
    """A base pose: the ground point below the base and the heading."""

    position: tuple[float, float, float]
    """Ground point [m]; the robot's base starts ``Robot.stand_height`` above it."""
    yaw: float = 0.0
    """Heading about +z [rad]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """The ground of one world."""

    name: str
    """Registry name, for example ``stairs_fd``."""
    family: str
    """Terrains of one family and layout share an engine's model layout, for example ``stairs``."""
    level: int = 0
    """Difficulty 1..10; 0 where the terrain has no levels."""
    boxes: tuple[Box, ...] = ()
    height_field: HeightField | None = None
    spawns: Mapping[str, Pose] = field(default_factory=dict)
    """Start poses by stage, for example ``level_search`` and ``level_eval``."""
    target: tuple[float, float, float] | None = None
    """Goal position of the base [m], where the terrain has one."""
    backward: bool = False
    """True where the robot crosses the terrain walking backwards."""

    def __post_init__(self) -> None:
        for number, box in enumerate(self.boxes):
            for axis, half in zip("xyz", box.half_size, strict=True):
                if not half > 0.0:
                    raise TerrainError(
                        f"terrain '{self.name}' level {self.level}: box {number} (from 0) at {tuple(map(float, box.center))} m has the "
                        f"half size {half:g} m along {axis}, which must be above 0; make it larger, or leave the box out at this level"
                    )

    def height(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the height of the ground at (x, y) [m], any shape: the highest of floor, boxes and height field; no walls."""
        return ground_height(self.boxes, self.height_field, np.asarray(x), np.asarray(y))
