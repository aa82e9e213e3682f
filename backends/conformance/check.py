"""Register the functions that are checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco

from ..base import CAPABILITY_NAMES
from .bench import Bench

# These errors of an engine under test are a failed check, not the end of the run.
ENGINE_ERRORS = (
    *(ArithmeticError, AssertionError, AttributeError, LookupError, OSError),
    *(RuntimeError, TypeError, ValueError, mujoco.FatalError),
)


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check.

    Its ``run`` raises ``ConformanceError`` where the engine breaks the contract and returns what it measured.
    """

    name: str
    """Room and subject, for example ``motors/latency``."""
    needs: tuple[str, ...]
    """Capabilities that the check requires."""
    run: Callable[[Bench], str]
    about: str
    """One sentence: the property that is checked."""


_CHECKS: dict[str, Check] = {}


def check(name: str, *needs: str) -> Callable[[Callable[[Bench], str]], Callable[[Bench], str]]:
    """Register a function as a check; the first line of its docstring describes it."""

    def register(function: Callable[[Bench], str]) -> Callable[[Bench], str]:
        unknown = set(needs) - set(CAPABILITY_NAMES)
        if name in _CHECKS or unknown:
            raise ValueError(f"check '{name}' is registered twice or needs unknown capabilities {sorted(unknown)}")
        about = (function.__doc__ or "").strip().partition("\n")[0]
        _CHECKS[name] = Check(name=name, needs=needs, run=function, about=about)
        return function

    return register


def registered(module: str) -> list[Check]:
    """Return the checks that a module defines, in their order there."""
    return [check for check in _CHECKS.values() if check.run.__module__ == module]
