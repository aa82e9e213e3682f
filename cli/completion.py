"""Values that the shell completes. Nothing here waits for an engine, and a name that cannot be found out is left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

Completer = Callable[[str], list[str]]
"""Values for a word of which the beginning is given; the caller drops those that begin otherwise."""

_ENDINGS = (".pt", ".onnx")
"""Of policy files."""


def suites(incomplete: str) -> list[str]:
    """Names of suites, and files."""
    from ..gauge.suite import suite_names

    return [*suite_names(), *_files(incomplete, (".toml",))]


def scenarios(incomplete: str) -> list[str]:
    """Names of field trials, and files."""
    from ..studies.trials.scenario import scenario_names

    return ["all", *scenario_names(), *_files(incomplete, (".toml",))]


def terrains(incomplete: str) -> list[str]:
    """Names of terrains."""
    from ..terrains.registry import terrain_names

    return terrain_names()


def backends(incomplete: str) -> list[str]:
    """Names of engines; after a comma, that of the next one."""
    from ..backends.registry import backend_names

    before, comma, _ = incomplete.rpartition(",")
    return [before + comma + name for name in backend_names()]


def robots(incomplete: str) -> list[str]:
    """Names of robots, and descriptions."""
    from ..robots.registry import robot_names

    return [*robot_names(), *_files(incomplete, (".toml",))]


def tasks(incomplete: str) -> list[str]:
    """Names of training tasks."""
    from ..training.tasks import TASKS

    return list(TASKS)


def policies(incomplete: str) -> list[str]:
    """Names of policies, the checkpoints of all runs, and files."""
    from ..policy.finding import policy_names

    return [*policy_names(), *_checkpoints_and_files(incomplete)]


def checkpoints(incomplete: str) -> list[str]:
    """What a run is gone on with."""
    return ["latest", *_checkpoints_and_files(incomplete)]


def _checkpoints_and_files(incomplete: str) -> list[str]:
    runs = [f.as_posix() for f in sorted(Path("logs/rsl_rl").glob("*/*/*.pt"), reverse=True)]
    return [*runs, *(f for f in _files(incomplete, _ENDINGS) if f not in runs)]


def of(*values: str) -> Completer:
    """These values."""
    return lambda incomplete: list(values)


def _files(incomplete: str, endings: tuple[str, ...]) -> list[str]:
    """Files with such an ending, and folders, that begin like this."""
    folder, slash, name = incomplete.rpartition("/")
    try:
        found = sorted(p for p in Path(folder + slash or ".").iterdir() if p.name.startswith(name))
    except OSError:  # no such folder
        return []
    chosen = [p for p in found if p.is_dir() or p.suffix in endings]
    hidden = "." if not name.startswith(".") else "\0"
    return [f"{folder}{slash}{p.name}{'/' if p.is_dir() else ''}" for p in chosen if not p.name.startswith(hidden)]


KINDS: Mapping[str, Completer] = {
    "suites": suites,
    "scenarios": scenarios,
    "terrains": terrains,
    "backends": backends,
    "robots": robots,
    "tasks": tasks,
    "policies": policies,
    "checkpoints": checkpoints,
}
"""Completion by what a ``Choice`` names."""
