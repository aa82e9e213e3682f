"""Trains legged-robot walking policies on Warp physics and judges them in an engine they never trained in.

The names below are imported at their first use, so that ``import gaitgauge`` costs nothing; ``api.py`` and
``gauge/result.py`` document them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .version import __version__

if TYPE_CHECKING:
    from .api import compare, evaluate, load_policy, load_results, train
    from .gauge.result import Result

__all__ = ["Result", "__version__", "compare", "evaluate", "load_policy", "load_results", "train"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module(".gauge.result" if name == "Result" else ".api", __name__), name)
    raise AttributeError(f"module 'gaitgauge' has no attribute '{name}'; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
