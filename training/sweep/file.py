"""Read the file of a sweep: trainings, seeds and how they are judged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ...files.parsing import Name, Seed, Text, one_line, read_toml
from ...gauge.suite import SuiteError, load_suite

NO_SUITE = "none"
MOST_RUNS = 1000
"""Trainings of a sweep."""


class SweepError(ValueError):
    """A sweep cannot be run; the message names the error and the change."""


@dataclass(frozen=True, kw_only=True)
class SweepEntry:
    """One line of the table: a task with some settings, trained once for each seed."""

    name: Name
    """Label in tables, and name of its folder."""
    task: Text
    """Task (``gaitgauge list tasks``)."""
    settings: tuple[Text, ...] = ()
    """``key=value`` each, after those of the sweep."""
    seeds: tuple[Seed, ...] | None = None
    """None for those of the sweep."""
    backend: Text | None = None
    """Physics engine; None for that of the sweep."""
    device: Literal["cpu", "cuda"] | None = None
    """Where it trains; None for that of the sweep."""
    init_from: Text | None = None
    """Shipped policy or checkpoint with the first networks; None for that of the sweep."""


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
    backend: Text = "mujoco-warp"
    """Physics engine of the trainings."""
    device: Literal["cpu", "cuda"] | None = None
    """Device; None for the engine's default."""
    init_from: Text | None = None
    """Shipped policy or checkpoint with the first networks of the trainings; None for untrained ones."""
    suite: Text = "gaitgauge-1"
    """Suite that gauges each run at its end, on MuJoCo."""
    training_suite: Text = "quick"
    """Suite that scores checkpoints while they train, for the learning curves; ``none`` for no scores."""
    checkpoint: Literal["last", "best"] = "last"
    """Checkpoint of a run that is gauged: its last, or the one that ``training_suite`` scored highest."""

    def __post_init__(self) -> None:
        if not self.entry:
            raise ValueError("has no entries; add a table [[entry]] with name and task")
        folders: dict[str, str] = {}
        for entry in self.entry:
            if other := folders.get(entry.name.lower()):
                raise ValueError(f"has the entries '{other}' and '{entry.name}' in one folder; rename one of them")
            folders[entry.name.lower()] = entry.name
        if self.checkpoint == "best" and self.training_suite == NO_SUITE:
            raise ValueError("has checkpoint 'best', which training_suite chooses; give a suite, or checkpoint 'last'")
        runs = sum(len(self.seeds_of(e)) for e in self.entry)
        if runs > MOST_RUNS:
            raise ValueError(f"has {runs:,} trainings; at most {MOST_RUNS:,} are possible")

    def seeds_of(self, entry: SweepEntry) -> tuple[int, ...]:
        """Return the entry's own seeds, or else the sweep's."""
        return self.seeds if entry.seeds is None else entry.seeds


def load_sweep(path: Path) -> Sweep:
    """Read a sweep's file. Raises SweepError: no such file, no valid TOML, a field that does not fit, or no such suite."""
    source = f"sweep file '{one_line(path)}'"
    sweep = read_toml(path, Sweep, "sweep file", SweepError, source=source)
    scores = {} if sweep.training_suite == NO_SUITE else {"training_suite": sweep.training_suite}
    for field, suite in ({"suite": sweep.suite} | scores).items():
        try:
            load_suite(suite)
        except SuiteError as error:
            raise SweepError(f"{source}: {field}: {error}") from error
    return sweep
