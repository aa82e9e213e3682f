"""Solids for training tiles: square frames, square hills and pits of boxes, and rough height fields.

Everything is centred at the origin and symmetric under quarter turns, so a shape is a function of max(|x|, |y|), here
called the radius: half the side of the square through a point.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from .base import Box, FloatArray

NODE_SPACING = 0.1
"""Distance between a height field's nodes [m]."""
_THICKNESS = 0.4  # of the tilted plates, enough that no foot passes through in a substep [m]
_BURIED = 0.05  # length of a plate below the floor, so that no crack opens between the two [m]

Quaternion = tuple[float, float, float, float]
Span = tuple[float, float]
"""Least and largest coordinate [m]."""


def square_block(radius: float, height: float) -> Box:
    """Return a solid box on the floor, ``height`` high."""
    return Box(center=(0.0, 0.0, height / 2), half_size=(radius, radius, height / 2))


def square_frame(inner: float, outer: float, height: float) -> tuple[Box, ...]:
    """Return four solid boxes on the floor that leave the square of radius ``inner`` free and end at radius ``outer``."""
    middle, half_width = (inner + outer) / 2, (outer - inner) / 2
    return tuple(
        Box(
            center=(side * middle, 0.0, height / 2) if along_x else (0.0, side * middle, height / 2),
            half_size=(half_width, outer, height / 2) if along_x else (inner, half_width, height / 2),
        )
        for along_x in (True, False)
        for side in (1, -1)
    )


def square_pit_walls(inner: float, outer: float, gradient: float) -> tuple[Box, ...]:
    """Return four tilted plates that rise from the floor at radius ``inner`` outwards to radius ``outer``.

    Neighbours cross in the corners; the higher one is the ground there: its height is ``gradient * (radius - inner)``.
    """
    angle = math.atan(gradient)
    length = (outer - inner) / math.cos(angle)
    top = ((inner + outer) / 2, 0.0, gradient * (outer - inner) / 2)
    turns = {turn: _multiply(_about_z(turn), _about_y(-angle)) for turn in _QUARTER_TURNS}
    return tuple(_plate(top, (length, 2 * outer), uphill, turn) for turn, uphill in turns.items())


def square_hill(inner: float, outer: float, gradient: float) -> tuple[Box, ...]:
    """Return a truncated pyramid, level up to radius ``inner``, then down to the floor at radius ``outer``; 13 boxes.

    Boxes are rectangles and the sides are trapezoids: each side is covered by one plate below its upper edge and by two
    along its slanting edges. All three lie in the side's plane and inside the hill or under the floor.
    """
    angle = math.atan(gradient)
    run = outer - inner
    rise = gradient * run
    length = run / math.cos(angle)  # of the side, down its fall line
    hip = math.hypot(length, run)  # length of a slanting edge
    swing = math.atan2(run, length)  # angle between the fall line and a slanting edge, within the side's plane
    boxes = [square_block(inner, rise)]
    fall = np.array([math.cos(angle), 0.0, -math.sin(angle)])
    across = np.array([0.0, 1.0, 0.0])
    for turn in _QUARTER_TURNS:
        downhill = _multiply(_about_z(turn), _about_y(angle))
        reach = length + _BURIED
        top = np.array([inner, 0.0, rise]) + reach / 2 * fall
        boxes.append(_plate(tuple(top), (reach, 2 * inner), downhill, turn))
        for side in (1, -1):
            along = math.cos(swing) * fall + side * math.sin(swing) * across
            inward = math.sin(swing) * fall - side * math.cos(swing) * across
            reach, width = hip + _BURIED, length * math.sin(swing) + _BURIED
            top = np.array([inner, side * inner, rise]) + reach / 2 * along + width / 2 * inward
            boxes.append(_plate(tuple(top), (reach, width), _multiply(downhill, _about_z(side * swing)), turn))
    return tuple(boxes)


def patchwork(inner: float, outer: float, random: np.random.Generator) -> list[tuple[Span, Span]]:
    """Return 28 rectangles (range of x, range of y) that fill the square of radius ``outer`` except that of radius ``inner``.

    Four equal regions go round the middle like the sails of a windmill. Each is cut lengthwise into two strips, and these
    at random places into three and four pieces.
    """
    width, length = outer - inner, outer + inner
    patches: list[tuple[Span, Span]] = []
    for turn in range(4):
        across = _cuts(width, 2, random)
        for strip in range(2):
            along = _cuts(length, 3 + (strip + turn) % 2, random)
            low, high = inner + across[strip], inner + across[strip + 1]
            for first, last in pairwise(along):
                x, y = (low, high), (first - inner, last - inner)
                for _ in range(turn):
                    x, y = (-y[1], -y[0]), x
                patches.append((x, y))
    return patches


def _cuts(length: float, pieces: int, random: np.random.Generator) -> list[float]:
    """Return the ends of ``pieces`` pieces of a line from 0 to ``length``, each 0.4 to 1.6 times the mean long."""
    places = np.arange(pieces + 1) + random.uniform(-0.3, 0.3, pieces + 1)
    places[0], places[-1] = 0, pieces
    return (places * (length / pieces)).tolist()


def grid_coordinates(radius: float) -> tuple[FloatArray, FloatArray]:
    """Return node positions x and y [m] of a square height field, each of shape (rows, columns)."""
    line = np.linspace(-radius, radius, 2 * round(radius / NODE_SPACING) + 1)
    x, y = np.meshgrid(line, line)
    return x, y


def roughness(nodes: int, amplitude: float, random: np.random.Generator) -> FloatArray:
    """Return heights in [-amplitude, amplitude] [m], random at every second node, linear between; shape (nodes, nodes)."""
    coarse = random.uniform(-amplitude, amplitude, ((nodes + 1) // 2, (nodes + 1) // 2))
    tall = np.empty((nodes, coarse.shape[1]))
    tall[::2], tall[1::2] = coarse, (coarse[:-1] + coarse[1:]) / 2
    fine: FloatArray = np.empty((nodes, nodes))
    fine[:, ::2], fine[:, 1::2] = tall, (tall[:, :-1] + tall[:, 1:]) / 2
    return fine


def edge_taper(x: FloatArray, y: FloatArray, radius: float, width: float) -> FloatArray:
    """Return a factor that falls smoothly from 1 to 0 over the last ``width`` metres before ``radius``; same shape as ``x``."""
    inside = np.clip((radius - np.maximum(np.abs(x), np.abs(y))) / width, 0.0, 1.0)
    taper: FloatArray = inside * inside * (3.0 - 2.0 * inside)
    return taper


_QUARTER_TURNS = (0.0, math.pi / 2, math.pi, -math.pi / 2)


def _plate(top: tuple[float, ...], size: tuple[float, float], quaternion: Quaternion, turn: float) -> Box:
    """Return a box by the middle (before the turn about the world's z axis) and the size of its upper face."""
    w, x, y, z = quaternion
    normal = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    cosine, sine = math.cos(turn), math.sin(turn)
    turned = np.array([cosine * top[0] - sine * top[1], sine * top[0] + cosine * top[1], top[2]])
    center = turned - _THICKNESS / 2 * normal
    return Box(
        center=(float(center[0]), float(center[1]), float(center[2])),
        half_size=(size[0] / 2, size[1] / 2, _THICKNESS / 2),
        quaternion=quaternion,
    )


def _about_y(angle: float) -> Quaternion:
    return (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)


def _about_z(angle: float) -> Quaternion:
    return (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))


def _multiply(first: Quaternion, second: Quaternion) -> Quaternion:
    """Return the Hamilton product of quaternions wxyz: ``second`` in the frame that ``first`` turned."""
    w, x, y, z = first
    a, b, c, d = second
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
