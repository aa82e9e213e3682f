"""Estimate the memory of a world of the mujoco_warp engine."""

from __future__ import annotations

import mujoco
import mujoco_warp
import warp as wp

from ..upstream.height_fields.repair import SEARCH_THREADS, scratch_bytes
from .model import Capacity

_SCRATCH_FACTOR = 1.3
"""Memory with mujoco_warp's scratch arrays, in units of the engine's data, its own solver's included: an upper bound."""
_CONVEX_BYTES = 6600
"""Scratch memory of the convex solver for each contact of its capacity, with 35 iterations [bytes]."""
_OWN_BYTES = 8000
"""This engine's own buffers and model fields for every world [bytes]."""


def bytes_per_world(model: mujoco.MjModel, capacity: Capacity, worlds: int, processors: int = 132) -> float:
    """Return the memory of one world [bytes], measured on small copies, with an estimate of scratch memory.

    Args:
        capacity: buffer sizes for ``worlds`` worlds.
        processors: multiprocessors of the GPU; an H200's by default.
    """

    def size(count: int) -> int:
        with wp.ScopedDevice("cpu"):
            data = mujoco_warp.make_data(
                model,
                nworld=count,
                naconmax=count * (capacity.contacts // worlds + 1),
                naccdmax=count * (capacity.convex // worlds + 1),
                njmax=capacity.rows,
            )
        return sum(_array_bytes(part) for part in (data, data.contact, data.efc))

    data = (size(3) - size(1)) / 2
    convex, searches = float(capacity.convex), 0.0
    ground = model.geom_type[model.geom_bodyid == 0]
    if mujoco.mjtGeom.mjGEOM_HFIELD in ground:
        searches = min(processors * SEARCH_THREADS, capacity.convex) * scratch_bytes(model.opt.ccd_iterations)
        if mujoco.mjtGeom.mjGEOM_BOX not in ground:
            convex = 0.0  # height fields have a narrowphase of their own
    return _SCRATCH_FACTOR * data + (_CONVEX_BYTES * convex + searches) / worlds + _OWN_BYTES


def _array_bytes(part: object) -> int:
    """Return the memory of an object's own Warp arrays [bytes]."""
    return sum(v.capacity for v in vars(part).values() if isinstance(v, wp.array))
