"""Replaying a training step as one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable

import torch

WARM_UP_CALLS = 3


class GraphedStep:
    """A function of index tensors that trains in place, captured once and then replayed.

    The function must have static shapes, read and write only memory that stays where it is, draw no random numbers
    and never wait for the device. Its first calls run eagerly on a side stream, as capturing needs; they are real
    training steps, nothing is run twice.
    """

    def __init__(self, step: Callable[..., None]) -> None:
        """Wrap ``step``; the first call decides the shapes of its arguments."""
        self._step = step
        self._calls = 0
        self._inputs: tuple[torch.Tensor, ...] = ()
        self._graph: torch.cuda.CUDAGraph | None = None
        self._stream: torch.cuda.Stream | None = None

    def __call__(self, *arguments: torch.Tensor) -> None:
        """Run the step with these arguments."""
        if self._graph is None and self._calls < WARM_UP_CALLS:
            self._warm_up(arguments)
            return
        for static, argument in zip(self._inputs, arguments, strict=True):
            static.copy_(argument)
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            # Other threads may talk to the device meanwhile: that of the processes' messages does.
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._step(*self._inputs)
        self._graph.replay()

    def _warm_up(self, arguments: tuple[torch.Tensor, ...]) -> None:
        if self._stream is None:
            self._stream = torch.cuda.Stream()
            self._inputs = tuple(argument.clone() for argument in arguments)
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            self._step(*arguments)
        torch.cuda.current_stream().wait_stream(self._stream)
        self._calls += 1
