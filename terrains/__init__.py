"""The ground: shapes and heights as data, for the gauge and for training. Nothing here knows an engine."""

from .base import Box, HeightField, Pose, Terrain
from .registry import TerrainError, gauge_terrain_names, make_terrain, terrain_names

__all__ = [
    "Box", "HeightField", "Pose", "Terrain", "TerrainError", "gauge_terrain_names", "make_terrain", "terrain_names",
]  # fmt: skip
