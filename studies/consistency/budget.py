"""Estimate the time of a study: before it starts, with what more would take, and while it plays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from ...files.choices import cpu_threads
from ...gauge.play.progress import ProgressMeter, Status
from ...gauge.play.remaining import CPU_COST, Cost
from ...gauge.suite import load_suite
from ...terrains.registry import gauge_terrain_names
from ..engine_pace import EnginePace, measure_all, measure_cost
from .attribution import choose_factors
from .closed_loop import make_cells
from .prepared import PreparedStudy
from .request import StudyCost, StudyStatus
from .variants import Variant

_OPEN_LOOP = 700
"""Control steps of the open loop in an engine."""
_WHOLE, _MANY = "gaitgauge-1", 10
"""Suite and number of seeds that more would mean."""


class Budget:
    """Measures what engines cost, and estimates what is left."""

    def __init__(self, prepared: PreparedStudy, watch: Callable[[StudyStatus], None]) -> None:
        """Measure; ``watch`` hears which engine is measured."""
        self._prepared = prepared
        self._threads = cpu_threads(prepared.request.threads)
        self._runs = prepared.variants(prepared.factors)
        episodes = prepared.design.episodes()
        name, policy = prepared.policies[0]
        measure = partial(
            measure_cost,
            episodes=episodes,
            suite=prepared.suite,
            robot=prepared.robot,
            policy=policy,
            threads=self._threads,
        )

        def one(variant: Variant) -> Cost:
            watch(StudyStatus(name, variant.label, 0, len(self._runs), done=0, episodes=len(episodes)))
            return measure(variant)

        self._costs = measure_all(prepared.engines, one, lambda *_: None)  # playing says what an engine cannot do
        self._pace = self._estimate(prepared, self._runs)
        self.cost = StudyCost(
            runs=len(self._runs) * len(prepared.policies),
            episodes=len(episodes),
            seconds=self._pace.seconds_left,
            more={option: seconds for option, seconds in self._more() if seconds > 1.05 * self._pace.seconds_left},
        )

    def _estimate(self, prepared: PreparedStudy, runs: list[Variant]) -> EnginePace:
        opened = [self._costs[v.label] for v in prepared.engines if v.label in self._costs]
        after = sum(_OPEN_LOOP * (cost.loop - CPU_COST.loop + cost.world) for cost in opened)
        return EnginePace(
            runs * len(prepared.policies),
            self._costs,
            prepared.design.episodes(),
            suite=prepared.suite,
            threads=self._threads,
            after=after * len(prepared.policies),
        )

    def _more(self) -> list[tuple[str, float]]:
        """Return options that ask for more, and the time that the study would take with each [s]."""
        prepared, found = self._prepared, []
        if not prepared.factors:
            runs = prepared.variants(choose_factors(()))
            found.append(("--attribution", self._estimate(prepared, runs).seconds_left))
        if len(prepared.seeds) < _MANY:
            many = replace(prepared, seeds=tuple(range(_MANY)))
            found.append((f"--seeds {_MANY}", self._estimate(many, self._runs).seconds_left))
        if prepared.suite.name != _WHOLE:
            suite, levels = load_suite(_WHOLE), tuple({c.level for c in prepared.cells if c.level}) or (3,)
            cells = make_cells(gauge_terrain_names(), levels, tuple({c.friction for c in prepared.cells}))
            whole = replace(prepared, suite=suite, cells=cells)
            found.append((f"--suite {_WHOLE}, on all terrains", self._estimate(whole, self._runs).seconds_left))
        return found

    def begin(self, policy: int, variant: Variant) -> tuple[int, int, ProgressMeter]:
        """Begin the run of a policy in a variant; return its number, that of all runs, and the meter that estimates it."""
        labels = [v.label for v in self._runs]
        number = policy * len(labels) + labels.index(variant.label)
        return number + 1, self.cost.runs, self._pace.begin(number)

    def look(self, status: Status) -> tuple[float, float]:
        """Take the progress of the run at work; return the share of the study's time that is over, and the time left [s]."""
        self._pace.look(status)
        return self._pace.share, self._pace.seconds_left

    def end(self, *, counts: bool) -> None:
        """End the run at work, see ``EnginePace.end``."""
        self._pace.end(counts=counts)
