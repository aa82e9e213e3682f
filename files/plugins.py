"""Installed plug-ins: somebody else's code, which may do anything when it is loaded, and must then break nothing but itself."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar

from .parsing import one_line, shown

Kind = TypeVar("Kind")


def plugins(group: str) -> dict[str, EntryPoint]:
    """Installed entry points of a group by name."""
    return {entry.name: entry for entry in entry_points(group=group)}


def load_plugin(entry: EntryPoint, error: type[Exception]) -> Any:
    """What an entry point refers to.

    Raises:
        error: it cannot be loaded; the sentence names it.
    """
    return guarded(entry, error, entry.load)


def guarded(entry: EntryPoint, error: type[Exception], call: Callable[..., Kind], *arguments: Any) -> Kind:
    """Call a plug-in's code. Whatever it raises, and its wish to end the program, becomes one sentence.

    Raises:
        error: anything went wrong; the sentence names the entry point.
    """
    try:
        return call(*arguments)
    except error:
        raise
    except (Exception, SystemExit) as problem:
        reason = f"{type(problem).__name__}: {one_line(problem)}".rstrip(": ")
        raise error(f"{origin(entry)} failed: {reason}; mend or uninstall it") from problem


def raised(error: BaseException) -> str:
    """What went wrong in somebody's code, and where: ``raised KeyError: 'x' (rewards.py, line 12)``."""
    frames = [f for f in traceback.extract_tb(error.__traceback__)[1:] if not f.filename.startswith("<frozen")]
    place = f" ({one_line(Path(frames[-1].filename).name, 80)}, line {frames[-1].lineno})" if frames else ""
    return f"raised {type(error).__name__}: {one_line(error, 200)}".rstrip(": ") + place


def imported(path: str, where: str, error: type[Exception]) -> Any:
    """What stands at ``module:name``, None where the module has no such name.

    Raises:
        error: importing it fails; ``where`` is the beginning of the sentence.
    """
    module, _, name = path.partition(":")
    try:
        found: Any = import_module(module)
        for part in name.split("."):
            found = getattr(found, part, None)
    except ImportError as problem:
        raise error(f"{where} {one_line(problem)}; is its folder on PYTHONPATH?") from problem
    except (Exception, SystemExit) as problem:
        raise error(f"{where} importing it {raised(problem)}; mend that module") from problem
    return found


def origin(entry: EntryPoint) -> str:
    """How a sentence names a plug-in."""
    package = f" of {entry.dist.name}" if entry.dist else ""
    return f"plug-in {shown(entry.name)} ({one_line(entry.value, 80)}{package})"
