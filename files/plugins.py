"""Load installed plug-ins: foreign code that may fail in any way and must then break nothing but itself."""

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
    """Return the installed entry points of a group by name."""
    return {entry.name: entry for entry in entry_points(group=group)}


def load_plugin(entry: EntryPoint, error: type[Exception]) -> Any:
    """Load the object of an entry point; raise ``error`` with the entry point's name where that fails."""
    return guarded(entry, error, entry.load)


def guarded(entry: EntryPoint, error: type[Exception], call: Callable[..., Kind], *arguments: Any) -> Kind:
    """Call a plug-in's code; raise ``error`` with one sentence that names the entry point for any error and ``SystemExit``."""
    try:
        return call(*arguments)
    except error:
        raise
    except (Exception, SystemExit) as problem:
        reason = f"{type(problem).__name__}: {one_line(problem)}".rstrip(": ")
        raise error(f"{origin(entry)} failed: {reason}; mend or uninstall it") from problem


def raised(error: BaseException) -> str:
    """Describe an error of foreign code and its place: ``raised KeyError: 'x' (rewards.py, line 12)``."""
    frames = [f for f in traceback.extract_tb(error.__traceback__)[1:] if not f.filename.startswith("<frozen")]
    place = f" ({one_line(Path(frames[-1].filename).name, 80)}, line {frames[-1].lineno})" if frames else ""
    return f"raised {type(error).__name__}: {one_line(error, 200)}".rstrip(": ") + place


def imported(path: str, where: str, error: type[Exception]) -> Any:
    """Import ``module:name``, None where the module has no such name; raise ``error``, which begins with ``where``, on failure."""
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
    """Return a plug-in's name for a sentence."""
    package = f" of {entry.dist.name}" if entry.dist else ""
    return f"plug-in {shown(entry.name)} ({one_line(entry.value, 80)}{package})"
