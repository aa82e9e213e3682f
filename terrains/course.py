"""Ground as a course of solid boxes: stretches one after another along x, level or sloping, or stairs up or down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from .base import Box
from .registry import TerrainError

_THICKNESS = 0.4
"""Thickness of a sloping plate [m]: no foot passes through it in a substep."""
_FLOOR = 1e-6
"""Largest height of a stretch that is the floor itself [m]."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A piece of a course."""

    length: Annotated[float, Field(gt=0.0, le=200.0)]
    """Length along x [m]."""
    rise: Annotated[float, Field(ge=-50.0, le=50.0)] = 0.0
    """Height of the end above the beginning [m]; negative for a stretch that leads down."""
    steps: Annotated[int, Field(ge=0, le=200)] = 0
    """Number of equal steps, each a riser and then its tread; 0 for one plane."""


def course_boxes(
    stretches: Sequence[Stretch], *, begin: float, height: float, width: float, source: str
) -> tuple[Box, ...]:
    """Return the boxes of a course, which stand on the floor; after its last stretch the floor goes on.

    Args:
        begin: x of the beginning [m].
        height: of the ground there [m].
        width: along y, half of it on either side of y = 0 [m].
        source: the beginning of an error's sentence.

    Raises:
        TerrainError: the course leads below the floor.
    """
    boxes: list[Box] = []
    x, z = begin, height
    for number, stretch in enumerate(stretches, 1):
        end = z + stretch.rise
        if min(z, end) < -_FLOOR:
            deep = f"stretch {number} leads to {min(z, end):.3g} m, below the floor"
            raise TerrainError(f"{source}: {deep}; raise the height at which the ground begins")
        if stretch.steps:
            tread = stretch.length / stretch.steps
            tops = [z + stretch.rise * (i + 1) / stretch.steps for i in range(stretch.steps)]
            boxes += [_block(x + tread * (i + 0.5), tread, width, top) for i, top in enumerate(tops) if top > _FLOOR]
        elif stretch.rise:
            boxes.append(_ramp(x, z, stretch, width))
        elif z > _FLOOR:
            boxes.append(_block(x + 0.5 * stretch.length, stretch.length, width, z))
        x, z = x + stretch.length, end
    return tuple(boxes)


def _block(middle: float, length: float, width: float, top: float) -> Box:
    return Box(center=(middle, 0.0, 0.5 * top), half_size=(0.5 * length, 0.5 * width, 0.5 * top))


def _ramp(x: float, z: float, stretch: Stretch, width: float) -> Box:
    """Return a plate with an upper face from (x, z) to the stretch's end."""
    angle, down = math.atan2(stretch.rise, stretch.length), 0.5 * _THICKNESS
    middle = (x + 0.5 * stretch.length, z + 0.5 * stretch.rise)
    return Box(
        center=(middle[0] + down * math.sin(angle), 0.0, middle[1] - down * math.cos(angle)),
        half_size=(0.5 * stretch.length / math.cos(angle), 0.5 * width, down),
        quaternion=(math.cos(0.5 * angle), 0.0, -math.sin(0.5 * angle), 0.0),
    )
