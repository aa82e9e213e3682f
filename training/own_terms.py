"""Terms of one's own: functions that settings name, so that a task adds rewards, terminations, observations and events
without touching the environment's loop.

A function is named ``module:function``; the module must be importable where the run is started and resumed. ``docs/``
has a worked example. Names that come out of a checkpoint, perhaps a stranger's, are imported only where they are trusted
(``foreign_functions``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from typing import Any, Protocol

from .configuration import ConfigurationError, to_plain

_PACKAGE = __name__.partition(".")[0]


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


def foreign_functions(settings: Any, known: Any) -> list[str]:
    """What settings would import: every ``module:function`` in them that is neither the package's own nor named in ``known``.

    Args:
        settings: frozen dataclasses, of any depth, or plain data.
        known: settings that are trusted.
    """
    trusted = set(_names(to_plain(known)))
    return sorted({name for name in _names(to_plain(settings)) if name not in trusted and not _own(name)})


def _names(value: Any) -> Iterator[str]:
    """All texts with a colon, so that a field that is added some day is not forgotten here."""
    if isinstance(value, dict | list | tuple):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from _names(entry)
    elif isinstance(value, str) and ":" in value:
        yield value


def _own(path: str) -> bool:
    """Whether a module of this package defines the function; what it imported from elsewhere is not its own."""
    module, _, name = path.partition(":")
    if not module.startswith(f"{_PACKAGE}.training."):
        return False
    try:
        found = getattr(import_module(module), name, None)
    except (ImportError, ValueError):
        return False
    return getattr(found, "__module__", None) == module
