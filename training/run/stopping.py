"""Report a training run's progress, and handle the signals that ask it to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

STOP_SIGNALS = tuple(known for known in signal.Signals if known.name in ("SIGTERM", "SIGINT", "SIGHUP"))
"""Signals that ask for an orderly stop; Windows has no SIGHUP."""


@dataclass(frozen=True, kw_only=True)
class TrainingOutcome:
    """Result of a call of ``learn``."""

    reason: str
    """``finished``, ``time`` (limit reached) or ``signal``."""
    iteration: int
    """Completed iterations of the whole run."""
    checkpoint: Path | None
    """Last checkpoint, None without a run directory."""
    exit_code: int
    """0, or 128 + the signal's number."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Figures for a progress display after every iteration."""

    iteration: int
    total_iterations: int
    elapsed: float
    """Wall-clock time of this call of ``learn`` [s]."""
    scalars: Mapping[str, float]
    """Logged scalars by key."""
    next_score: int | None
    """Iterations until the next checkpoint is gauged; None where none is."""
    best_score: float | None
    """Best score of the gauge so far."""
    best_iteration: int | None


class StopSignals:
    """While active, SIGTERM, SIGINT and SIGHUP ask for an orderly stop; a second SIGINT interrupts at once. Under ``nohup``, where SIGHUP
    is ignored, it stays so.
    """

    def __init__(self, message: Callable[[str], None], *, interrupts: bool = True) -> None:
        """Prepare; a ``message`` that cannot be printed is lost. A second SIGINT raises KeyboardInterrupt, or else sets ``insisted``."""
        self.received: int | None = None
        self.insisted = False
        self._message, self._interrupts = message, interrupts
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        # Python runs signal handlers in the main thread only and refuses to install them elsewhere.
        if threading.current_thread() is threading.main_thread():
            for number in STOP_SIGNALS:
                if number.name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None and number == signal.SIGINT:
            self.insisted = True
            if self._interrupts:
                raise KeyboardInterrupt
            return
        self.received = number
        # The terminal may be gone, or in the middle of another line.
        with suppress(OSError, RuntimeError):
            self._message(f"{signal.Signals(number).name} received: finishing this iteration and writing a checkpoint.")
