"""The parts of a control step that are many small operations, recorded once as CUDA graphs and replayed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import torch

from ...backends.graphs import RecordedFunction

_MOST_RECORDINGS = 30
"""Recordings of one part after which it is not recorded again: memory that moves all the time is none to record."""


class StepRecording:
    """Runs functions without arguments, and replays those that it has recorded.

    A function must read and write tensors that stay where they are (what it returns to nobody else may be new), have static
    shapes, draw no random numbers and never wait for the device. Where one cannot be recorded all of them go on as they
    are, which costs time and changes nothing.
    """

    def __init__(self, device: torch.device | str, *, enabled: bool) -> None:
        """``device``: where the functions run; ``enabled``: whether to record at all."""
        self._device = device
        self.enabled = enabled
        """Whether functions are recorded, or will be."""
        self._functions: dict[str, RecordedFunction[None]] = {}
        self._memory: tuple[tuple[int, tuple[int, ...]], ...] = ()

    def prepare(self, memory: Sequence[torch.Tensor]) -> None:
        """Forget what was recorded if tensors that somebody else owns, and that functions use, have moved since."""
        places = tuple((tensor.data_ptr(), tuple(tensor.shape)) for tensor in memory)
        if places != self._memory:
            self._memory = places
            for function in self._functions.values():
                function.forget()

    def run(self, function: Callable[[], None]) -> None:
        """Run a function, or replay it."""
        if not self.enabled:
            function()
            return
        recorded = self._functions.setdefault(function.__name__, RecordedFunction(function, self._device))
        if recorded.due and recorded.recordings >= _MOST_RECORDINGS:
            self._give_up(function, f"its memory moved {_MOST_RECORDINGS} times")
            return
        try:
            recorded()
        except RuntimeError as error:
            if not recorded.due:  # it ran, and failed
                raise
            self._give_up(function, str(error).splitlines()[0] if str(error) else type(error).__name__)

    def _give_up(self, function: Callable[[], None], reason: str) -> None:
        """Run a function that cannot be recorded, and all from now on, as they are."""
        logging.getLogger(__name__).warning(
            "control steps are not recorded as CUDA graphs, which makes them slower: '%s' cannot be: %s",
            function.__name__,
            reason,
        )
        self.enabled = False
        self._functions.clear()
        function()
