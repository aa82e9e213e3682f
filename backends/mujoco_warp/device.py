"""Devices of the mujoco_warp engine: which one, in which stream, and how many worlds fit into its memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import mujoco_warp
import torch
import warp as wp

from .height_fields.repair import SEARCH_THREADS, scratch_bytes
from .model import Capacity

_SCRATCH_FACTOR = 1.3
"""Memory with the solver's scratch arrays, in units of the engine's data."""
_CONVEX_BYTES = 6600
"""Scratch memory of the convex solver for each contact that it has room for, with 35 iterations [bytes]."""
_OWN_BYTES = 8000
"""This engine's own buffers, and the model fields that every world has for itself [bytes]."""


class DeviceScope:
    """Runs Warp's launches on a torch device, in order with torch's own work there."""

    def __init__(self, device: torch.device) -> None:
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # one line for each of its kernels otherwise
        wp.init()
        self.on_gpu = device.type == "cuda"
        self.warp_device = wp.device_from_torch(device)
        self._device = device
        self._streams: dict[int, wp.Stream] = {}

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Inside, arrays and launches go to the device and to torch's current stream."""
        if not self.on_gpu:
            with wp.ScopedDevice(self.warp_device):
                yield
            return
        with wp.ScopedStream(self.stream()), wp.ScopedDevice(self.warp_device):
            yield

    def stream(self) -> wp.Stream:
        """Torch's current stream as Warp's."""
        stream = torch.cuda.current_stream(self._device)
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
        return self._streams[stream.cuda_stream]

    def free_bytes(self) -> int:
        """Free memory of the device [bytes]; 0 on the CPU, where nobody asks."""
        if not self.on_gpu:
            return 0
        torch.cuda.empty_cache()
        return int(torch.cuda.mem_get_info(self._device)[0])


def is_memory_error(error: BaseException) -> bool:
    """Whether torch or Warp ran out of memory."""
    text = str(error).lower()
    return isinstance(error, torch.cuda.OutOfMemoryError) or "failed to allocate" in text or "out of memory" in text


def bytes_per_world(model: mujoco.MjModel, capacity: Capacity, worlds: int, processors: int = 132) -> float:
    """Memory that one world needs [bytes], scratch memory included as an estimate; measured on small copies.

    Args:
        model: the model that all worlds share.
        capacity: buffer sizes for ``worlds`` worlds.
        worlds: number of worlds that the capacity is for.
        processors: multiprocessors of the GPU; an H200's if nothing is said.
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


def memory_advice(worlds: int, device: torch.device, free: int, per_world: float) -> str:
    """The sentence for a device that is too small, with the largest number of worlds that would fit."""
    return (
        f"{worlds} worlds do not fit into the memory of {device}: about {int(free / per_world)} would "
        f"({per_world / 1e3:.0f} kB each, {free / 1e9:.1f} GB free); use fewer worlds, or fewer contacts "
        "(PhysicsOptions.contacts_per_world)"
    )


def _array_bytes(part: object) -> int:
    """Memory of the Warp arrays that an object holds directly [bytes]."""
    return sum(v.capacity for v in vars(part).values() if isinstance(v, wp.array))
