"""Direct Warp's launches to a device, and explain a lack of memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
import warp as wp


class DeviceScope:
    """Runs Warp's launches on a torch device, in order with torch's own work there."""

    def __init__(self, device: torch.device) -> None:
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # else Warp prints a line for each kernel
        wp.init()
        self.on_gpu = device.type == "cuda"
        self.warp_device = wp.device_from_torch(device)
        self._device = device
        self._streams: dict[int, wp.Stream] = {}

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Direct arrays and launches inside the context to the device and to torch's current stream."""
        if not self.on_gpu:
            with wp.ScopedDevice(self.warp_device):
                yield
            return
        with wp.ScopedStream(self.stream()), wp.ScopedDevice(self.warp_device):
            yield

    def stream(self) -> wp.Stream:
        """Return torch's current stream as a Warp stream."""
        stream = torch.cuda.current_stream(self._device)
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
        return self._streams[stream.cuda_stream]

    def record(self, launches: Callable[[], None]) -> wp.Graph:
        """Record launches as a CUDA graph without running them. Their kernels must have run before."""
        torch.cuda.synchronize(self._device)
        # torch's default stream cannot be recorded
        with wp.ScopedStream(wp.Stream(self.warp_device)), wp.ScopedCapture(force_module_load=False) as capture:
            launches()
        return capture.graph

    def replay(self, graph: wp.Graph) -> None:
        """Launch a recorded graph in torch's current stream."""
        wp.capture_launch(graph, stream=self.stream())

    def free_bytes(self) -> int:
        """Return the free memory of a GPU [bytes]; 0 on the CPU."""
        if not self.on_gpu:
            return 0
        torch.cuda.empty_cache()
        return int(torch.cuda.mem_get_info(self._device)[0])


def is_memory_error(error: BaseException) -> bool:
    """Return whether torch or Warp ran out of memory."""
    text = str(error).lower()
    return isinstance(error, torch.cuda.OutOfMemoryError) or "failed to allocate" in text or "out of memory" in text


def memory_advice(worlds: int, device: torch.device, free: int, per_world: float) -> str:
    """Return the sentence for a lack of memory, with the largest number of worlds that would fit."""
    return (
        f"{worlds} worlds do not fit into the memory of {device}: about {int(free / per_world)} would "
        f"({per_world / 1e3:.0f} kB each, {free / 1e9:.1f} GB free); use fewer worlds, or fewer contacts "
        "(PhysicsOptions.contacts_per_world)"
    )
