"""Build the gauge's terrains in a robot's own measure: lengths by its leg, heights as a share of that, starts on the ground."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from .base import Pose, Terrain
from .gauge_terrains import STAIR_TREAD, flat, obstacle, slope, stairs, wave
from .shapes import Box, TerrainError

GO2_LEG = 0.426
"""Leg length [m] of the robot that the published terrains are made for."""
_BUILDERS = {"slope": slope, "stairs": stairs, "wave": wave, "obstacle": obstacle}
_FOOT = 0.18
"""Radius around a start, over the leg's length, within which no ground is above the feet."""


def measured_terrain(name: str, level: int, *, leg: float, rise: float) -> Terrain:
    """Build a terrain of the gauge for a robot of another size.

    Args:
        name: ``flat``, or another terrain of the gauge.
        level: 1..10, 0 for ``flat``.
        leg: length of the robot's stretched leg [m]; all lengths are the published ones times leg / ``GO2_LEG``.
        rise: heights, and the gradient of the slope, as a share of what the published ones are in this measure.

    Raises:
        TerrainError: another terrain.
    """
    if name == "flat":
        return flat()
    family, _, direction = name.partition("_")
    if family not in _BUILDERS:
        raise TerrainError(f"terrain '{name}' is none of the gauge's own, which alone have a robot's measure")
    way = {"backward": direction == "bd"} if direction else {}
    base = _BUILDERS[family](level, rise=rise, **way)  # type: ignore[operator]
    scale = leg / GO2_LEG

    def longer(values: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = (scale * value for value in values)
        return x, y, z

    boxes = tuple(
        Box(center=longer(b.center), half_size=longer(b.half_size), quaternion=b.quaternion, wall=b.wall)
        for b in base.boxes
    )
    field = base.height_field
    if field is not None:
        field = replace(
            field,
            center=(scale * field.center[0], scale * field.center[1]),
            half_size=(scale * field.half_size[0], scale * field.half_size[1]),
            heights=scale * field.heights,
            base=scale * field.base,
        )
    grown = replace(base, boxes=boxes, height_field=field, target=base.target and longer(base.target))
    around = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    spawns = {}
    for stage, pose in base.spawns.items():
        x, y, z = pose.position
        if family == "stairs":  # the middle of what is seen of a step: a tenth of the next one covers its end
            x = (math.floor(x / STAIR_TREAD) + 0.4) * STAIR_TREAD
        elif family == "obstacle":  # the middle of a gap, not the edge of a bar
            x = 2.0 * math.floor(x / 2.0) + 0.5
        x, y, _ = longer((x, y, z))
        near = [
            grown.height(x + r * np.cos(around), y + r * np.sin(around)) for r in (0.0, 0.5 * _FOOT * leg, _FOOT * leg)
        ]
        spawns[stage] = Pose(position=(x, y, float(np.max(near))), yaw=pose.yaw)
    return replace(grown, spawns=spawns)
