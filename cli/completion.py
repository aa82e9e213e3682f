"""Complete values for the shell. No engine is loaded, and a name that cannot be found out is left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

Completer = Callable[[str], list[str]]
"""Takes the beginning of a word and returns values; the caller drops those that begin otherwise."""

_POLICY_ENDINGS = (".pt", ".onnx")


def _suites(incomplete: str) -> list[str]:
    from ..gauge.suite import suite_names

    return [*suite_names(), *_files(incomplete, (".toml",))]


def _scenarios(incomplete: str) -> list[str]:
    from ..studies.trials.scenario import scenario_names

    return ["all", *scenario_names(), *_files(incomplete, (".toml",))]


def _terrains(incomplete: str) -> list[str]:
    from ..terrains.registry import terrain_names

    return terrain_names()


def _backends(incomplete: str) -> list[str]:
    """Return names of engines; after a comma, those of the next one."""
    from ..backends.registry import backend_names

    before, comma, _ = incomplete.rpartition(",")
    return [before + comma + name for name in backend_names()]


def _robots(incomplete: str) -> list[str]:
    from ..robots.registry import robot_names

    return [*robot_names(), *_files(incomplete, (".toml",))]


def _tasks(incomplete: str) -> list[str]:
    from ..training.tasks import GROUNDS, TASKS

    return [*GROUNDS, *TASKS]


def _policies(incomplete: str) -> list[str]:
    from ..policy.finding import policy_names

    return [*policy_names(), *_checkpoints_and_files(incomplete)]


def _checkpoints_and_files(incomplete: str) -> list[str]:
    runs = [f.as_posix() for f in sorted(Path("logs/rsl_rl").glob("*/*/*.pt"), reverse=True)]
    return [*runs, *(f for f in _files(incomplete, _POLICY_ENDINGS) if f not in runs)]


def of(*values: str) -> Completer:
    """Return a completer of these values."""
    return lambda incomplete: list(values)


def _files(incomplete: str, endings: tuple[str, ...]) -> list[str]:
    """Return files with such an ending, and folders, that begin like this."""
    folder, slash, name = incomplete.rpartition("/")
    try:
        found = sorted(p for p in Path(folder + slash or ".").iterdir() if p.name.startswith(name))
    except OSError:  # no such folder
        return []
    chosen = [p for p in found if p.is_dir() or p.suffix in endings]
    hidden = "." if not name.startswith(".") else "\0"
    return [f"{folder}{slash}{p.name}{'/' if p.is_dir() else ''}" for p in chosen if not p.name.startswith(hidden)]


KINDS: Mapping[str, Completer] = {
    "suites": _suites,
    "scenarios": _scenarios,
    "terrains": _terrains,
    "backends": _backends,
    "robots": _robots,
    "tasks": _tasks,
    "policies": _policies,
    "checkpoints": lambda incomplete: ["latest", *_checkpoints_and_files(incomplete)],
}
"""Completers by the kind of names that a ``Choice`` gives."""
