"""Estimate the time of studies that play the same episodes in several engines: what each costs is measured before anything is played."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing

import torch

from ..backends.base import BackendError, ResetState, Scene
from ..backends.registry import engine_class
from ..gauge.episodes import Episode
from ..gauge.motors import joint_parameters
from ..gauge.plan import plan_list
from ..gauge.play.progress import Lengths, ProgressMeter, Status
from ..gauge.play.remaining import CPU_COST, Cost, Stage, Stages
from ..gauge.suite import Suite
from ..policy.base import Policy
from ..robots import Robot
from ..terrains.registry import make_terrain
from .consistency.closed_loop import layout
from .consistency.variants import Variant

_TRIED, _ENOUGH = 10, 1.0
"""Control steps by which an engine's speed is measured, and the time after which fewer do [s]."""
_MOVING = 1.3
"""Cost of a robot that walks over that of one that stands: more contacts come and go."""


def measure_cost(
    variant: Variant, episodes: Sequence[Episode], *, suite: Suite, robot: Robot, policy: Policy, threads: int
) -> Cost:
    """Measure what control steps cost in an engine, with robots that stand on the ground of the episodes.

    Raises:
        BackendError: the engine cannot do what the scene asks for.
    """
    count, worlds = layout(variant, episodes, suite, threads)
    places = list(dict.fromkeys((e.terrain, e.level) for e in episodes))
    scene = Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, policy.contract),
        terrains=tuple(make_terrain(name, level) for name, level in places),
        terrain_index=tuple(i % len(places) for i in range(worlds)),
        physics=suite.physics,
    )
    began = time.perf_counter()
    with closing(variant.worlds(scene, threads=max(threads // count, 1))) as backend:
        height = robot.stand_height
        origins = [t.spawns.get("level_eval") for t in scene.terrains]
        positions = torch.tensor(
            [
                (0.0, 0.0, height)
                if (o := origins[i]) is None
                else (o.position[0], o.position[1], o.position[2] + height)
                for i in scene.terrain_index
            ],
            device=backend.device,
            dtype=backend.dtype,
        )
        pose, upright = (
            torch.tensor(row, device=backend.device, dtype=backend.dtype).expand(worlds, -1)
            for row in (robot.default_joint_position, (1.0, 0.0, 0.0, 0.0))
        )
        backend.reset(ResetState(base_position=positions, base_quaternion=upright, held_target=pose))
        backend.step(pose)
        _wait(backend.device)
        start, steps = time.perf_counter() - began, 0
        began = time.perf_counter()
        while steps < _TRIED and time.perf_counter() - began < _ENOUGH:
            backend.step(pose)
            _wait(backend.device)
            steps += 1
        each = _MOVING * (time.perf_counter() - began) / steps
    if engine_class(variant.backend).parallel_processes:  # steps the worlds at work alone
        return Cost(loop=CPU_COST.loop, world=each / worlds, start=start)
    return Cost(loop=CPU_COST.loop + each, world=CPU_COST.world * 1e-3, start=start)


def _wait(device: torch.device) -> None:
    """Wait for a GPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class EnginePace:
    """Estimates what is left of runs that play the same episodes, one after another, in one engine each."""

    def __init__(
        self,
        runs: Sequence[Variant],
        costs: dict[str, Cost],
        episodes: Sequence[Episode],
        *,
        suite: Suite,
        threads: int,
        after: float = 0.0,
    ) -> None:
        """Prepare.

        Args:
            runs: in the order in which they are played.
            costs: by the engine's label; runs of others are taken for as slow as the first engine.
            after: time that follows the last run [s].
        """
        self._suite, self._episodes, self._costs, self._runs = suite, episodes, costs, runs
        self.lengths = Lengths(suite)
        self._threads, self._usual = threads, next(iter(costs.values()), CPU_COST)
        self._stages = Stages([*(Stage(v.label, self.seconds(v), v.backend) for v in runs), Stage("", after)])
        self._number, self._began, self._clock = -1, 0.0, time.perf_counter
        self._first: float | None = None
        self.seconds_left = self._stages.left(0.0) or 0.0
        self.share = 0.0

    def seconds(self, variant: Variant) -> float:
        """Return the expected time of a run [s]."""
        count, worlds = layout(variant, self._episodes, self._suite, self._threads)
        meter = ProgressMeter(self._suite, 0.0, self._cost(variant), self.lengths)
        work, _ = meter.left([plan_list(self._episodes, {})], {}, count, worlds)
        return self._cost(variant).start + self._cost(variant).seconds(work)

    def _cost(self, variant: Variant) -> Cost:
        return self._costs.get(variant.label) or self._costs.get(variant.backend) or self._usual

    def begin(self, number: int) -> ProgressMeter:
        """Begin a run; return the meter that estimates it."""
        now = self._clock()
        self._first = now if self._first is None else self._first
        self._stages.begin(number, now)
        return ProgressMeter(self._suite, now, self._cost(self._runs[number]), self.lengths)

    def look(self, status: Status) -> None:
        """Take the progress of the run at work."""
        now = self._clock()
        self.seconds_left = self._stages.left(now, own=status.seconds_left) or 0.0
        spent = now - (self._first or now)
        self.share = spent / (spent + self.seconds_left) if spent > 0.0 else 0.0

    def end(self, *, counts: bool) -> None:
        """End the run at work; ``counts``: it played all episodes, none were there before."""
        self._stages.end(self._clock(), counts=counts)


def measure_all(
    variants: Sequence[Variant], measure: Callable[[Variant], Cost], unable: Callable[[Variant, BackendError], None]
) -> dict[str, Cost]:
    """Return costs by label; ``unable`` hears of engines that cannot do what is asked for."""
    found: dict[str, Cost] = {}
    for variant in variants:
        try:
            found[variant.label] = measure(variant)
        except BackendError as error:
            unable(variant, error)
    return found
