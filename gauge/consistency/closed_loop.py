"""Closed loop: the same episodes in two engines, compared pair by pair.

Noise, latency and commands of an episode depend on the episode alone, so two engines are handed the same ones; what differs
is what physics made of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from ...backends.base import Scene
from ...backends.registry import make_backend
from ...policy.base import Policy
from ...robots import Robot
from ...terrains.registry import make_terrain
from ..episodes import QUALITY, Episode, Record
from ..goals import SUB_COMMANDS, TARGET
from ..runner import EpisodeRunner, Progress
from ..scoring import run_statistics
from ..suite import Suite
from .statistics import Array, Estimate, effect_size, outcome_agreement, paired_mean, terrain_weights
from .variants import MakeBackend, Variant

_SLOTS = 24
"""Worlds on the CPU."""
_MANY_SLOTS = 8192
"""Worlds on a GPU, at most."""
_MEAN50 = 2
"""Position of mean@50 among ``scoring.STATISTICS``."""

Records = Mapping[str, Record]
"""Finished episodes by their key."""


class Store(Protocol):
    """Where finished episodes are kept."""

    def get(self, episode: Episode) -> Record | None:
        """The record of an episode that has already run."""

    def put(self, record: Record) -> None:
        """Keep a record."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One terrain at one level and friction: what the seeds are repetitions of."""

    terrain: str
    level: int
    friction: float


def make_cells(terrains: Sequence[str], levels: Sequence[int], frictions: Sequence[float]) -> list[Cell]:
    """All combinations, terrain by terrain; flat ground has level 0 alone."""
    return [
        Cell(terrain=t, level=level, friction=f)
        for t in terrains
        for level in ([0] if t == "flat" else levels)
        for f in frictions
    ]


def episodes_of(cell: Cell, suite: Suite, seeds: Sequence[int]) -> list[Episode]:
    """Quality episodes of a cell, and where the terrain has a target the crossings of the level test too."""
    names = [g.name for g in suite.goals]
    stages = {"eval": tuple(n for n in names if n != TARGET)}
    if cell.terrain != "flat" and TARGET in names:
        stages["search"] = (TARGET,)
    return [
        Episode(
            terrain=cell.terrain,
            level=cell.level,
            friction=cell.friction,
            payload=suite.matrix.nominal_payload,
            seed=seed,
            stage=stage,
            goals=goals,
        )
        for stage, goals in stages.items()
        for seed in seeds
    ]


class EpisodeList:
    """The agenda of a fixed list of episodes (see ``runner.Agenda``)."""

    def __init__(self, episodes: Sequence[Episode], store: Store) -> None:
        """Take what the store has from there; the longest of the others come first."""
        self._store = store
        self.records: dict[str, Record] = {}
        self._queue: list[Episode] = []
        for episode in episodes:
            known = store.get(episode)
            if known is None:
                self._queue.append(episode)
            else:
                self.records[episode.key] = known
        self._queue.sort(key=lambda e: e.stage != "eval")

    @property
    def waiting(self) -> int:
        """Number of episodes that have not begun."""
        return len(self._queue)

    @property
    def waiting_segments(self) -> int:
        """Number of worlds in which they can be played side by side."""
        return sum(len(SUB_COMMANDS[goal]) for episode in self._queue for goal in episode.goals)

    def take(self, most: int, *, urgent: bool = False) -> list[Episode]:
        """Up to ``most`` episodes that can start now; no episode is urgent."""
        most = 0 if urgent else most
        taken, self._queue = self._queue[:most], self._queue[most:]
        return taken

    def finished(self, record: Record) -> Collection[Episode]:
        """Keep an episode's record."""
        self._store.put(record)
        self.records[record.episode.key] = record
        return ()


def play(
    variant: Variant,
    episodes: Sequence[Episode],
    *,
    suite: Suite,
    robot: Robot,
    policy: Policy,
    store: Store,
    threads: int = 1,
    make: MakeBackend = make_backend,
    watch: Callable[[int, int], None] | None = None,
) -> dict[str, Record]:
    """Play the episodes that the store does not hold yet.

    Args:
        variant: the engine.
        episodes: what to play.
        suite: the rules.
        robot: whose model is simulated.
        policy: who walks.
        store: where records go and may already be.
        threads: CPU threads; results do not depend on them.
        make: builds engines by name.
        watch: called after each control step with the episodes that have ended and all there are.

    Returns:
        All records by their episode's key.

    Raises:
        BackendError: the engine cannot do what the episodes need.
        PolicyError: the policy's output is not finite.
    """
    agenda = EpisodeList(episodes, store)
    if not agenda.waiting:
        return agenda.records
    places = list(dict.fromkeys((e.terrain, e.level) for e in episodes))
    slots = min(agenda.waiting_segments, _SLOTS if torch.device(variant.device).type == "cpu" else _MANY_SLOTS)
    scene = Scene(
        robot=robot,
        parameters=robot.parameters[suite.parameters],
        terrains=tuple(make_terrain(name, level) for name, level in places),
        terrain_index=(0,) * slots,
        physics=suite.physics,
    )
    backend = variant.worlds(scene, threads=threads, make=make)
    index = {place: i for i, place in enumerate(places)}

    def on_step(_: Progress) -> None:
        if watch is not None:
            watch(len(agenda.records), len(episodes))

    try:
        EpisodeRunner(suite, policy, backend, lambda e: index[e.terrain, e.level]).run(agenda, on_step)
    finally:
        backend.close()
    return agenda.records


@dataclass(frozen=True, kw_only=True)
class Table:
    """Mean@50 of each column in each episode: cells, seeds, columns."""

    values: Array
    """(C, S, M)."""
    columns: tuple[str, ...]
    """Metrics, then ``quality``."""

    def column(self, name: str) -> Array:
        """One column, (C, S)."""
        return self.values[:, :, self.columns.index(name)]


@dataclass(frozen=True, kw_only=True)
class Design:
    """What is compared, and how intervals are drawn."""

    suite: Suite
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]

    @property
    def shared_draws(self) -> bool:
        """Whether episodes of one seed share their random numbers, so that seeds are drawn for all cells at once."""
        return self.suite.noise.stream == "reference"

    def episodes(self) -> list[Episode]:
        """All episodes."""
        return [e for cell in self.cells for e in episodes_of(cell, self.suite, self.seeds)]

    def table(self, records: Records) -> Table:
        """Mean@50 of the quality episodes; an episode without samples counts zero, as in a score."""
        columns = (*self.suite.metrics.weights, QUALITY)
        values = np.zeros((len(self.cells), len(self.seeds), len(columns)))
        for i, cell in enumerate(self.cells):
            for j, episode in enumerate(e for e in episodes_of(cell, self.suite, self.seeds) if e.stage == "eval"):
                record = records[episode.key]
                values[i, j] = [run_statistics(record, m)[_MEAN50] for m in range(len(columns))]
        return Table(values=values, columns=columns)

    def estimate(
        self, values: Array, name: str, rows: Sequence[int] | None = None, *, magnitude: bool = False
    ) -> Estimate:
        """Mean and interval of paired values (C, S), or of magnitudes, over all cells or over some."""
        chosen = range(len(self.cells)) if rows is None else rows
        return paired_mean(
            values[list(chosen)],
            [self.cells[i].terrain for i in chosen],
            shared=self.shared_draws,
            resamples=self.suite.scoring.bootstrap,
            name=name,
            magnitude=magnitude,
        )

    def mean(self, values: Array, rows: Sequence[int] | None = None) -> float:
        """The same mean without its interval."""
        chosen = list(range(len(self.cells)) if rows is None else rows)
        return float(terrain_weights([self.cells[i].terrain for i in chosen]) @ values[chosen].mean(1))


def compare(
    design: Design, reference: Records, compared: Records, *, floor: Records | None = None, name: str
) -> dict[str, Any]:
    """Compare two runs of the same episodes.

    Args:
        design: the episodes.
        reference: records of the one run.
        compared: records of the other.
        floor: records of the reference engine from a state put off by a hair: what chaos alone does.
        name: seeds the intervals' generators.

    Returns:
        Plain data: ``overall`` and ``terrains``, each with ``gap`` (mean |Δ| of the quality's mean@50), ``difference`` (its
        signed mean, compared less reference), the ``floor`` gap and the ``excess`` of the gap over it, the metrics' signed
        differences and effect sizes, and how often falls and reached targets agree; ``episodes``, one row each.
    """
    first, second = design.table(reference), design.table(compared)
    chaos = None if floor is None else np.abs(design.table(floor).column(QUALITY) - first.column(QUALITY))

    def block(rows: Sequence[int], label: str) -> dict[str, Any]:
        key = f"{name}/{label}"
        picked = list(rows)
        difference = second.column(QUALITY) - first.column(QUALITY)
        gap = np.abs(difference)
        entry: dict[str, Any] = {
            "reference_score": design.mean(first.column(QUALITY), picked),
            "compared_score": design.mean(second.column(QUALITY), picked),
            "gap": design.estimate(gap, f"{key}/gap", picked, magnitude=True).plain(),
            "difference": design.estimate(difference, f"{key}/difference", picked).plain(),
            "effect_size": effect_size(difference[picked]),
            "floor": None if chaos is None else design.estimate(chaos, f"{key}/floor", picked, magnitude=True).plain(),
            "excess": None if chaos is None else design.estimate(gap - chaos, f"{key}/excess", picked).plain(),
            "metrics": {},
            "outcomes": _outcomes(design, reference, compared, picked),
        }
        low, high = entry["difference"]["interval"]
        entry["agrees"] = low <= 0.0 <= high
        for metric in first.columns[:-1]:
            shift = second.column(metric) - first.column(metric)
            entry["metrics"][metric] = {
                "reference": design.mean(first.column(metric), picked),
                "compared": design.mean(second.column(metric), picked),
                "difference": design.estimate(shift, f"{key}/{metric}", picked).plain(),
                "effect_size": effect_size(shift[picked]),
            }
        return entry

    terrains = dict.fromkeys(c.terrain for c in design.cells)
    return {
        "overall": block(range(len(design.cells)), "overall"),
        "terrains": {t: block([i for i, c in enumerate(design.cells) if c.terrain == t], t) for t in terrains},
        "episodes": _rows(design, reference, compared, first, second),
    }


def gap_only(design: Design, first: Records, second: Records, name: str) -> dict[str, Any]:
    """The gap figure of two runs and its signed mean, overall and for each terrain."""
    difference = design.table(second).column(QUALITY) - design.table(first).column(QUALITY)

    def block(rows: Sequence[int], label: str) -> dict[str, Any]:
        return {
            "gap": design.estimate(np.abs(difference), f"{name}/{label}/gap", rows, magnitude=True).plain(),
            "difference": design.estimate(difference, f"{name}/{label}/difference", rows).plain(),
        }

    terrains = dict.fromkeys(c.terrain for c in design.cells)
    return {
        "overall": block(range(len(design.cells)), "overall"),
        "terrains": {t: block([i for i, c in enumerate(design.cells) if c.terrain == t], t) for t in terrains},
    }


def health_of(records: Records) -> dict[str, int]:
    """How many episodes there are, and how many of them fell, diverged or dropped contacts."""
    found = list(records.values())
    return {
        "episodes": len(found),
        "falls": sum(r.falls > 0 for r in found),
        "diverged": sum(r.diverged for r in found),
        "overflowed": sum(r.overflowed for r in found),
    }


def _outcomes(design: Design, reference: Records, compared: Records, rows: Sequence[int]) -> dict[str, Any]:
    """Agreement on falls in quality episodes, and on targets reached in crossings."""
    pairs = [
        (reference[e.key], compared[e.key])
        for i in rows
        for e in episodes_of(design.cells[i], design.suite, design.seeds)
    ]
    walks = [(a, b) for a, b in pairs if a.episode.stage == "eval"]
    crossings = [(a, b) for a, b in pairs if a.episode.stage == "search"]
    fell = outcome_agreement([a.falls > 0 for a, _ in walks], [b.falls > 0 for _, b in walks])
    reached = outcome_agreement([bool(a.success) for a, _ in crossings], [bool(b.success) for _, b in crossings])
    return {"fell": None if fell is None else fell.plain(), "reached": None if reached is None else reached.plain()}


def _rows(design: Design, reference: Records, compared: Records, first: Table, second: Table) -> list[dict[str, Any]]:
    """One row for each pair of episodes."""
    rows = []
    for i, cell in enumerate(design.cells):
        for episode in episodes_of(cell, design.suite, design.seeds):
            pair = (reference[episode.key], compared[episode.key])
            row: dict[str, Any] = {
                "episode": episode.key,
                "terrain": cell.terrain,
                "level": cell.level,
                "friction": cell.friction,
                "seed": episode.seed,
                "stage": episode.stage,
                "falls": [r.falls for r in pair],
                "diverged": [r.diverged for r in pair],
                "overflowed": [r.overflowed for r in pair],
            }
            if episode.stage == "eval":
                j = design.seeds.index(episode.seed)
                row["quality"] = [float(t.column(QUALITY)[i, j]) for t in (first, second)]
            else:
                row["reached"] = [bool(r.success) for r in pair]
            rows.append(row)
    return rows
