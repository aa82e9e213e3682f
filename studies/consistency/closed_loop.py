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
from ...gauge.goals import TARGET, command_name
from ...gauge.plan import Records, plan_list
from ...gauge.play.dispatcher import Speculation, play
from ...gauge.play.progress import ProgressMeter, Status, watcher
from ...gauge.play.segments import count_segments
from ...gauge.play.workers import Job, local_workers, start_workers
from ...gauge.scoring import command_statistics, goal_statistics
from ...gauge.suite import Suite
from ...gauge.totals import environment_weights
from ...policy.base import Policy
from ...robots import Robot
from .request import MARGIN
from .statistics import UNDECIDED, Array, Estimate, by_goal, effect_size, outcome_agreement, paired_mean
from .variants import Variant

_WORLDS = 48
"""Worlds on the CPU."""
_GPU_WORLDS = 8192
"""Worlds on a GPU, at most."""
_LARGE, _MOST_COMMANDS = 0.05, 12
"""Smallest difference of a metric in a command that is said, and how many are said at most."""
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


def layout(variant: Variant, episodes: Sequence[Episode], suite: Suite, threads: int) -> tuple[int, int]:
    """Return the number of workers that play episodes in an engine, and the worlds of each."""
    count = local_workers(variant.backend, variant.device, threads=threads, most=len(episodes))
    most = _WORLDS if torch.device(variant.device).type == "cpu" else _GPU_WORLDS
    return count, min(sum(count_segments(e, suite) for e in episodes), most)


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
    meter: ProgressMeter | None = None,
) -> None:
    """Play the episodes of which there is no record yet, as an evaluation plays those that its plans require.

    Args:
        records: episodes that have ended; those that end are added.
        threads: CPU threads; results do not depend on them.
        meter: estimates it; None for one that knows nothing yet.

    Raises:
        BackendError: the engine cannot do what the episodes need.
        WorkerError: a process that plays was ended; that is no fault of the engine.
        PolicyError: the policy's output is not finite.
    """
    waiting = [e for e in episodes if e not in records]
    if not waiting:
        return
    count, worlds = layout(variant, waiting, suite, threads)
    job = Job(
        suite=suite,
        policy=policy,
        robot=robot,
        places=tuple(dict.fromkeys((e.terrain, e.level) for e in episodes)),
        worlds=worlds,
        build=variant.worlds,
        threads=max(threads // count, 1),
    )
    meter = meter or ProgressMeter(suite, time.perf_counter())
    forked = engine_class(variant.backend).forkable()
    with closing(start_workers(job, count, forked=forked)) as workers:
        plans = [partial(plan_list, episodes)]
        play(plans, records, keep, workers, speculation=Speculation(), watch=watcher(meter, watch))


@dataclass(frozen=True, kw_only=True)
class Table:
    """Mean@50 of each column in each goal of each episode: cells, seeds, goals, columns."""

    values: Array
    """(C, S, G, M)."""
    columns: tuple[str, ...]
    """Metrics, then ``quality``."""

    def goals(self, name: str) -> Array:
        """One column, (C, S, G)."""
        return self.values[..., self.columns.index(name)]

    def column(self, name: str) -> Array:
        """One column, the mean over an episode's goals, (C, S)."""
        return self.goals(name).mean(2)


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
        values = [[[goal_statistics(r, m)[:, _MEAN50] for m in range(len(columns))] for r in row] for row in rows]
        return Table(values=np.array(values, dtype=np.float64).swapaxes(2, 3), columns=columns)

    def estimate(
        self, values: Array, name: str, rows: Sequence[int] | None = None, *, magnitude: bool = False
    ) -> Estimate:
        """Mean and interval of paired values of episodes, (C, S), or of their goals, (C, S, G), over all cells or over some.

        Magnitudes are those of whole episodes.
        """
        chosen = list(range(len(self.cells)) if rows is None else rows)
        terrains, values = [self.cells[i].terrain for i in chosen], values[chosen]
        settings: dict[str, Any] = {"resamples": self.suite.scoring.bootstrap, "name": name, "magnitude": magnitude}
        if values.ndim == 2:
            return paired_mean(values, terrains, shared=self.shared_draws, **settings)
        rows_of_goals, weights = by_goal(values, terrains, shared=self.shared_draws)
        return paired_mean(rows_of_goals, terrains, shared=False, weights=weights, **settings)

    def judged(
        self, values: Array, name: str, rows: Sequence[int] | None = None, *, key: str = "difference"
    ) -> dict[str, Any]:
        """A signed estimate under its key, its ``verdict``, and the ``deciding_seeds`` of one that is undecided, as far as known."""
        found = self.estimate(values, name, rows)
        verdict = found.verdict(self.margin)
        seeds = found.deciding_seeds(self.margin) if verdict == UNDECIDED else None
        return {key: found.plain(), "verdict": verdict, "deciding_seeds": seeds}

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
        metrics' signed differences and effect sizes, and how often falls and reached targets agree; ``commands``, the largest
        differences of a metric in one command; ``episodes``, one row each.
    """
    first, second = design.table(reference), design.table(compared)
    chaos = _chaos(design, reference, floor) if floor else None

    def block(rows: Sequence[int], label: str) -> dict[str, Any]:
        key, picked = f"{name}/{label}", list(rows)
        of_goals = second.goals(QUALITY) - first.goals(QUALITY)
        difference = of_goals.mean(2)
        gap = np.abs(difference)
        entry: dict[str, Any] = {
            "reference_score": design.mean(first.column(QUALITY), picked),
            "compared_score": design.mean(second.column(QUALITY), picked),
            "gap": design.estimate(gap, f"{key}/gap", picked, magnitude=True).plain(),
            **design.judged(of_goals, f"{key}/difference", picked),
            "effect_size": effect_size(difference[picked]),
            "floor": None if chaos is None else design.estimate(chaos, f"{key}/floor", picked, magnitude=True).plain(),
            "excess": None if chaos is None else design.estimate(gap - chaos, f"{key}/excess", picked).plain(),
            "metrics": {},
            "outcomes": _outcomes(design, reference, compared, picked),
        }
        for metric in first.columns[:-1]:
            shift = second.goals(metric) - first.goals(metric)
            entry["metrics"][metric] = {
                "reference": design.mean(first.column(metric), picked),
                "compared": design.mean(second.column(metric), picked),
                "difference": design.estimate(shift, f"{key}/{metric}", picked).plain(),
                "effect_size": effect_size(shift[picked].mean(2)),
            }
        return entry

    return {
        **_by_terrain(design, block),
        "commands": _commands(design, reference, compared),
        "episodes": _rows(design, reference, compared, first, second),
    }


def gap_only(design: Design, first: Records, second: Records, name: str) -> dict[str, Any]:
    """The gap figure of two runs and its signed mean, overall and for each terrain."""
    difference = design.table(second).goals(QUALITY) - design.table(first).goals(QUALITY)

    def block(rows: Sequence[int], label: str) -> dict[str, Any]:
        return {
            "gap": design.estimate(np.abs(difference.mean(2)), f"{name}/{label}/gap", rows, magnitude=True).plain(),
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


def _commands(design: Design, reference: Records, compared: Records) -> list[dict[str, Any]]:
    """Return the largest differences of a metric's mean@50 in a sub-command of a terrain, over its frictions, levels and seeds."""
    rows: list[dict[str, Any]] = []
    for terrain in dict.fromkeys(c.terrain for c in design.cells):
        cells = [c for c in design.cells if c.terrain == terrain]
        episodes = [e for c in cells for e in episodes_of(c, design.suite, design.seeds) if e.stage == "eval"]
        for number, metric in enumerate(design.suite.metrics.weights):
            pairs = [[command_statistics(records[e], number) for e in episodes] for records in (reference, compared)]
            for goal, part in sorted(set().union(*map(set, (*pairs[0], *pairs[1])))):
                both = [(a, b) for a, b in zip(*pairs, strict=True) if (goal, part) in a and (goal, part) in b]
                values = np.array([[found[goal, part][_MEAN50] for found in pair] for pair in both])
                if not len(values):
                    continue
                first, second = (float(v) for v in values.mean(0))
                command = command_name(episodes[0].goals[goal], part)
                entry = {"terrain": terrain, "command": command, "metric": metric}
                rows.append(entry | {"reference": first, "compared": second, "difference": second - first})
    rows = [row for row in rows if abs(row["difference"]) >= _LARGE]
    return sorted(rows, key=lambda row: -abs(row["difference"]))[:_MOST_COMMANDS]


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
