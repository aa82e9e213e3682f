"""Describe the fields of a request once: command-line options, help groups, completion and the Python API are made of them.

Nothing here imports more than the standard library, because ``gaitgauge --help`` reads it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, fields
from functools import cache
from typing import Annotated, Any, get_type_hints

from annotated_types import Ge, Le

from . import MOST_THREADS

PLAYED = "What is played"
PLACE = "Where it runs"
WATCHED = "How it is watched"
SPAN = "Beginning and end of a run"
SCORES = "Scores while it learns"
WRITTEN = "What is written"
LARGEST_SEED = 2**63 - 2**32
"""Largest first seed: commands count on from it."""


@dataclass(frozen=True)
class Choice:
    """An option of the command line. A request annotates each field that a user may choose with a ``Choice``."""

    help: str
    """One sentence."""
    group: str | None = None
    """Heading in the help of a command with many options."""
    flags: tuple[str, ...] = ()
    """Spelling of the option; empty for the field's own name."""
    metavar: str | None = None
    values: str | tuple[str, ...] = ()
    """Values that the shell completes, or the kind of names (a function of ``cli/completion.py``)."""
    argument: bool = False
    """True for a positional argument."""


def choices(request: type) -> Mapping[str, tuple[Field[Any], Any]]:
    """Return the fields of a request that a user may choose, with their annotated types, by name."""
    hints = _hints(request)
    return {f.name: (f, hints[f.name]) for f in fields(request) if choice_of(hints[f.name]) is not None}


def choice_of(hint: Any) -> Choice | None:
    """Return the ``Choice`` in an annotated type; None where there is none."""
    return next((part for part in getattr(hint, "__metadata__", ()) if isinstance(part, Choice)), None)


def cpu_threads(asked: int | None) -> int:
    """Return the requested number of CPU threads; None stands for all cores."""
    return asked or os.cpu_count() or 1


def required(field: Field[Any]) -> bool:
    """Return whether a field has no default."""
    return field.default is MISSING and field.default_factory is MISSING


@cache
def _hints(request: type) -> Mapping[str, Any]:
    return get_type_hints(request, include_extras=True)


_FILES = "own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained."
PolicyName = Annotated[str, Choice(f"A policy file ({_FILES}", argument=True, metavar="POLICY", values="policies")]
PolicyNames = Annotated[
    tuple[str, ...],
    Choice(f"One or more policy files ({_FILES}", argument=True, metavar="POLICY...", values="policies"),
]
Trust = Annotated[
    bool, Choice("Run the program that a policy file of the project's own format carries inside.", flags=("--trust",))
]
SuiteName = Annotated[
    str, Choice("Suite name (see 'gaitgauge list suites') or a suite's .toml file.", PLAYED, values="suites")
]
EngineName = Annotated[str, Choice("Physics engine, see 'gaitgauge list backends'.", PLACE, values="backends")]
DeviceName = Annotated[
    str | None, Choice("cpu or cuda; the default is what the engine is made for.", PLACE, values=("cpu", "cuda"))
]
RobotName = Annotated[
    str | None,
    Choice("Robot name, or a robot.toml. Default: the robot that the policy is for.", PLAYED, values="robots"),
]
TerrainNames = Annotated[
    tuple[str, ...],
    Choice("Terrain; repeatable. Default: the suite's.", PLAYED, flags=("--terrain",), values="terrains"),
]
FirstSeed = Annotated[int, Ge(0), Le(LARGEST_SEED), Choice("Seed of the first robot; the others' follow it.", PLAYED)]
ThreadCount = Annotated[
    int | None,
    Ge(1),
    Le(MOST_THREADS),
    Choice("CPU threads; results do not depend on them. Default: all cores.", PLACE),
]
ClusterAddress = Annotated[
    str | None,
    Choice(
        "Ray cluster whose CPUs play, all that are free or as many as --threads: auto, HOST:PORT or ray://HOST:PORT. "
        "Results do not depend on it.",
        PLACE,
        metavar="ADDRESS",
    ),
]
