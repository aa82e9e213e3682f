"""Terms of one's own: functions that settings name, so that a task adds rewards, terminations, observations and events without touching
the environment's loop.

A function is named ``module:function``; the module must be importable where the run is started and resumed. ``docs/`` has a worked
example. Names that come out of a checkpoint, perhaps a stranger's, are imported only where they are trusted (``foreign_functions``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from typing import Any, TypeVar

import torch

from ...files.parsing import one_line, shown
from ...files.plugins import imported, raised
from ...policy.observation_table import STANDARD, Observation, ObservationError, observation, register
from ..configuration import ConfigurationError, to_plain
from .configuration import ObservationConfiguration, OwnTerm

Kind = TypeVar("Kind")
_PACKAGE = __name__.partition(".")[0]
_MOVED = {
    f"{_PACKAGE}.training.{name}": f"{_PACKAGE}.training.environment.{name}" for name in ("commands", "curriculum")
}
"""Modules of this package that checkpoints of version 0.1 name by their former place."""


def _present(path: str) -> str:
    """Return ``module:name`` with the module's present place in this package."""
    module, colon, name = path.partition(":")
    return f"{_MOVED.get(module, module)}{colon}{name}"


def resolve(path: str, setting: str) -> Callable[..., Any]:
    """Return the function or class at ``module:name``; calling a user's turns its exceptions into one sentence.

    Raises:
        ConfigurationError: there is no such module or function, or importing it fails.
    """
    path = _present(path)
    found = _found(path, setting)
    return found if _own(path) else guarded(found, f"{setting} is {shown(path)}")


def _found(path: str, setting: str) -> Callable[..., Any]:
    where = f"{setting} is {shown(path)}"
    module, colon, name = path.partition(":")
    if not colon or not module or not name:
        raise ConfigurationError(f"{where}; write module:function, for example my_robot.rewards:airtime")
    found = imported(path, f"{where}, but", ConfigurationError)
    if not callable(found):
        raise ConfigurationError(f"{where}, but module {shown(module)} has no function {shown(name)}")
    return found  # type: ignore[no-any-return]


def find_class(path: str, setting: str, base: type[Kind]) -> type[Kind]:
    """Return the class at ``module:name`` itself.

    Raises:
        ConfigurationError: there is no such module or class, or it is not derived from ``base``.
    """
    found = _found(_present(path), setting)
    if not isinstance(found, type) or not issubclass(found, base):
        raise ConfigurationError(
            f"{setting} is {shown(path)}; it must be a class derived from {base.__module__}:{base.__name__}"
        )
    return found


def resolve_class(path: str, setting: str, base: type[Kind], *methods: str) -> Callable[..., Kind]:
    """Return the class at ``module:name``, derived from ``base``; calling ``methods`` of a user's turns their exceptions into one sentence.
    Raises ConfigurationError as ``find_class``.
    """
    found, where = find_class(path, setting, base), f"{setting} is {shown(_present(path))}"
    if _own(path):
        return found

    def make(*arguments: Any, **named: Any) -> Kind:
        made = guarded(found, where)(*arguments, **named)
        for method in methods:
            setattr(made, method, guarded(getattr(made, method), where))
        return made

    return make


def resolve_own(
    terms: Iterable[OwnTerm],
    setting: str,
    taken: Iterable[str] = (),
    *,
    gives: Callable[[Any, Any], bool] | None = None,
    rule: str = "",
) -> dict[str, Callable[..., Any]]:
    """Return the functions of all terms by name. ``gives`` checks a result, from a function's first argument and the result, and ``rule``
    is the check in words. Raises ConfigurationError: a name is used twice or in ``taken``, or a function is not there.
    """
    functions: dict[str, Callable[..., Any]] = {}
    for term in terms:
        if term.name in functions or term.name in taken:
            raise ConfigurationError(f"{setting} has {shown(term.name)}, a name that is taken; choose another")
        where = f"{setting}.{one_line(term.name, 80)}.function"
        functions[term.name] = _checked(
            resolve(term.function, where), f"{where} is {shown(term.function)}", gives, rule
        )
    return functions


def policy_observations(settings: ObservationConfiguration) -> list[Observation]:
    """Return the policy's observations behind the standard ones; those of ``module:name`` become known in this process.

    Raises:
        ConfigurationError: an observation is not there, is named twice, or breaks a rule.
    """
    found: list[Observation] = []
    for path in settings.policy:
        where = f"environment.observations.policy has {shown(path)}"
        try:
            made = imported(path, f"{where}, but", ConfigurationError) if ":" in path else observation(path)
            if not isinstance(made, Observation):
                raise ConfigurationError(
                    f"{where}; it must be a gaitgauge.policy.observation_table.Observation, not {shown(made)}"
                )
            found.append(register(made) if ":" in path else made)
        except ObservationError as error:
            raise ConfigurationError(f"{where}: {error}") from error
        if made.name in STANDARD or any(made.name == other.name for other in found[:-1]):
            raise ConfigurationError(f"{where}, and the policy has '{made.name}' already; name it once")
    return found


def _checked(
    function: Callable[..., Any], where: str, gives: Callable[[Any, Any], bool] | None, rule: str
) -> Callable[..., Any]:
    """Return a function that checks its results."""
    if gives is None:
        return function

    def checked(first: Any, *others: Any) -> Any:
        found = function(first, *others)
        if not isinstance(found, torch.Tensor):
            raise ConfigurationError(f"{where}, which gave {shown(found)}; {rule}")
        if not gives(first, found):
            raise ConfigurationError(f"{where}, which gave a tensor of {tuple(found.shape)}, {found.dtype}; {rule}")
        return found

    return checked


def guarded(
    call: Callable[..., Any], where: str, passed_on: tuple[type[BaseException], ...] = ()
) -> Callable[..., Any]:
    """Return a user's function with its exceptions, but not those of ``passed_on``, and its attempts to end the program turned into one
    sentence that begins with ``where``.
    """
    kept: tuple[type[BaseException], ...] = (ConfigurationError, *passed_on)

    def called(*arguments: Any, **named: Any) -> Any:
        try:
            return call(*arguments, **named)
        except kept:
            raise
        except (Exception, SystemExit) as error:
            raise ConfigurationError(f"{where}, which {raised(error)}; mend it") from error

    return called


def foreign_functions(settings: Any, known: Any) -> list[str]:
    """Return every ``module:function`` that settings, dataclasses or plain data, would import and that is neither the package's own nor
    named in ``known`` settings.
    """
    trusted = set(_names(to_plain(known)))
    return sorted({name for name in _names(to_plain(settings)) if name not in trusted and not _own(name)})


def _names(value: Any) -> Iterator[str]:
    """Return all texts with a colon, so that a field that is added some day is not forgotten here."""
    if isinstance(value, dict | list | tuple):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from _names(entry)
    elif isinstance(value, str) and ":" in value:
        yield value


def _own(path: str) -> bool:
    """Return True if a module of this package defines the function; functions that it imported from elsewhere are not its own."""
    module, _, name = _present(path).partition(":")
    if not module.startswith(f"{_PACKAGE}.training."):
        return False
    try:
        found = getattr(import_module(module), name, None)
    except (ImportError, ValueError, TypeError):
        return False
    return getattr(found, "__module__", None) == module
