"""The ground that policies learn on: one small tile per world, centred at the origin, eight kinds at ten levels.

A tile is 8 x 8 m. The robot starts near its centre and has crossed it when it is more than half a tile away. Kinds,
proportions and difficulties follow the published training code; decided differently here:

- Every world has its own tile, so beyond it comes no next one but level ground: the floor plane, or around pits a rim
  of boxes as high as the tile's edge, which ends at ``TileShape.extent``.
- Flat, slopes, stairs and obstacles are boxes, which GPU engines collide four times as fast as height fields and which
  keep risers vertical. Only the wave and the rough slope are height fields; they come down to the floor at the edge.
- Obstacles stand on the floor, none are holes in it (nothing can be below the floor plane): the rectangles have the
  heights h and h/2, not +-h and +-h/2, and rectangles that would cover the start are drawn again.
- Slopes are plain truncated pyramids with the platform of the stairs, 2.7 m of slope on each side. The published ones
  are products of two ramps that are cut off 2.4 m from the centre and leave 1.6 m of slope.
- Heights are not rounded down to 5 mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from .base import Box, FloatArray, HeightField, Pose, Terrain
from .registry import TerrainError
from .tile_geometry import (
    edge_taper,
    grid_coordinates,
    roughness,
    square_block,
    square_frame,
    square_hill,
    square_pit_walls,
)

TRAINING_MIX: Mapping[str, float] = MappingProxyType(
    {
        "wave": 0.05,
        "slope_up": 0.10,
        "slope_down": 0.10,
        "rough_slope": 0.05,
        "stairs_up": 0.25,
        "stairs_down": 0.10,
        "obstacles": 0.20,
        "flat": 0.15,
    }
)
"""Share of the worlds that train on each kind."""

TILE_KINDS = tuple(TRAINING_MIX)
"""All kinds of tile; a kind's number is its place here."""
FIELD_KINDS = frozenset({"wave", "rough_slope"})
"""Kinds that are height fields; all others are boxes (``flat`` has none)."""
RANDOM_KINDS = frozenset({"wave", "rough_slope", "obstacles"})
"""Kinds that differ from seed to seed."""
LEVELLESS_KINDS = frozenset({"flat"})
"""Kinds that are the same at every level."""

NUM_TILE_LEVELS = 10
"""Levels are 0..9; the difficulty of a level is level / 10."""
TILE_SIZE = 8.0
"""Side of a tile [m]; more than half of it from the centre, horizontally, the robot has crossed the tile."""
MAX_TILE_BOXES = 36
"""No tile of the default shape has more boxes; a model with this many can hold every tile."""


@dataclass(frozen=True, kw_only=True)
class TileShape:
    """Dimensions of the tiles. Pairs are the value at difficulty 0 and its growth up to difficulty 1."""

    platform_radius: float = 1.3
    """Half the side of the level square in the middle of slopes and stairs [m]."""
    slope_gradient: tuple[float, float] = (0.10, 0.52)
    """Rise over run."""
    stair_riser: tuple[float, float] = (0.05, 0.23)
    """Height of a step [m]."""
    stair_tread: float = 0.30
    """Depth of a step [m]."""
    stair_count: int = 9
    """Number of risers between the platform and the tile's edge."""
    obstacle_height: tuple[float, float] = (0.05, 0.25)
    """Height of the higher rectangles; the lower ones have half of it [m]."""
    obstacle_count: int = 20
    """Number of rectangles."""
    obstacle_sides: tuple[float, ...] = (1.0, 1.4, 1.8)
    """Side lengths to choose from [m]."""
    obstacle_lattice: float = 0.4
    """Rectangles have their corners on a lattice of this spacing [m]."""
    obstacle_free_radius: float = 1.5
    """Half the side of the square around the start that stays free [m]."""
    wave_amplitude: tuple[float, float] = (0.05, 0.10)
    """Amplitude of each of the two waves [m]."""
    wave_length: float = 1.6
    """Wavelength [m]."""
    roughness: float = 0.05
    """Largest height above and below the smooth surface of waves and rough slopes [m]."""
    taper: float = 0.8
    """Width of the zone in which a height field comes down to the floor at the tile's edge [m]."""
    extent: float = 40.0
    """Half the side of the rim around pits [m]; beyond it is the floor, as deep below as the pit."""

    def __post_init__(self) -> None:
        half = TILE_SIZE / 2
        if self.platform_radius + self.stair_tread * self.stair_count > half + 1e-9:
            raise TerrainError(
                f"a platform of radius {self.platform_radius} m and {self.stair_count} steps of {self.stair_tread} m "
                f"do not fit within {half} m of the centre; use fewer or shorter steps or a smaller platform"
            )
        longest = max(self.obstacle_sides)
        if self.obstacle_free_radius + longest > half:
            raise TerrainError(
                f"obstacles of {longest} m do not fit between the free square of radius {self.obstacle_free_radius} m "
                f"and the tile's edge at {half} m; use shorter sides or a smaller free square"
            )


def make_tile(kind: str, level: int, seed: int = 0, *, shape: TileShape | None = None) -> Terrain:
    """Build a training tile.

    Args:
        kind: one of ``TILE_KINDS``.
        level: 0..9.
        seed: chooses among the tiles of a random kind; the same arguments give the same tile. Other kinds ignore it.
        shape: dimensions; None for the defaults.

    Returns:
        A terrain with one spawn, ``train``, on the ground in the middle. Its family is ``tile_field`` for the kinds
        with a height field and ``tile_boxes`` for all others.

    Raises:
        TerrainError: unknown kind or level.
    """
    if kind not in TRAINING_MIX:
        close = get_close_matches(kind, TILE_KINDS, n=1)
        hint = f"did you mean '{close[0]}'?" if close else f"choose one of: {', '.join(TILE_KINDS)}"
        raise TerrainError(f"unknown kind of training tile '{kind}'; {hint}")
    if level not in range(NUM_TILE_LEVELS):
        raise TerrainError(f"training tile '{kind}' has levels 0 to {NUM_TILE_LEVELS - 1}, not {level}")
    shape = TileShape() if shape is None else shape
    difficulty = level / NUM_TILE_LEVELS
    random = np.random.default_rng((seed, TILE_KINDS.index(kind), level))
    boxes: tuple[Box, ...] = ()
    field = None
    if kind in FIELD_KINDS:
        build = _wave_heights if kind == "wave" else _rough_slope_heights
        heights = build(difficulty, shape, random)
        heights.setflags(write=False)
        field = HeightField(center=(0.0, 0.0), half_size=(TILE_SIZE / 2, TILE_SIZE / 2), heights=heights)
    elif kind == "obstacles":
        boxes = _obstacles(difficulty, shape, random)
    elif kind != "flat":
        boxes = _slope_or_stairs(kind, difficulty, shape)
    family = "tile_boxes" if field is None else "tile_field"
    ground = Terrain(name=f"tile_{kind}", family=family, level=level, boxes=boxes, height_field=field)
    start = Pose(position=(0.0, 0.0, float(ground.height(0.0, 0.0))))
    return replace(ground, spawns={"train": start})


@dataclass(frozen=True, kw_only=True, eq=False)
class TilePalette:
    """All tiles of a training run, and where to find which."""

    terrains: tuple[Terrain, ...]
    """The tiles, each once."""
    index: NDArray[np.int64]
    """Place in ``terrains`` of a kind (by its place in ``TILE_KINDS``), level and variant, (kinds, levels, variants).
    Kinds that are not random have one tile for all variants, ``flat`` has one for all levels."""


def tile_palette(*, variants: int = 4, seed: int = 0, shape: TileShape | None = None) -> TilePalette:
    """Build every kind of tile at every level.

    Args:
        variants: how many different tiles of each random kind and level.
        seed: seed of the first variant; the others follow.
        shape: dimensions; None for the defaults.

    Raises:
        TerrainError: no variant was asked for.
    """
    if variants < 1:
        raise TerrainError(f"a palette needs at least 1 variant of each tile, not {variants}")
    terrains: list[Terrain] = []
    index = np.zeros((len(TILE_KINDS), NUM_TILE_LEVELS, variants), dtype=np.int64)
    for number, kind in enumerate(TILE_KINDS):
        for level in range(NUM_TILE_LEVELS):
            for variant in range(variants):
                if kind in LEVELLESS_KINDS and level > 0:
                    index[number, level, variant] = index[number, 0, 0]
                elif kind not in RANDOM_KINDS and variant > 0:
                    index[number, level, variant] = index[number, level, 0]
                else:
                    index[number, level, variant] = len(terrains)
                    terrains.append(make_tile(kind, level, seed + variant, shape=shape))
    return TilePalette(terrains=tuple(terrains), index=index)


def _at(difficulty: float, pair: tuple[float, float]) -> float:
    return pair[0] + pair[1] * difficulty


def _slope_or_stairs(kind: str, difficulty: float, shape: TileShape) -> tuple[Box, ...]:
    edge, platform = TILE_SIZE / 2, shape.platform_radius
    if kind.startswith("slope"):
        gradient = _at(difficulty, shape.slope_gradient)
        if kind == "slope_down":
            return square_hill(platform, edge, gradient)
        rim = square_frame(edge, shape.extent, gradient * (edge - platform))
        return square_pit_walls(platform, edge, gradient) + rim
    riser = _at(difficulty, shape.stair_riser)
    radii = [platform + shape.stair_tread * step for step in range(shape.stair_count)]  # of the risers, inside out
    if kind == "stairs_down":
        return tuple(square_block(r, riser * (shape.stair_count - step)) for step, r in enumerate(radii))
    # Each step reaches a tread's depth under the next one, so that no crack opens between them; the last is the rim.
    outer = [r + 2 * shape.stair_tread for r in radii[:-1]] + [shape.extent]
    frames = (square_frame(r, o, riser * (step + 1)) for step, (r, o) in enumerate(zip(radii, outer, strict=True)))
    return tuple(box for frame in frames for box in frame)


def _obstacles(difficulty: float, shape: TileShape, random: np.random.Generator) -> tuple[Box, ...]:
    edge, free = TILE_SIZE / 2, shape.obstacle_free_radius
    height = _at(difficulty, shape.obstacle_height)
    cells = int(TILE_SIZE / shape.obstacle_lattice + 1e-9)
    boxes: list[Box] = []
    while len(boxes) < shape.obstacle_count:
        side_x, side_y = random.choice(shape.obstacle_sides, 2)
        corner_x, corner_y = random.integers(0, cells, 2) * shape.obstacle_lattice - edge
        high = height if random.random() < 0.5 else height / 2
        x, y = corner_x + side_x / 2, corner_y + side_y / 2
        outside = corner_x + side_x > edge + 1e-9 or corner_y + side_y > edge + 1e-9
        covers_start = abs(x) < free + side_x / 2 and abs(y) < free + side_y / 2
        if not outside and not covers_start:
            boxes.append(
                Box(center=(float(x), float(y), high / 2), half_size=(float(side_x / 2), float(side_y / 2), high / 2))
            )
    return tuple(boxes)


def _wave_heights(difficulty: float, shape: TileShape, random: np.random.Generator) -> FloatArray:
    x, y = grid_coordinates(TILE_SIZE / 2)
    amplitude = _at(difficulty, shape.wave_amplitude)
    number = 2 * np.pi / shape.wave_length
    wave = amplitude * (np.sin(number * x) + np.cos(number * y))
    lifted = 2 * amplitude + shape.roughness + wave + roughness(len(x), shape.roughness, random)
    heights: FloatArray = lifted * edge_taper(x, y, TILE_SIZE / 2, shape.taper)
    return heights


def _rough_slope_heights(difficulty: float, shape: TileShape, random: np.random.Generator) -> FloatArray:
    x, y = grid_coordinates(TILE_SIZE / 2)
    edge, gradient = TILE_SIZE / 2, _at(difficulty, shape.slope_gradient)
    from_edge = edge - np.maximum(np.maximum(np.abs(x), np.abs(y)), shape.platform_radius)
    lifted = shape.roughness + roughness(len(x), shape.roughness, random)
    heights: FloatArray = gradient * from_edge + lifted * edge_taper(x, y, edge, shape.taper)
    return heights
