"""Turns the project's errors into one sentence on standard error and an exit code; a bug keeps its traceback."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any

import typer


class UserError(ValueError):
    """Something the command line itself found wrong."""


def report_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator of commands: errors that users can mend end with exit code 2, Ctrl-C with 130."""

    @functools.wraps(command)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            raise typer.Exit(130) from None
        except (ValueError, RuntimeError, OSError) as error:
            if not _is_ours(error):
                raise
            print(f"gaitgauge: {error}", file=sys.stderr)
            raise typer.Exit(2) from None

    return wrapper


def _is_ours(error: BaseException) -> bool:
    """Whether an error was raised on purpose, with a sentence for the user: its class is defined in this package."""
    package = __name__.partition(".")[0]
    return any(kind.__module__.startswith(f"{package}.") for kind in type(error).__mro__)
