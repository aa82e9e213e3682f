"""Show progress: a block with a bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from .console import Terminal, printable

_REFRESH = 0.25
"""Shortest time between two updates of the block [s]."""
_LOG_EVERY = 10.0
"""Time between two lines where there is no terminal [s]."""
_COLUMNS = 4
"""Details side by side."""


class ProgressDisplay:
    """Show the progress of a ``with`` block; nothing is shown before the first ``update``."""

    def __init__(self, console: Terminal, title: str) -> None:
        self._console = console
        self._title = title
        self._began = self._last = time.monotonic()
        self._live: Live | None = None

    def __enter__(self) -> ProgressDisplay:
        if self._console.is_terminal:
            self._last = float("-inf")
            self._live = Live(console=self._console, refresh_per_second=4)
            self._live.__enter__()
        return self

    def __exit__(self, *details: Any) -> None:
        if self._live is not None:
            self._live.__exit__(*details)

    def update(self, share: float, text: str, details: Mapping[str, str] | None = None, *, last: bool = False) -> None:
        """Show the progress, if the last update was long enough ago.

        Args:
            share: of the work that is done, 0 to 1.
            last: show it in any case.
        """
        now = time.monotonic()
        if now - self._last < (_REFRESH if self._live else _LOG_EVERY) and not last:
            return
        self._last = now
        values = {name: printable(value) for name, value in (details or {}).items()}
        if self._live is None:
            more = "".join(f", {name} {value}" for name, value in values.items())
            self._console.say(f"{duration(now - self._began)}: {self._title}, {text}{more}")
            return
        grid = Table.grid(padding=(0, 2))
        cells = [Text.assemble((f"{name} ", "dim"), value) for name, value in values.items()]
        for i in range(0, len(cells), _COLUMNS):
            grid.add_row(*cells[i : i + _COLUMNS])
        head = Text.assemble((printable(self._title), "bold"), f"  {printable(text)}")
        self._live.update(Group(head, ProgressBar(total=1.0, completed=share, width=60), grid))


def duration(seconds: float) -> str:
    """Return a time for people: ``1 h 05 min``, ``2 min 07 s``, ``30 s``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
