"""Terms of one's own: functions that settings name, so that a task adds rewards, terminations, observations and events
without touching the environment's loop.

A function is named ``module:function``; the module must be importable where the run is started and resumed. ``docs/``
has a worked example.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any, Protocol

from .configuration import ConfigurationError


class _Named(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def function(self) -> str: ...


def resolve(path: str, setting: str) -> Callable[..., Any]:
    """The function or class at ``module:name``.

    Args:
        path: what a setting holds.
        setting: the setting's name, for messages.

    Raises:
        ConfigurationError: there is no such module or function.
    """
    module, colon, name = path.partition(":")
    if not colon or not module or not name:
        raise ConfigurationError(f"{setting} is '{path}'; write module:function, for example my_robot.rewards:airtime")
    try:
        found: Any = import_module(module)
    except ImportError as error:
        raise ConfigurationError(f"{setting} is '{path}', but {error}; is its folder on PYTHONPATH?") from error
    for part in name.split("."):
        found = getattr(found, part, None)
    if not callable(found):
        raise ConfigurationError(f"{setting} is '{path}', but module '{module}' has no function '{name}'")
    result: Callable[..., Any] = found
    return result


def resolve_own(terms: Iterable[_Named], setting: str, taken: Iterable[str] = ()) -> dict[str, Callable[..., Any]]:
    """The functions of all terms by name.

    Raises:
        ConfigurationError: a name is used twice, or a function is not there.
    """
    functions: dict[str, Callable[..., Any]] = {}
    for term in terms:
        if term.name in functions or term.name in taken:
            raise ConfigurationError(f"{setting} has '{term.name}', a name that is taken; choose another")
        functions[term.name] = resolve(term.function, f"{setting}.{term.name}.function")
    return functions
