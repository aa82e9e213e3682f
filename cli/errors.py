"""Turn the project's errors into one sentence on standard error and an exit code; a bug keeps its traceback."""

from __future__ import annotations

import errno
import functools
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer

from .console import complain, held_notices, silence

_OF_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EPIPE, errno.EIO)
"""Errors of writing to standard output; a failed start of a process has no file name either."""


_LEAST_MEMORY = 1_200_000_000
"""Address space that torch, MuJoCo and one policy take [bytes]; with less, libraries crash or wait for ever."""
_MORE_MEMORY = "raise the limit (ulimit -v), ask for fewer threads, or use a machine with more"


class UserError(ValueError):
    """Report an error that the command line itself found."""


def report_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a command: errors that users can mend end with exit code 2, Ctrl-C with 130."""

    @functools.wraps(command)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        check_memory()
        try:
            with held_notices():
                result = command(*args, **kwargs)
            sys.stdout.flush()  # a full disk shows here at the latest
            return result
        except KeyboardInterrupt:
            complain("stopped")
            raise typer.Exit(130) from None
        except (ValueError, RuntimeError, OSError, MemoryError, ImportError) as error:
            if _is_ours(error):
                complain(f"gaitgauge: {error}")
            elif isinstance(error, MemoryError) or "allocate memory" in str(error).lower():
                complain(f"gaitgauge: memory is exhausted; {_MORE_MEMORY}")
            elif isinstance(error, OSError):
                complain(f"gaitgauge: {system_failure(error)}")
            else:
                raise
            raise typer.Exit(2) from None

    return wrapper


@contextmanager
def output_failures() -> Iterator[None]:
    """End with exit code 2 on output errors outside the commands, such as help or version on a full disk."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except OSError as error:
        complain(f"gaitgauge: {system_failure(error)}")
        sys.exit(2)


def check_memory() -> None:
    """End with exit code 2 where this process may take less memory than its libraries alone need."""
    try:
        import resource
    except ImportError:  # Windows
        return
    allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
    if allowed != resource.RLIM_INFINITY and allowed < _LEAST_MEMORY:
        complain(
            f"gaitgauge: a process may take {allowed / 1e9:.2f} GB of address space here, and at least {_LEAST_MEMORY / 1e9:g} GB "
            f"are needed; {_MORE_MEMORY}"
        )
        sys.exit(2)


def check_folder() -> None:
    """End where the current folder was removed: libraries raise misleading errors there."""
    try:
        os.getcwd()
    except OSError:
        complain("gaitgauge: the current folder does not exist any more; change to another one")
        sys.exit(2)


def system_failure(error: OSError) -> str:
    """Return one sentence on an error of the operating system. A write error without a file name is one of standard output."""
    reason = (error.strerror or str(error)).lower()
    if error.filename is not None:
        return f"'{os.fsdecode(error.filename)}': {reason}"
    if error.errno not in _OF_WRITING:
        return f"the system refused: {reason}"
    silence(sys.stdout)
    return f"output cannot be written: {reason}"


def _is_ours(error: BaseException) -> bool:
    """Return whether an error was raised on purpose, with a sentence for the user: its class is defined in this package."""
    package = __name__.partition(".")[0]
    return any(kind.__module__.startswith(f"{package}.") for kind in type(error).__mro__)
