"""Find the algorithm of a method: one of ``configuration.METHODS``, each in a file of its own here, or a class of a user."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch

from ...files.parsing import shown
from ..configuration import METHODS
from ..environment.own_terms import find_class, guarded
from ..processes import ProcessLostError
from .ppo import PPO

_PASSED_ON = (ProcessLostError, MemoryError, torch.OutOfMemoryError)
_CALLED = ("act", "store_outcome", "compute_returns", "update")


def find_method(name: str) -> type[PPO]:
    """Return the class that ``training.algorithm.method`` names.

    An exception in the code of a user's class becomes one sentence.

    Raises:
        ConfigurationError: there is no such module or class, or it is not derived from ``PPO``.
    """
    if name in METHODS:
        file, _, kind = METHODS[name].partition(":")
        found: type[PPO] = getattr(import_module(f"{__package__}.{file}"), kind)
        return found
    setting = "training.algorithm.method"
    own, where = find_class(name, setting, PPO), f"{setting} is {shown(name)}"

    def build(*arguments: Any, **named: Any) -> PPO:
        made = guarded(own.build, where, _PASSED_ON)(*arguments, **named)
        for call in _CALLED:
            setattr(made, call, guarded(getattr(made, call), where, _PASSED_ON))
        return made

    calls = {"build": staticmethod(build), "networks": staticmethod(guarded(own.networks, where, _PASSED_ON))}
    return type(own.__name__, (own,), calls)
