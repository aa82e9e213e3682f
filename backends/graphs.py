"""A fixed sequence of torch operations, recorded once as a CUDA graph and replayed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Generic, TypeVar

import torch

WARM_UP = 3
"""Calls before a recording: modules that the device loads at first use must be there by then."""

Result = TypeVar("Result")


class RecordedFunction(Generic[Result]):
    """A function of tensors: its first calls run plainly, later calls replay a CUDA graph.

    The function must have static shapes, read and write only its arguments and tensors at fixed addresses, draw no random
    numbers and never wait for the device. No call runs twice. From the first replay on every call returns the same tensors
    with new contents.
    """

    def __init__(self, function: Callable[..., Result], device: torch.device | str, *, warm_up: int = WARM_UP) -> None:
        """Keep the function; nothing runs yet.

        Args:
            device: the GPU of the function; it need not be torch's current one.
            warm_up: calls that run plainly, on a stream of their own, as recording needs.
        """
        self._function = function
        self._device = torch.device(device)
        self._left = warm_up
        self._inputs: tuple[torch.Tensor, ...] = ()
        self._graph: torch.cuda.CUDAGraph | None = None
        self._result: Result
        self.recordings = 0
        """Number of recordings."""

    @property
    def due(self) -> bool:
        """Return whether the next call records."""
        return self._graph is None and self._left == 0

    def __call__(self, *arguments: torch.Tensor) -> Result:
        """Run the function with copies of these arguments, or record and replay it.

        Raises:
            RuntimeError: recording failed; the function has not run, and the next call tries again.
        """
        if self._graph is None:
            with torch.cuda.device(self._device) if self._device.type == "cuda" else nullcontext():
                if self._left > 0:
                    self._left -= 1
                    return self._run(arguments)
                self._graph = self._record(arguments)
        for static, argument in zip(self._inputs, arguments, strict=True):
            static.copy_(argument)
        self._graph.replay()
        return self._result

    def forget(self) -> None:
        """Record anew at the next call, for a function with moved tensors."""
        self._graph = None

    def _run(self, arguments: tuple[torch.Tensor, ...]) -> Result:
        if self._device.type != "cuda":
            return self._function(*arguments)
        current, aside = torch.cuda.current_stream(), torch.cuda.Stream()
        aside.wait_stream(current)
        with torch.cuda.stream(aside):
            result = self._function(*arguments)
        current.wait_stream(aside)
        return result

    def _record(self, arguments: tuple[torch.Tensor, ...]) -> torch.cuda.CUDAGraph:
        self._inputs = tuple(argument.clone() for argument in arguments)
        graph = torch.cuda.CUDAGraph()
        # torch's own recording stream belongs to the first GPU that recorded; other threads may use the device meanwhile
        stream = torch.cuda.Stream() if self._device.type == "cuda" else None
        with (
            _drawing_afterwards(self._device),
            torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"),
        ):
            self._result = self._function(*self._inputs)
        self.recordings += 1
        return graph


@contextmanager
def _drawing_afterwards(device: torch.device) -> Iterator[None]:
    """Restore the device's random generator after a failed recording, since torch leaves it in recording mode, unable to draw."""
    generators = [torch.cuda.default_generators[torch.cuda.current_device()]] if device.type == "cuda" else []
    before = [generator.clone_state() for generator in generators]
    try:
        yield
    except BaseException:
        for generator, state in zip(generators, before, strict=True):
            generator.graphsafe_set_state(state)
        raise
