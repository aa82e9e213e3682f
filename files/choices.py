"""Describe the fields of a request once: command-line options, help groups, completion and the Python API are made of them.

Nothing here imports more than the standard library, because ``gaitgauge --help`` reads it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
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
    """Describe how the command line asks for a value. A request annotates each field that a user may choose with one.

    A value without a default is a positional argument. Of several choices in one annotation the last counts.
    """

    help: str
    """One sentence."""
    group: str | None = None
    """Heading in the help of a command with many options."""
    values: str | tuple[str, ...] = ()
    """Values that the shell completes, or the kind of names (a key of ``cli/completion.py:KINDS``)."""
    metavar: str | None = None
    flags: tuple[str, ...] = ()
    """Spelling of the option. Empty for the field's own name, in the singular where the option is repeated; a switch that is off
    has no ``--no-`` form then.
    """
    argument: bool = False
    """True for a positional argument with a default."""


def choices(request: type) -> Mapping[str, tuple[Any, Any]]:
    """Return defaults (``MISSING`` where there is none) and annotated types of a request's fields with a ``Choice``, by name."""
    hints = _hints(request)
    return {f.name: (f.default, hints[f.name]) for f in fields(request) if choice_of(hints[f.name]) is not None}


def choice_of(hint: Any) -> Choice | None:
    """Return the last ``Choice`` in an annotated type; None where there is none."""
    return next((part for part in reversed(getattr(hint, "__metadata__", ())) if isinstance(part, Choice)), None)


def cores() -> int:
    """Return the number of cores that this process may use: a job on a cluster has fewer than its machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_threads(asked: int | None) -> int:
    """Return the requested number of CPU threads; None stands for all cores."""
    return asked or cores()


@cache
def _hints(request: type) -> Mapping[str, Any]:
    return get_type_hints(request, include_extras=True)


_FILES = "own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained."
_ONE, _MORE = f"A policy file ({_FILES}", f"One or more policy files ({_FILES}"
_CLUSTER = (
    "Ray cluster to play on, with all free CPUs or as many as --threads: auto, HOST:PORT or ray://HOST:PORT. "
    "Results do not depend on it."
)
_THREADS = "CPU threads; results do not depend on them. Default: all cores."
_CONTRACT = "How a policy without a contract of its own is run: contract.toml, deploy.yaml, config.yaml, env.yaml …"
_ROBOT = "Robot name, or a robot.toml. Default: the robot that the policy is for."
_SET = (
    "Parameter set of the robot, or FILE.toml of 'gaitgauge identify' or 'robot motor', in place of the suite's; a measured "
    "delay replaces the suite's latency."
)
_DEVICE = "cpu or cuda; the default is what the engine is made for."
PolicyName = Annotated[str, Choice(_ONE, None, "policies", "POLICY")]
PolicyNames = Annotated[tuple[str, ...], Choice(_MORE, None, "policies", "POLICY...")]
ContractName = Annotated[str | None, Choice(_CONTRACT, PLAYED, metavar="FILE")]
Trust = Annotated[bool, Choice("Run the program that a policy file of the project's own format carries inside.")]
SuiteName = Annotated[
    str, Choice("Suite name (see 'gaitgauge list suites') or a suite's .toml file.", PLAYED, "suites")
]
EngineName = Annotated[str, Choice("Physics engine, see 'gaitgauge list backends'.", PLACE, "backends")]
DeviceName = Annotated[str | None, Choice(_DEVICE, PLACE, ("cpu", "cuda"))]
RobotName = Annotated[str | None, Choice(_ROBOT, PLAYED, "robots")]
ParameterSet = Annotated[str | None, Choice(_SET, PLAYED)]
TerrainNames = Annotated[tuple[str, ...], Choice("Terrain; repeatable. Default: the suite's.", PLAYED, "terrains")]
FirstSeed = Annotated[int, Ge(0), Le(LARGEST_SEED), Choice("Seed of the first robot; the others' follow it.", PLAYED)]
ThreadCount = Annotated[int | None, Ge(1), Le(MOST_THREADS), Choice(_THREADS, PLACE)]
ClusterAddress = Annotated[str | None, Choice(_CLUSTER, PLACE, metavar="ADDRESS")]
