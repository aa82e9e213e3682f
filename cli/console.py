"""Print to the terminal: text is never read as markup, and control characters never reach the terminal."""

from __future__ import annotations

import errno
import json
import logging
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import IO, Any

from rich.console import Console
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

_PLAIN_WIDTH = 160
"""Columns of a table without a terminal; 80 would be too narrow to read."""
_NOBODY_READS = (errno.EPIPE, errno.EIO)
"""Errors of writing to a pipe without a reader and to a closed terminal."""


class Terminal(Console):
    """Print names from untrusted files safely. Styles are given beside the text, as ``style`` or ``Text``.

    On a pipe without a reader or a closed terminal the text is lost and the command goes on.
    """

    def __init__(self, *, stderr: bool = False, quiet: bool = False, may_lose: bool = False) -> None:
        """Print to standard output, or to standard error.

        With ``may_lose``, and always on standard error, the command goes on with a full disk behind its output, too.
        """
        super().__init__(stderr=stderr, quiet=quiet, markup=False, emoji=False, highlight=False)
        self._may_lose = may_lose or stderr
        if not self.is_terminal:
            self.width = _PLAIN_WIDTH

    def print(self, *objects: Any, **options: Any) -> None:
        """Print after the held notices."""
        _notices.tell()
        super().print(*objects, **options)

    def _write_buffer(self) -> None:
        """Write what was printed, or lose it; rich would end the program where a pipe has no reader."""
        try:
            super()._write_buffer()
        except OSError as problem:
            if not (self._may_lose or problem.errno in _NOBODY_READS):
                raise
            self.quiet = True
            silence(self.file)

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        """Yield text for the terminal, control characters escaped."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return text as it is, control characters escaped."""
        return super().render_str(printable(text), **options)

    def say(self, sentence: str | Text) -> None:
        """Print a sentence that the terminal wraps, if anything does."""
        self.print(sentence, soft_wrap=True)


def print_json(data: Any) -> None:
    """Print JSON after the held notices; it is lost where nobody reads any more."""
    _notices.tell()
    try:
        print(json.dumps(data, indent=1), flush=True)
    except OSError as problem:
        if problem.errno not in _NOBODY_READS:
            raise
        silence(sys.stdout)


def printable(text: str) -> str:
    """Return a text with its control characters, line ends apart, escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def silence(stream: IO[str]) -> None:
    """Redirect a broken stream to the null device: its buffer would fail again when the program ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def complain(sentence: str) -> None:
    """Print one line on standard error, or lose it."""
    try:
        print(printable(sentence.replace("\n", " ")), file=sys.stderr)
    except OSError:
        silence(sys.stderr)


class _Notices(logging.Handler):
    """Hold the package's warnings back until a command prints."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.held: list[str] = []
        self._process = os.getpid()

    def emit(self, record: logging.LogRecord) -> None:
        """Hold a warning, or print it in a worker, which has no command."""
        self.held.append(record.getMessage())
        if os.getpid() != self._process:
            self.held = self.held[-1:]
            self.tell()

    def tell(self) -> None:
        """Print the held warnings."""
        held, self.held = self.held, []
        for message in held:
            complain(message)


_notices = _Notices()


@contextmanager
def held_notices() -> Iterator[None]:
    """Print a command's notices before its other output, and none where the only output is an error."""
    logger = logging.getLogger(__name__.partition(".")[0])
    logger.addHandler(_notices)
    try:
        yield
        _notices.tell()
    finally:
        _notices.held.clear()
        logger.removeHandler(_notices)


def make_table(title: str, *columns: str, numbers: bool = False) -> Table:
    """Return a table with its title at the left; with ``numbers`` all columns but the first are right-aligned."""
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, justify="right" if numbers and i else "left", overflow="fold")
    return table


def without_options(arguments: Sequence[str], *options: str) -> list[str]:
    """Return arguments without some options and the values of these, given as ``--option value`` or ``--option=value``."""
    words = list(arguments)
    for i in reversed([i for i, word in enumerate(words) if word.partition("=")[0] in options]):
        del words[i : i + 1 + (words[i] in options)]
    return words


def shell_command(arguments: Sequence[str] | None = None, *more: str) -> str:
    """Return a command for a shell: this one, without ``--resume``, or one of the arguments given."""
    own = [a for a in sys.argv[1:] if a != "--resume"] if arguments is None else arguments
    return shlex.join(["gaitgauge", *own, *more])
