"""Sudden lateral pushes during velocity goals: how hard, to which side and when."""

from __future__ import annotations

import random

import torch

from ...robots.rotation import from_heading
from ..suite import Push, Suite
from .segments import Segment


def push_force(push: Push, segment: Segment) -> float:
    """Return the force of a segment's push, to the left of the heading [N]: a draw that belongs to the segment alone."""
    draw = _draw("push", segment)
    side = draw.choice((-1.0, 1.0))
    return side * draw.uniform(*push.force)


def push_steps(suite: Suite, segment: Segment) -> tuple[int, int]:
    """Return the commanded control steps, counted from 1, from which and before which a segment's push acts: a draw of its own."""
    push, period = suite.push, suite.physics.control_period
    assert push is not None
    begin = round(_draw("time of push", segment).uniform(*push.after) / period) + 1
    return begin, begin + max(round(push.duration / period), 1)


def _draw(what: str, segment: Segment) -> random.Random:
    return random.Random(f"{what} {segment.episode.key} {segment.goal} {segment.sub_command}")


def sideways(quaternion: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
    """Return a horizontal force in world axes, (N, 3), from ``force`` to the left of the heading, (N,) [N]; wxyz ``quaternion`` (N, 4)."""
    return from_heading(quaternion, torch.zeros_like(force), force)
