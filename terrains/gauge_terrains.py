"""Build the terrains of the gauge: seven names, five shapes, levels 1 to 10.

The geometry is that of the published RoboGauge terrains, measured in their compiled models, not that of the paper's
formulas, which differ for the slope and the wave: scores are comparable only on the same ground. The levelled terrains
occupy x in [0, 10] and y in [-5, 5] metres between four walls; ``difficulty`` is level / 10 throughout. The heights of
the start poses are the published ones too: they are not always on the ground, and at some of them a foot drops by half
a metre.
"""

from __future__ import annotations

import math

import numpy as np

from .base import Box, FloatArray, HeightField, Pose, Terrain

LEVELS = range(1, 11)
"""Levels of every gauge terrain but ``flat``."""

STAIR_RISERS = (0.08, 0.11, 0.14, 0.17, 0.18, 0.19, 0.20, 0.21, 0.22, 0.23)
"""Heights of a step at levels 1 to 10 [m]."""
STAIR_TREAD = 0.31
"""Distance from one riser to the next [m]."""
STAIR_COUNT = 33
"""Number of steps."""

_HALF_TREAD_BOX = 0.186  # 1.2 x half a tread: neighbouring boxes overlap by a fifth of a tread
_STAIR_EVAL_LIFT = (0.0, 0.0, 0.03, 0.08, 0.10, 0.12, 0.14, 0.16, 0.18, 0.20)
_SLOPE_FOOT = 0.8  # x at which the slope starts to rise
_WAVE_NODES = 128
_WAVE_HEIGHT_PER_LEVEL = 0.08

_WALLS = (
    Box(center=(-0.25, 0.0, 5.0), half_size=(0.25, 5.5, 5.0), wall=True),
    Box(center=(10.25, 0.0, 5.0), half_size=(0.25, 5.5, 5.0), wall=True),
    Box(center=(5.0, 5.25, 5.0), half_size=(5.0, 0.25, 5.0), wall=True),
    Box(center=(5.0, -5.25, 5.0), half_size=(5.0, 0.25, 5.0), wall=True),
)


def flat() -> Terrain:
    """Build the bare floor plane; no walls, no target."""
    start = Pose(position=(0.0, 0.0, 0.0))
    return Terrain(name="flat", family="flat", spawns={"level_search": start, "level_eval": start})


def slope(level: int, *, backward: bool = False, rise: float = 1.0) -> Terrain:
    """Build a flat strip, then one plane that rises along +x to the far wall.

    Args:
        level: 1..10; the gradient is 0.10 + 0.47 x difficulty.
        backward: the robot starts turned around and walks backwards up the same slope.
        rise: factor on the gradient, 1 for the published one; of the other terrains, on all heights.
    """
    gradient = slope_gradient(level) * rise
    angle = math.atan(gradient)
    # The top face runs from (foot, z = 0) over 10 m in x; the centre lies 0.5 m, half the thickness, below its middle.
    ramp = Box(
        center=(_SLOPE_FOOT + 5.0 + 0.5 * math.sin(angle), 0.0, 5.0 * gradient - 0.5 * math.cos(angle)),
        half_size=(5.0 / math.cos(angle), 5.0, 0.5),
        quaternion=(math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0),
    )
    return _levelled(
        "slope",
        level,
        boxes=(ramp,),
        search=(0.5, 0.0, 0.0),
        evaluation=(5.0, 0.0, 0.03 + 4.2 * gradient),
        target=(4.8, 0.0, 4.0 * gradient + 0.1),
        backward=backward,
    )


def stairs(level: int, *, backward: bool = False, rise: float = 1.0) -> Terrain:
    """Build stairs that rise along +x from wall to wall: steps of one riser's thickness that overlap, hollow underneath.

    Args:
        level: 1..10; the riser is ``STAIR_RISERS[level - 1]``.
        backward: the robot starts turned around and walks backwards up the same stairs.
        rise: as for ``slope``.
    """
    riser = STAIR_RISERS[level - 1] * rise
    half = (_HALF_TREAD_BOX, 5.0, riser / 2)
    middles = [(STAIR_TREAD * (step + 0.5), 0.0, (step + 0.5) * riser) for step in range(STAIR_COUNT)]
    steps = tuple(Box(center=middle, half_size=half) for middle in middles)
    target_z = 15 * riser + 0.15
    return _levelled(
        "stairs",
        level,
        boxes=steps,
        search=(1.15, 0.0, 5 * riser - 0.05),
        evaluation=(4.85, 0.0, 0.05 + target_z + _STAIR_EVAL_LIFT[level - 1]),
        target=(4.5, 0.0, target_z),
        backward=backward,
    )


def obstacle(level: int, *, rise: float = 1.0) -> Terrain:
    """Build five bars across the whole width, 1 m long with gaps of 1 m, 0.05 + 0.23 x difficulty high [m]; ``rise`` as for ``slope``."""
    height = (0.05 + 0.23 * level / 10) * rise
    bars = tuple(Box(center=(x, 0.0, height / 2), half_size=(0.5, 5.0, height / 2)) for x in (1.5, 3.5, 5.5, 7.5, 9.5))
    return _levelled(
        "obstacle",
        level,
        boxes=bars,
        search=(0.5, 2.0, 0.0),
        evaluation=(5.0, 0.0, 0.20 - 0.023 * (10 - level)),
        target=(6.5, -2.0, 0.3),
    )


def wave(level: int, *, rise: float = 1.0) -> Terrain:
    """Build the sum of a sine along x (wavelength 2 m) and a cosine along y (8/3 m), between 0 and 0.08 x level [m].

    ``rise`` is as for ``slope``.
    """
    heights = wave_heights(level) if rise == 1.0 else wave_heights(level) * rise
    return _levelled(
        "wave",
        level,
        height_field=HeightField(center=(5.0, 0.0), half_size=(5.0, 5.0), heights=heights, base=0.1),
        search=(1.5, 1.25, 0.0),
        evaluation=(4.55, 0.0, 0.65 - 0.075 * (10 - level)),
        target=(6.5, -2.65, _WAVE_HEIGHT_PER_LEVEL * level),
    )


def slope_gradient(level: int) -> float:
    """Return the rise over run of the slope at a level 1..10."""
    return 0.10 + 0.47 * level / 10


def wave_heights(level: int) -> FloatArray:
    """Return node heights of the wave at a level 1..10 [m], shape (128, 128), rows along +y, columns along +x, read-only.

    The fit matches the published 16-bit height map to one part in 10^5. MuJoCo's loader keeps the upper 8 bits, so the
    published ground has steps of up to 3 mm; they are kept here.
    """
    x = np.linspace(0.0, 10.0, _WAVE_NODES)
    y = np.linspace(-5.0, 5.0, _WAVE_NODES)
    normalized = 0.50009 + 0.25025 * (np.sin(np.pi * x)[None, :] + np.cos(0.75 * np.pi * y)[:, None])
    image = np.clip(np.round(65535.0 * normalized), 0.0, 65535.0)
    heights: FloatArray = np.floor(image / 256.0) / 255.0 * (_WAVE_HEIGHT_PER_LEVEL * level)
    heights.setflags(write=False)
    return heights


def _levelled(
    family: str,
    level: int,
    *,
    search: tuple[float, float, float],
    evaluation: tuple[float, float, float],
    target: tuple[float, float, float],
    boxes: tuple[Box, ...] = (),
    height_field: HeightField | None = None,
    backward: bool | None = None,
) -> Terrain:
    """Build a terrain between the walls; ``backward`` is None for a family that is crossed in one direction only."""
    suffix = {None: "", False: "_fd", True: "_bd"}[backward]
    yaw = math.pi if backward else 0.0
    return Terrain(
        name=family + suffix,
        family=family,
        level=level,
        boxes=boxes + _WALLS,
        height_field=height_field,
        spawns={"level_search": Pose(position=search, yaw=yaw), "level_eval": Pose(position=evaluation, yaw=yaw)},
        target=target,
        backward=bool(backward),
    )
