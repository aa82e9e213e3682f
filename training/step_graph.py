"""Replaying a fixed sequence of torch kernels as one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

Result = TypeVar("Result")


class CapturedFunction(Generic[Result]):
    """A function without arguments whose kernels are captured once and replayed at every call.

    The function must read and write tensors that stay where they are, draw no random numbers, and never wait for the
    device. Every call returns the same tensors with new contents.
    """

    def __init__(self, function: Callable[[], Result], *, warm_up: int = 3) -> None:
        """Run the function ``warm_up`` times, then capture it. What it changes in place is changed by the warm-up,
        not by the capture.
        """
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(warm_up):
                function()
        torch.cuda.current_stream().wait_stream(side)
        torch.cuda.synchronize()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._result = function()

    def __call__(self) -> Result:
        """Replay on the current stream."""
        self._graph.replay()
        return self._result
