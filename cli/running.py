"""Commands without a body: their options are the arguments of a function of ``cli/``, which is imported only when it is needed."""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib import import_module
from typing import Any, get_args, get_origin, get_type_hints

from .errors import report_errors

Command = Callable[..., None]


def runs(target: str) -> Callable[[Command], Command]:
    """Decorator of a command that is its options and its help, and does what a function does.

    Args:
        target: ``module:function`` of ``cli/``. It gets every option by the name of its parameter; one that may be repeated as a
            tuple, empty where it is not given.
    """
    module, _, name = target.partition(":")

    def decorate(command: Command) -> Command:
        def run(**options: Any) -> None:
            for option, kind in get_type_hints(command).items():
                if any(get_origin(part) is list for part in (kind, *get_args(kind))):
                    options[option] = tuple(options[option] or ())
            getattr(import_module(f".{module}", __package__), name)(**options)

        return functools.wraps(command)(report_errors(run))

    return decorate
