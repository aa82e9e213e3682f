"""The terminal: names and sentences are printed as they are, never read as markup, and control characters never reach it."""

from __future__ import annotations

import logging
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

_PLAIN_WIDTH = 160
"""Columns of a table where there is no terminal to ask; squeezed into a pipe's 80 it could not be read."""


class Terminal(Console):
    """A console for names that strangers chose. Styles are given beside the text, as ``style`` or ``Text``."""

    def __init__(self, *, stderr: bool = False, quiet: bool = False) -> None:
        """Print to standard output, or to standard error."""
        super().__init__(stderr=stderr, quiet=quiet, markup=False, emoji=False, highlight=False)
        if not self.is_terminal:
            self.width = _PLAIN_WIDTH

    def print(self, *objects: Any, **options: Any) -> None:
        """Print, after the notices that were held back."""
        _notices.tell()
        super().print(*objects, **options)

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        """What reaches the terminal: text of any kind, control characters escaped."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text as it is, control characters escaped."""
        return super().render_str(printable(text), **options)

    def say(self, sentence: str | Text) -> None:
        """Print a sentence that the terminal wraps, if anything does."""
        self.print(sentence, soft_wrap=True)


def printable(text: str) -> str:
    """Text whose control characters, line ends apart, are escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


class _Notices(logging.Handler):
    """Keeps the package's warnings back until a command says something."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._held: list[str] = []
        self._process = os.getpid()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one, or print it where nobody would ask for it: in a worker."""
        self._held.append(record.getMessage())
        if os.getpid() != self._process:
            self._held = self._held[-1:]
            self.tell()

    def tell(self) -> None:
        """Print what was kept."""
        held, self._held = self._held, []
        for message in held:
            print(printable(message.replace("\n", " ")), file=sys.stderr)

    def forget(self) -> None:
        """Drop what was kept."""
        self._held = []


_notices = _Notices()


@contextmanager
def held_notices() -> Iterator[None]:
    """Around a command: its notices come before whatever else it says, and not at all where all that it says is an error."""
    logger = logging.getLogger(__name__.partition(".")[0])
    logger.addHandler(_notices)
    try:
        yield
        _notices.tell()
    finally:
        _notices.forget()
        logger.removeHandler(_notices)


def make_table(title: str, *columns: str, numbers: bool = False) -> Table:
    """A table with its title at the left; with ``numbers`` all columns but the first stand at the right."""
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, justify="right" if numbers and i else "left", overflow="fold")
    return table


def shell_command(arguments: Sequence[str] | None = None, *more: str) -> str:
    """A command that can be pasted into a shell: this one, without ``--resume``, or one of the arguments given."""
    own = [a for a in sys.argv[1:] if a != "--resume"] if arguments is None else arguments
    return shlex.join(["gaitgauge", *own, *more])
