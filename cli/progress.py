"""Show progress: a block with a bar on a terminal, a plain line now and then elsewhere. Neither is ever silent for ten seconds."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

from rich.console import Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from .console import Terminal, printable
from .remembered import Remembered, folder_of_times

_LOG_EVERY = 8.0
"""Time between two lines where there is no terminal [s]."""
_TICK = 0.5
"""Time after which it is looked whether a line is due [s]."""
_COLUMNS = 4
"""Details side by side."""
_LEAST = 1.0
"""Time that is shown where the estimate has run out [s]."""
_CLOSING = 0.3
"""Time of the page and the tables over that of the start: both load packages and read files."""


class ProgressDisplay:
    """Show the progress of a ``with`` block; between two updates the remaining time counts down."""

    _first: ClassVar[ProgressDisplay | None] = None
    """The display of a command that has not begun its work; the one of the work takes its place and its clock."""

    def __init__(
        self, console: Terminal, title: str, *, clock: Callable[[], float] = time.monotonic, began: float | None = None
    ) -> None:
        """Prepare the display; ``clock`` gives the time [s], ``began`` is its value where the shown time is 0, None for now."""
        self._console, self._title, self._clock = console, title, clock
        self._told = self._updated = clock()
        self._began = self._told if began is None else began
        self._share, self._text = 0.0, "starting"
        self._left: float | None = None
        self.start = 0.0
        """Time of a start that loads Python and the packages once more [s]; none before the work has begun."""
        self.closing = 0.0
        """Time that follows the work of which ``update`` tells the rest [s]."""
        self._memory = Remembered((), None)
        self._details: Mapping[str, str] = {}
        self._live: Live | None = None
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._lines = threading.Thread(target=self._tell_now_and_then, daemon=True)

    def __enter__(self) -> ProgressDisplay:
        first, ProgressDisplay._first = self._first, None
        if first is not None:
            self._began, self._told, self._memory = first._began, first._told, first._memory
            self.start = _starting_again(self._clock() - self._began)
            self.closing = _CLOSING * self.start
            first.close()
            self._expect(0.0, None)
        self._open()
        return self

    def __exit__(self, *details: Any) -> None:
        self.close()

    def _open(self, *, transient: bool = False) -> None:
        if self._console.is_terminal:
            self._live = Live(
                console=self._console,
                refresh_per_second=4,
                get_renderable=self._block,
                redirect_stdout=not transient,
                transient=transient,
            )
            self._live.start()
        else:
            self._lines.start()

    def close(self) -> None:
        """End the display; once is enough."""
        self._stop.set()
        if self._live is not None:
            self._live.stop()
        elif self._lines.is_alive():
            self._lines.join()

    @classmethod
    @contextmanager
    def of_start(cls, console: Terminal, title: str, *, clock: Callable[[], float] = time.monotonic) -> Iterator[None]:
        """Show that a command reads files and imports packages, until it shows its own progress.

        What the command's time was is remembered at its end, unless an error ended it.
        """
        ProgressDisplay._first = first = cls(console, title, clock=clock)
        first._memory = memory = Remembered(sys.argv[1:], folder_of_times())
        first._expect(0.0, None)
        first._open(transient=True)
        try:
            yield
            memory.keep(clock() - first._began)
        finally:
            ProgressDisplay._first = None
            first.close()

    def update(
        self,
        share: float,
        text: str,
        details: Mapping[str, str] | None = None,
        *,
        left: float | None = None,
        last: bool = False,
    ) -> None:
        """Say how far the work is.

        Args:
            share: of the work that is done, 0 to 1.
            left: estimated time until the work ends, ``closing`` not included [s]; None where there is no estimate.
            last: print a line in any case where there is no terminal.
        """
        with self._lock:
            self._text, self._details = text, details or {}
            self._expect(share, None if left is None else left + self.closing)
        if self._live is None:
            self._tell(last=last)

    def _expect(self, share: float, estimate: float | None) -> None:
        """Take the share that is done, and the estimated rest with all that follows [s]."""
        self._share, self._updated = share, self._clock()
        self._left = self._memory.left(self._updated - self._began, share, estimate)

    def _tell(self, *, last: bool = False) -> None:
        """Print a line, if the last one was long enough ago, or if it is the ``last`` one."""
        with self._lock:
            now = self._clock()
            if now - self._told < _LOG_EVERY and not last:
                return
            self._told = now
            more = "".join(f", {name} {printable(value)}" for name, value in self._details.items())
            line = f"{duration(now - self._began)}: {self._title}, {self._words(now)}{more}"
        self._console.say(line)

    def _tell_now_and_then(self) -> None:
        while not self._stop.wait(_TICK):
            self._tell()

    def _words(self, now: float) -> str:
        """Return the text with the remaining time."""
        if self._left is None:
            return self._text
        return f"{self._text}, about {duration(max(self._left_at(now), _LEAST))} left"

    def _left_at(self, now: float) -> float:
        return 0.0 if self._left is None else self._left - (now - self._updated)

    def _block(self) -> RenderableType:
        with self._lock:
            grid = Table.grid(padding=(0, 2))
            cells = [Text.assemble((f"{name} ", "dim"), printable(value)) for name, value in self._details.items()]
            for i in range(0, len(cells), _COLUMNS):
                grid.add_row(*cells[i : i + _COLUMNS])
            now = self._clock()
            words = f"  {duration(now - self._began)}: {printable(self._words(now))}"
            head = Text.assemble((printable(self._title), "bold"), words)
            return Group(head, ProgressBar(total=1.0, completed=self._share, width=60), grid)


def _starting_again(taken: float) -> float:
    """Return how long another start takes: its files have been read, and the machine is as busy as now; ``taken``: the first [s]."""
    load = os.getloadavg()[0] / (os.cpu_count() or 1) if hasattr(os, "getloadavg") else 1.0
    return min(taken, time.process_time() * max(load, 1.0))


def duration(seconds: float) -> str:
    """Return a time for people: ``1 h 05 min``, ``2 min 07 s``, ``30 s``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
