"""The file of a sweep: what is trained, with which seeds, and how it is judged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ...files.parsing import Name, Seed, Text, build, one_line, parse_toml, read_text, shown
from ..launch import DEFAULT_BACKEND

NO_SUITE = "none"
_SEEDS = ("training.run.seed", "environment.seed")
"""Settings that would be the same in all runs of an entry."""
MOST_RUNS = 1000
"""Trainings of a sweep."""


class SweepError(ValueError):
    """A sweep cannot be run; the message says what is wrong and what to change."""


@dataclass(frozen=True, kw_only=True)
class SweepEntry:
    """One line of the table: a task with some settings, trained once for each seed."""

    name: Name
    """Label in tables, and name of its folder."""
    task: Text
    """What is trained (``gaitgauge list tasks``)."""
    settings: tuple[Text, ...] = ()
    """``key=value`` each, after those of the sweep."""
    seeds: tuple[Seed, ...] | None = None
    """None for those of the sweep."""
    backend: Text | None = None
    """Physics engine; None for that of the sweep."""
    device: Literal["cpu", "cuda"] | None = None
    """Where it is trained; None for what the engine is made for."""
    init_from: Text | None = None
    """Shipped policy or checkpoint whose networks it begins with; None for that of the sweep."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A list of trainings, and how they are judged."""

    name: Name
    """Name of the output folder."""
    title: Text
    """One line for people."""
    entry: tuple[SweepEntry, ...]
    """The tables ``[[entry]]``."""
    seeds: tuple[Seed, ...] = (0,)
    """Each entry is trained once with each."""
    settings: tuple[Text, ...] = ()
    """``key=value`` each, of all entries."""
    backend: Text = DEFAULT_BACKEND
    """Physics engine of the trainings."""
    init_from: Text | None = None
    """Shipped policy or checkpoint whose networks the trainings begin with; None for nothing."""
    suite: Text = "gaitgauge-1"
    """Suite that gauges each run at its end, on MuJoCo."""
    training_suite: Text = "quick"
    """Suite that scores checkpoints while they train, for the learning curves; ``none`` for no scores."""
    checkpoint: Literal["last", "best"] = "last"
    """What of a run is gauged: its last checkpoint, or the one that ``training_suite`` scored highest."""

    def __post_init__(self) -> None:
        names = [e.name.lower() for e in self.entry]
        if not names:
            raise ValueError("has no entries; add a table [[entry]] with name and task")
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"has several entries of the name {twice[0]}; their folders would be the same")
        for seeds in (self.seeds, *(e.seeds for e in self.entry if e.seeds is not None)):
            if not seeds or len(set(seeds)) < len(seeds):
                raise ValueError(f"has seeds {list(seeds)}; give at least one, and each once")
        for setting in (*self.settings, *(setting for e in self.entry for setting in e.settings)):
            if setting.partition("=")[0].strip() in _SEEDS:
                raise ValueError(
                    f"has the setting {shown(setting)}, with which all seeds train the same run; write seeds = […]"
                )
        if self.checkpoint == "best" and self.training_suite == NO_SUITE:
            raise ValueError("has checkpoint 'best', which training_suite chooses; give a suite, or checkpoint 'last'")
        runs = sum(len(self.seeds if e.seeds is None else e.seeds) for e in self.entry)
        if runs > MOST_RUNS:
            raise ValueError(f"has {runs:,} trainings; at most {MOST_RUNS:,} are possible")


def load_sweep(path: Path) -> Sweep:
    """Read a sweep's file.

    Raises:
        SweepError: no such file, no valid TOML, or a field that does not fit.
    """
    source = f"sweep file '{one_line(path)}'"
    return build(Sweep, parse_toml(read_text(path, "sweep file", SweepError), source, SweepError), source, SweepError)
