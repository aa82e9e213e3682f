"""Records parts of a control step, which are many small operations, once as CUDA graphs, and replays them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch

from ...backends.graphs import RecordedFunction

_MOST_RECORDINGS = 30
"""Recordings of one part after which it is not recorded again: recording does not pay where memory moves all the time."""

Result = TypeVar("Result")


class StepRecording:
    """Runs functions, and replays those that it has recorded.

    A function must read and write tensors that stay where they are, have static shapes, draw no random numbers and never wait for
    the device. Its arguments must be such tensors too, or results of functions recorded before it. A replayed function returns the
    tensors of its recording, with new contents. Where one function cannot be recorded, all of them run unrecorded, which costs
    time and changes nothing.
    """

    def __init__(self, device: torch.device | str, *, enabled: bool) -> None:
        """Prepare; functions run on ``device``, and none is recorded unless ``enabled``."""
        self._device = device
        self.enabled = enabled
        """True while functions are recorded, or will be."""
        self._functions: dict[str, RecordedFunction[Any]] = {}
        self._arguments: dict[str, tuple[Any, ...]] = {}
        self._memory: tuple[tuple[int, tuple[int, ...]], ...] = ()

    def prepare(self, memory: Sequence[torch.Tensor]) -> None:
        """Forget the recordings if any tensor of ``memory``, which functions use and somebody else owns, has moved since."""
        places = tuple((tensor.data_ptr(), tuple(tensor.shape)) for tensor in memory)
        if places != self._memory:
            self._memory = places
            for function in self._functions.values():
                function.forget()

    def run(self, function: Callable[..., Result], *arguments: Any) -> Result:
        """Run a function, or replay it; returns its result."""
        if not self.enabled:
            return function(*arguments)
        name = function.__name__
        self._arguments[name] = arguments
        if name not in self._functions:
            self._functions[name] = RecordedFunction(lambda: function(*self._arguments[name]), self._device)
        recorded: RecordedFunction[Result] = self._functions[name]
        reason = f"its memory moved {_MOST_RECORDINGS} times"
        if not recorded.due or recorded.recordings < _MOST_RECORDINGS:
            try:
                return recorded()
            except RuntimeError as error:
                if not recorded.due:  # it ran, and failed
                    raise
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        logging.getLogger(__name__).warning(
            "control steps are not recorded as CUDA graphs, which makes them slower: '%s' cannot be: %s", name, reason
        )
        self.enabled = False
        self._functions.clear()
        return function(*arguments)
