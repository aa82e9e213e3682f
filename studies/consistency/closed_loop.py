"""Closed loop: the same episodes in two engines, compared pair by pair.

Noise, latency and commands of an episode depend on the episode alone, so two engines are handed the same ones; what differs
is what physics made of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from ...backends.registry import engine_class
from ...gauge.episodes import QUALITY, Episode, Record
from ...gauge.goals import TARGET
from ...gauge.plan import Records, plan_list
from ...gauge.play.dispatcher import Dispatcher, Speculation, play
from ...gauge.play.progress import ProgressMeter, Status
from ...gauge.play.segments import count_segments
from ...gauge.play.workers import Job, local_workers, start_workers
from ...gauge.scoring import run_statistics
from ...gauge.suite import Suite
from ...gauge.totals import environment_weights
from ...policy.base import Policy
from ...robots import Robot
from .request import MARGIN
from .statistics import Array, Estimate, effect_size, outcome_agreement, paired_mean
from .variants import Variant

_WORLDS = 48
"""Worlds on the CPU."""
_GPU_WORLDS = 8192
"""Worlds on a GPU, at most."""
_MEAN50 = 2
"""Position of mean@50 among ``scoring.STATISTICS``."""


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


def play_variant(
    variant: Variant,
    episodes: Sequence[Episode],
    *,
    suite: Suite,
    robot: Robot,
    policy: Policy,
    records: dict[Episode, Record],
    keep: Callable[[Record], None],
    threads: int = 1,
    watch: Callable[[Status], None] = lambda _: None,
) -> None:
    """Play the episodes of which there is no record yet, as an evaluation plays those that its plans require.

    Args:
        records: episodes that have ended; those that end are added.
        keep: called with each record.
        threads: CPU threads; results do not depend on them.
        watch: called now and then with how far playing is.

    Raises:
        BackendError: the engine cannot do what the episodes need.
        WorkerError: a process that plays was ended; that is no fault of the engine.
        PolicyError: the policy's output is not finite.
    """
    waiting = [e for e in episodes if e not in records]
    if not waiting:
        return
    count = local_workers(variant.backend, variant.device, threads=threads, most=len(waiting))
    most = _WORLDS if torch.device(variant.device).type == "cpu" else _GPU_WORLDS
    job = Job(
        suite=suite,
        policy=policy,
        robot=robot,
        places=tuple(dict.fromkeys((e.terrain, e.level) for e in episodes)),
        worlds=min(sum(count_segments(e, suite) for e in waiting), most),
        build=variant.worlds,
        threads=max(threads // count, 1),
    )
    plans, meter = [partial(plan_list, episodes)], ProgressMeter(suite, time.perf_counter())

    def on_progress(dispatcher: Dispatcher) -> None:
        watch(meter.look(dispatcher.plans, dispatcher.active()))

    forked = engine_class(variant.backend).forkable()
    with closing(start_workers(job, count, forked=forked)) as workers:
        play(plans, records, keep, workers, speculation=Speculation(), watch=on_progress)


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
    margin: float = MARGIN
    """Difference of quality that does not matter."""

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
        rows = [[records[e] for e in episodes_of(c, self.suite, self.seeds) if e.stage == "eval"] for c in self.cells]
        values = [[[run_statistics(r, m)[_MEAN50] for m in range(len(columns))] for r in row] for row in rows]
        return Table(values=np.array(values, dtype=np.float64), columns=columns)

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

    def judged(
        self, values: Array, name: str, rows: Sequence[int] | None = None, *, key: str = "difference"
    ) -> dict[str, Any]:
        """A signed estimate under its key, and its ``verdict``."""
        found = self.estimate(values, name, rows)
        return {key: found.plain(), "verdict": found.verdict(self.margin)}

    def mean(self, values: Array, rows: Sequence[int] | None = None) -> float:
        """Return the mean of ``estimate`` alone."""
        chosen = list(range(len(self.cells)) if rows is None else rows)
        return float(environment_weights([self.cells[i].terrain for i in chosen]) @ values[chosen].mean(1))


def compare(
    design: Design, reference: Records, compared: Records, *, floor: Sequence[Records] = (), name: str
) -> dict[str, Any]:
    """Compare two runs of the same episodes.

    Args:
        floor: records of the reference engine put off by a hair, once for each draw: what chaos alone does.
        name: seeds the intervals' generators.

    Returns:
        Plain data: ``overall`` and ``terrains``, each with ``gap`` (mean |Δ| of the quality's mean@50), ``difference`` (its
        signed mean, compared less reference) and its ``verdict``, the ``floor`` gap and the ``excess`` of the gap over it, the
        metrics' signed differences and effect sizes, and how often falls and reached targets agree; ``episodes``, one row each.
    """
    first, second = design.table(reference), design.table(compared)
    chaos = _chaos(design, reference, floor) if floor else None

    def block(rows: Sequence[int], label: str) -> dict[str, Any]:
        key, picked = f"{name}/{label}", list(rows)
        difference = second.column(QUALITY) - first.column(QUALITY)
        gap = np.abs(difference)
        entry: dict[str, Any] = {
            "reference_score": design.mean(first.column(QUALITY), picked),
            "compared_score": design.mean(second.column(QUALITY), picked),
            "gap": design.estimate(gap, f"{key}/gap", picked, magnitude=True).plain(),
            **design.judged(difference, f"{key}/difference", picked),
            "effect_size": effect_size(difference[picked]),
            "floor": None if chaos is None else design.estimate(chaos, f"{key}/floor", picked, magnitude=True).plain(),
            "excess": None if chaos is None else design.estimate(gap - chaos, f"{key}/excess", picked).plain(),
            "metrics": {},
            "outcomes": _outcomes(design, reference, compared, picked),
        }
        for metric in first.columns[:-1]:
            shift = second.column(metric) - first.column(metric)
            entry["metrics"][metric] = {
                "reference": design.mean(first.column(metric), picked),
                "compared": design.mean(second.column(metric), picked),
                "difference": design.estimate(shift, f"{key}/{metric}", picked).plain(),
                "effect_size": effect_size(shift[picked]),
            }
        return entry

    return {**_by_terrain(design, block), "episodes": _rows(design, reference, compared, first, second)}


def gap_only(design: Design, first: Records, second: Records, name: str) -> dict[str, Any]:
    """The gap figure of two runs and its signed mean, overall and for each terrain."""
    difference = design.table(second).column(QUALITY) - design.table(first).column(QUALITY)

    def block(rows: Sequence[int], label: str) -> dict[str, Any]:
        return {
            "gap": design.estimate(np.abs(difference), f"{name}/{label}/gap", rows, magnitude=True).plain(),
            **design.judged(difference, f"{name}/{label}/difference", rows),
        }

    return _by_terrain(design, block)


def floor_only(design: Design, reference: Records, draws: Sequence[Records], name: str) -> dict[str, Any]:
    """The gap of an engine to itself put off by a hair, the mean over draws: overall and for each terrain."""
    chaos = _chaos(design, reference, draws)
    estimate = partial(design.estimate, chaos, magnitude=True)
    return _by_terrain(design, lambda rows, label: {"gap": estimate(f"{name}/{label}/gap", rows).plain()})


def _chaos(design: Design, reference: Records, draws: Sequence[Records]) -> Array:
    """Mean over draws of how far each episode's quality comes from the reference's, (C, S)."""
    base = design.table(reference).column(QUALITY)
    found: Array = np.mean([np.abs(design.table(records).column(QUALITY) - base) for records in draws], axis=0)
    return found


def _by_terrain(design: Design, block: Callable[[Sequence[int], str], dict[str, Any]]) -> dict[str, Any]:
    terrains = dict.fromkeys(c.terrain for c in design.cells)
    return {
        "overall": block(range(len(design.cells)), "overall"),
        "terrains": {t: block([i for i, c in enumerate(design.cells) if c.terrain == t], t) for t in terrains},
    }


def _outcomes(design: Design, reference: Records, compared: Records, rows: Sequence[int]) -> dict[str, Any]:
    """Agreement on falls in quality episodes, and on targets reached in crossings."""
    episodes = [e for i in rows for e in episodes_of(design.cells[i], design.suite, design.seeds)]

    def agreement(stage: str, outcome: Callable[[Record], bool]) -> dict[str, Any] | None:
        chosen = [e for e in episodes if e.stage == stage]
        first, second = ([outcome(records[e]) for e in chosen] for records in (reference, compared))
        return outcome_agreement(first, second, [e.seed for e in chosen], shared=design.shared_draws)

    return {"fell": agreement("eval", lambda r: r.falls > 0), "reached": agreement("search", lambda r: bool(r.success))}


def _rows(design: Design, reference: Records, compared: Records, first: Table, second: Table) -> list[dict[str, Any]]:
    """One row for each pair of episodes."""
    rows = []
    for i, cell in enumerate(design.cells):
        for episode in episodes_of(cell, design.suite, design.seeds):
            pair = (reference[episode], compared[episode])
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
