"""The parts of a control step that are many small operations, recorded once as CUDA graphs and replayed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import torch

_WARM_UP = 3
"""Calls of a part before it is recorded: what the device loads at first use must not be loaded while recording."""
_MOST_RECORDINGS = 30
"""Recordings of one part after which it is not recorded again: memory that moves all the time is none to record."""


class StepRecording:
    """Runs functions without arguments, and replays those that it has recorded.

    A function must read and write tensors that stay where they are (what it returns to nobody else may be new), have static
    shapes, draw no random numbers and never wait for the device. Where one cannot be recorded all of them go on as they
    are, which costs time and changes nothing.
    """

    def __init__(self, *, enabled: bool) -> None:
        """``enabled``: whether to record at all."""
        self.enabled = enabled
        """Whether functions are recorded, or will be."""
        self._calls: dict[str, int] = {}
        self._recordings: dict[str, int] = {}
        self._graphs: dict[str, torch.cuda.CUDAGraph] = {}
        self._memory: tuple[tuple[int, tuple[int, ...]], ...] = ()

    def prepare(self, memory: Sequence[torch.Tensor]) -> None:
        """Forget what was recorded if tensors that somebody else owns, and that functions use, have moved since."""
        places = tuple((tensor.data_ptr(), tuple(tensor.shape)) for tensor in memory)
        if places != self._memory:
            self._memory = places
            self._graphs.clear()

    def run(self, function: Callable[[], None]) -> None:
        """Run a function, or replay it."""
        if not self.enabled:
            function()
            return
        name = function.__name__
        calls = self._calls[name] = self._calls.get(name, 0) + 1
        if calls <= _WARM_UP:
            function()
            return
        if name not in self._graphs and not self._record(name, function):
            function()
            return
        self._graphs[name].replay()

    def _record(self, name: str, function: Callable[[], None]) -> bool:
        """Record a function, which does not run meanwhile; returns whether that was possible."""
        recordings = self._recordings[name] = self._recordings.get(name, 0) + 1
        reason = f"its memory moved {_MOST_RECORDINGS} times" if recordings > _MOST_RECORDINGS else ""
        if not reason:
            try:
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph):
                    function()
            except RuntimeError as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            else:
                self._graphs[name] = graph
                return True
        logging.getLogger(__name__).warning(
            "control steps are not recorded as CUDA graphs, which makes them slower: '%s' cannot be: %s", name, reason
        )
        self.enabled = False
        self._graphs.clear()
        return False
