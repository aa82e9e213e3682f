"""Build the ground for training: one small tile per world, centred at the origin, of nine kinds at twelve levels.

A tile is 8 x 8 m. The robot starts near its centre and has crossed it when it is more than half a tile away. Kinds and
difficulties start from the published training code, with these differences:

- Every world has its own tile. Level ground surrounds it: the floor plane, or around pits and patches a rim of boxes as high
  as the tile's edge, which ends at ``TileShape.extent``.
- Flat, slopes, stairs, obstacles and bars are boxes, which GPU engines collide four times as fast as height fields and
  which keep risers vertical. Only the wave and the rough slope are height fields.
- Robots cannot walk around the obstacles: stairs, slopes and bars are square rings about the start, obstacles a patchwork
  without gaps. Nothing can be below the floor plane, so patchwork and start stand as high as its pits are deep.
- The seed draws every measure that a robot must not learn by heart: treads and risers, width, gap and height of bars,
  length, height, direction and place of waves, the size of patches.
- Levels go beyond the hardest level of the gauge, since a robot at the limit of its training fails half of the time.
- Slopes are plain truncated pyramids with the platform of the stairs, 2.7 m of slope on each side. The published slopes
  are products of two ramps, cut off 2.4 m from the centre, with 1.6 m of slope.
- Heights are not rounded down to 5 mm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from ..files.parsing import NotNegative, Positive, Share, did_you_mean
from .base import Box, FloatArray, HeightField, Pose, Terrain
from .registry import TerrainError
from .tile_geometry import (
    edge_taper,
    grid_coordinates,
    patchwork,
    roughness,
    square_block,
    square_frame,
    square_hill,
    square_pit_walls,
)

NUM_TILE_LEVELS = 12
"""Number of levels, 0..11; the difficulty of a level is level / 10. The gauge's hardest ground is that of level 8 to 10."""
TILE_SIZE = 8.0
"""Side of a tile [m]; a robot more than half of it from the centre, horizontally, has crossed the tile."""

_EDGE = TILE_SIZE / 2
_FIELD_EDGE = 5.6  # half the side of height fields: waves go on beyond the tile and come down outside of it [m]
_LAST_RISER = 0.2  # least distance from the last riser or bar to the tile's edge: robots cross it before the edge [m]
_OVERLAP = 0.2  # length of a step under the next one, so that no crack opens between them [m]

Range = tuple[float, float]
_Grown = tuple[Positive, NotNegative]
_Shares = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]


@dataclass(frozen=True, kw_only=True)
class TileShape:
    """Dimensions of the tiles. Pairs are a value at difficulty 0 and its growth up to difficulty 1, or a range to draw from."""

    platform_radius: Positive = 1.3
    """Half the side of the level square in the middle of slopes and stairs [m]."""
    slope_gradient: _Grown = (0.10, 0.52)
    """Rise over run at difficulty 0, and its growth up to 1."""
    stair_riser: _Grown = (0.05, 0.23)
    """Mean height of a step at difficulty 0, and its growth up to 1 [m]."""
    stair_tread: Range = (0.28, 0.36)
    """Range of a flight's mean depth of a step [m]."""
    stair_irregularity: Share = 0.15
    """Largest share by which treads and risers of one flight differ from their mean; the share is drawn from 0 to this."""
    stair_count: Annotated[int, Field(ge=1, le=1000)] = 9
    """Largest number of risers between the platform and the tile's edge."""
    obstacle_height: _Grown = (0.05, 0.25)
    """Height of obstacles and bars over the start, and depth of pits, at difficulty 0, and its growth up to 1 [m]."""
    obstacle_free_radius: float = 1.5
    """Half the side of the level square around the start between obstacles [m]."""
    obstacle_shares: _Shares = (0.15, 0.2, 0.3, 0.2, 0.15)
    """Shares of the patches at -1, -1/2, 0, 1/2 and 1 times ``obstacle_height`` over the start."""
    bar_start: Range = (1.3, 1.7)
    """Range of half the side of the level square inside the first bar [m]."""
    bar_width: Range = (0.3, 1.2)
    """Range of a bar's width [m]."""
    bar_gap: Range = (0.5, 1.2)
    """Range of the distance between two bars [m]."""
    bar_height: Range = (0.8, 1.0)
    """Range of a bar's height as a share of ``obstacle_height``."""
    wave_steepness: _Grown = (0.20, 0.60)
    """Largest gradient of each of the two waves at difficulty 0, and its growth up to 1; 2 pi amplitude / length."""
    wave_length: Range = (1.4, 2.8)
    """Range of each wave's length [m]."""
    wave_share: Range = (0.75, 1.0)
    """Range of each wave's gradient as a share of ``wave_steepness``."""
    roughness: NotNegative = 0.05
    """Largest height above and below the smooth surface of rough slopes [m]; waves have a share of it, drawn from 0 to 1."""
    taper: Positive = 0.8
    """Width of the zone in which a height field comes down to the floor at its edge [m]."""
    extent: Annotated[float, Field(gt=_EDGE, le=1000.0)] = 40.0
    """Half the side of the rim around pits [m]; the floor beyond is as deep as the pit."""

    def __post_init__(self) -> None:
        if self.platform_radius + self.stair_tread[0] > _EDGE - _LAST_RISER:
            raise TerrainError(
                f"a platform of radius {self.platform_radius} m leaves no room for two steps of {self.stair_tread[0]} m "
                f"within {_EDGE - _LAST_RISER:g} m of the centre; use shorter steps or a smaller platform"
            )
        if not 0 < self.obstacle_free_radius < _EDGE:
            raise TerrainError(
                f"obstacle_free_radius is {self.obstacle_free_radius} m; it must be above 0 and less than the tile's "
                f"{_EDGE:g} m, so that there is room for obstacles"
            )
        if not sum(self.obstacle_shares) > 0:
            raise TerrainError("obstacle_shares are all 0; at least one must be above 0")
        for name in ("stair_tread", "bar_start", "bar_width", "bar_gap", "bar_height", "wave_length", "wave_share"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise TerrainError(f"{name} is {low}, {high}; a range needs two numbers above 0, the smaller one first")


DEFAULT_SHAPE = TileShape()

Ground = tuple[Box, ...] | HeightField
"""Boxes or height field of a tile, beside the floor plane."""


@dataclass(frozen=True, kw_only=True)
class TileKind:
    """Recipe for tiles of one kind."""

    build: Callable[[float, TileShape, np.random.Generator], Ground]
    """Function of the difficulty (level / 10), the dimensions and the seed's random numbers."""
    random: bool = True
    """True where tiles differ from seed to seed."""
    levelled: bool = True
    """True where tiles differ from level to level."""


def make_tile(kind: str, level: int, seed: int = 0, *, shape: TileShape = DEFAULT_SHAPE) -> Terrain:
    """Build a training tile.

    Args:
        kind: a key of ``TILE_KINDS``.
        level: 0..11.
        seed: chooses among the tiles of a random kind; the same arguments give the same tile. Other kinds ignore it.

    Returns:
        A terrain with one spawn, ``train``, on the ground in the middle. Its family is ``tile_field`` for the kinds
        with a height field and ``tile_boxes`` for all others.

    Raises:
        TerrainError: unknown kind or level.
    """
    if kind not in TILE_KINDS:
        hint = did_you_mean(kind, TILE_KINDS) or f"; choose one of: {', '.join(TILE_KINDS)}"
        raise TerrainError(f"unknown kind of training tile '{kind}'{hint}")
    if level not in range(NUM_TILE_LEVELS):
        raise TerrainError(f"training tile '{kind}' has levels 0 to {NUM_TILE_LEVELS - 1}, not {level}")
    random = np.random.default_rng((seed, list(TILE_KINDS).index(kind), level))
    built = TILE_KINDS[kind].build(level / 10, shape, random)
    if isinstance(built, HeightField):
        built.heights.setflags(write=False)
        ground = Terrain(name=f"tile_{kind}", family="tile_field", level=level, height_field=built)
    else:
        ground = Terrain(name=f"tile_{kind}", family="tile_boxes", level=level, boxes=built)
    return replace(ground, spawns={"train": Pose(position=(0.0, 0.0, float(ground.height(0.0, 0.0))))})


def _at(difficulty: float, pair: tuple[float, float]) -> float:
    return pair[0] + pair[1] * difficulty


def _flat(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    return ()


def _slope_up(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    platform, gradient = shape.platform_radius, _at(difficulty, shape.slope_gradient)
    rim = square_frame(_EDGE, shape.extent, gradient * (_EDGE - platform))
    return square_pit_walls(platform, _EDGE, gradient) + rim


def _slope_down(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    return square_hill(shape.platform_radius, _EDGE, _at(difficulty, shape.slope_gradient))


def _flight(difficulty: float, shape: TileShape, random: np.random.Generator) -> tuple[list[float], list[float]]:
    """Return radius and height of each riser, inside out [m]."""
    tread, irregularity = random.uniform(*shape.stair_tread), random.uniform(0.0, shape.stair_irregularity)
    treads, risers = 1.0 + irregularity * random.uniform(-1.0, 1.0, (2, shape.stair_count))
    radii = shape.platform_radius + np.concatenate(([0.0], np.cumsum(tread * treads[:-1])))
    fitting = int((radii <= _EDGE - _LAST_RISER).sum())
    return radii[:fitting].tolist(), (_at(difficulty, shape.stair_riser) * risers[:fitting]).tolist()


def _stairs_up(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    radii, risers = _flight(difficulty, shape, random)
    outer = [radius + _OVERLAP for radius in radii[1:]] + [shape.extent]  # the last step is the rim
    heights = np.cumsum(risers).tolist()
    return tuple(b for frame in zip(radii, outer, heights, strict=True) for b in square_frame(*frame))


def _stairs_down(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    radii, risers = _flight(difficulty, shape, random)
    return tuple(square_block(radius, sum(risers[step:])) for step, radius in enumerate(radii))


def _obstacles(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    """Build patches of five heights around the start, without gaps: edges are up to twice the obstacle height."""
    height, free = _at(difficulty, shape.obstacle_height), shape.obstacle_free_radius
    shares = np.array(shape.obstacle_shares) / sum(shape.obstacle_shares)
    boxes = [square_block(free, height), *square_frame(_EDGE, shape.extent, height)]
    for x_range, y_range in patchwork(free, _EDGE, random):
        top = height * (1.0 + random.choice((-1.0, -0.5, 0.0, 0.5, 1.0), p=shares))
        if top > 0:
            (x, half_x), (y, half_y) = (((a + b) / 2, (b - a) / 2) for a, b in (x_range, y_range))
            boxes.append(Box(center=(x, y, top / 2), half_size=(half_x, half_y, top / 2)))
    return tuple(boxes)


def _bars(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    """Build square rings about the start, each to be climbed and left again."""
    height = _at(difficulty, shape.obstacle_height)
    boxes: list[Box] = []
    inner = random.uniform(*shape.bar_start)
    while inner <= _EDGE - _LAST_RISER:
        outer = inner + random.uniform(*shape.bar_width)
        boxes += square_frame(inner, outer, height * random.uniform(*shape.bar_height))
        inner = outer + random.uniform(*shape.bar_gap)
    return tuple(boxes)


def _wave(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    """Build two waves at right angles, each with its own length, height and place, in a random direction."""
    x, y = grid_coordinates(_FIELD_EDGE)
    steepness = _at(difficulty, shape.wave_steepness)
    direction = random.uniform(0.0, math.pi)
    rough = shape.roughness * random.uniform()
    lifted = rough + roughness(len(x), rough, random)
    for turn in (0.0, math.pi / 2):
        length = random.uniform(*shape.wave_length)
        amplitude = steepness * random.uniform(*shape.wave_share) * length / (2 * math.pi)
        along = math.cos(direction + turn) * x + math.sin(direction + turn) * y
        lifted += amplitude * (1.0 + np.sin(2 * math.pi * along / length + random.uniform(0.0, 2 * math.pi)))
    return _field(lifted * edge_taper(x, y, _FIELD_EDGE, shape.taper))


def _rough_slope(difficulty: float, shape: TileShape, random: np.random.Generator) -> Ground:
    x, y = grid_coordinates(_FIELD_EDGE)
    radius = np.maximum(np.maximum(np.abs(x), np.abs(y)), shape.platform_radius)
    smooth = _at(difficulty, shape.slope_gradient) * (_EDGE - radius).clip(0.0)
    lifted = shape.roughness + roughness(len(x), shape.roughness, random)
    return _field(smooth + lifted * edge_taper(x, y, _EDGE, shape.taper))


def _field(heights: FloatArray) -> HeightField:
    return HeightField(center=(0.0, 0.0), half_size=(_FIELD_EDGE, _FIELD_EDGE), heights=heights)


TILE_KINDS: dict[str, TileKind] = {
    "wave": TileKind(build=_wave),
    "slope_up": TileKind(build=_slope_up, random=False),
    "slope_down": TileKind(build=_slope_down, random=False),
    "rough_slope": TileKind(build=_rough_slope),
    "stairs_up": TileKind(build=_stairs_up),
    "stairs_down": TileKind(build=_stairs_down),
    "obstacles": TileKind(build=_obstacles),
    "flat": TileKind(build=_flat, random=False, levelled=False),
    "bars": TileKind(build=_bars),
}
"""All kinds of tile by name. An entry's place decides its random numbers, so new kinds go to the end."""
