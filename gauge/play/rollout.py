"""Plays episodes on the worlds of one backend: the loop of gauge protocol §3.3 over many worlds, on the CPU and on a GPU.

Episodes fall into segments; a segment takes a world, and when it ends the next one that waits moves in, with its own terrain,
friction and payload. Every few control steps (``poll_interval``) the rollout looks for ended segments, on the CPU in every
step. On a GPU a poll waits for the device and resets robots with one more physics step of all worlds, so that polls are
rarer, and the control steps until the next one are launched before the records of the last one are handed out.

What happens in a segment depends on that segment alone: not on its world, its neighbours, the number of threads or the poll
interval. ``CpuStep`` or ``GpuStep`` takes the control steps; ``WorldBuffers`` holds the state of the segments.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import islice
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from ...backends.base import PhysicsBackend, Randomization
from ...policy.base import Policy, PolicyError
from ..episodes import QUALITY, Episode, Record
from ..goals import TARGET
from ..ground_rules import heavier
from ..suite import Suite
from .control_step import ControlStep, CpuStep, GpuStep
from .feet import foot_torsion, torsion_varies
from .sampling import Samples
from .segments import AtWork, Segment, SegmentOutcome, SegmentQueue
from .world_buffers import SegmentCounts

POLL_INTERVAL = 10
"""Control steps between two polls of a GPU. A poll waits for the device and moves robots with one more physics step of all
worlds; until it comes, a segment that has ended keeps its world for some steps. Ten make either a small part of the time."""


@runtime_checkable
class EpisodeAware(Protocol):
    """A backend that wants to know what its worlds play."""

    def assign(self, worlds: Sequence[int], names: Sequence[str]) -> None:
        """Called before some worlds are reset for other segments, with names that are those segments' own."""


class Rollout:
    """Plays what it is given, and hands out a record for each episode."""

    def __init__(
        self,
        suite: Suite,
        policy: Policy,
        backend: PhysicsBackend,
        terrain_index: Callable[[Episode], int],
        *,
        poll_interval: int | None = None,
        capture: bool = True,
    ) -> None:
        """Prepare empty worlds.

        Args:
            backend: worlds to play in; its scene holds every terrain that an episode asks for.
            terrain_index: the scene's index of an episode's terrain.
            poll_interval: control steps between two polls; None for 1 on the CPU and ``POLL_INTERVAL`` on a GPU. With 1,
                values are read during a step too where that saves work. Changes the time alone.
            capture: capture control steps as CUDA graphs, on a GPU. Changes the time alone.
        """
        self.suite, self.backend = suite, backend
        self._terrain_index = terrain_index
        self.poll_interval = poll_interval or (1 if backend.device.type == "cpu" else POLL_INTERVAL)
        self._step: ControlStep = (
            CpuStep(suite, policy, backend)
            if self.poll_interval == 1
            else GpuStep(suite, policy, backend, capture=capture)
        )
        self._queue = SegmentQueue(self._step.rules, (*self._step.samples.names, QUALITY))
        self._columns = len(self._step.samples.names) + 1
        self._segments: dict[int, Segment] = {}  # by the world in which it is at work
        self._began: dict[int, int] = {}
        self._respawn: set[int] = set()  # worlds whose robots go to their spawn before the next step
        self._changed = self._launched = False
        self._randomized: list[tuple[float, float, float] | None] = [None] * backend.num_worlds
        self._turning = torsion_varies(suite, backend)
        self._mass_scale = heavier(suite.ground, backend.scene.robot)
        self.control_steps = 0
        """Control steps so far, each of all worlds."""
        self.world_steps = 0
        """Control steps so far, added up over worlds at work."""
        self.busy_seconds = 0.0
        """Time in the loop so far [s], that of the first call left out: then engines compile."""
        self.physics_steps = 0
        """Physics steps up to the last poll that found something, added up over worlds."""

    @property
    def captured(self) -> bool:
        """Return whether control steps are captured as CUDA graphs, or will be."""
        return self._step.captured

    # ---- what there is to play ------------------------------------------------------------------------------------

    def play(self, episodes: Sequence[Episode]) -> None:
        """Take on episodes; level tests, on which others wait, go before all that waits."""
        self._queue.add(episodes)

    def drop(self, episodes: Collection[Episode]) -> None:
        """Cancel episodes; no record will come of them."""
        self._queue.drop(episodes)
        self._leave([world for world, segment in self._segments.items() if segment.episode in episodes])

    @property
    def idle(self) -> bool:
        """Return whether there is nothing to play, and every record has been handed out."""
        return not self._segments and not len(self._queue)

    @property
    def free_worlds(self) -> int:
        """Return the number of worlds without a segment."""
        return self.backend.num_worlds - len(self._segments)

    @property
    def room(self) -> int:
        """Return the number of segments that could begin at once beside those that wait."""
        return self.free_worlds - len(self._queue)

    def at_work(self) -> dict[Episode, AtWork]:
        """Return how far the episodes at work are."""
        spent: dict[Episode, list[int]] = {}
        for world, segment in self._segments.items():
            spent.setdefault(segment.episode, []).append(self.control_steps - self._began[world])
        waiting = self._queue.waiting()
        return {
            episode: AtWork(
                steps=sum(ages) + self._queue.steps_behind(episode),
                parts=len(ages) + waiting.get(episode, 0),
                spent=sum(ages),
                youngest=0 if episode in waiting else min(ages),
            )
            for episode, ages in spent.items()
        }

    # ---- the loop -------------------------------------------------------------------------------------------------

    def advance(self) -> list[Record]:
        """Play up to the next poll.

        Returns:
            Records of the episodes that have ended. On a GPU they are those of the poll before: the next control steps are at
            work by the time they are handed out.

        Raises:
            PolicyError: the policy's output is not finite.
        """
        first, began = self.control_steps == 0, time.perf_counter()
        with torch.inference_mode():
            records = self.poll()
            self.begin()
            if self._segments:
                self.launch()
            if self.poll_interval == 1:
                records += self.poll()
        if not first:
            self.busy_seconds += time.perf_counter() - began
        return records

    def begin(self) -> None:
        """Let segments begin in free worlds, and put robots to their spawn."""
        if len(self._queue) and self.free_worlds:
            segments = self._queue.take(self.free_worlds)
            free = (world for world in range(self.backend.num_worlds) if world not in self._segments)
            self._seat(list(islice(free, len(segments))), segments)
        if not self._changed and not self._respawn:
            return
        step, mask = self._step, self._step.buffers.mask(sorted(self._respawn))
        step.buffers.active |= mask
        if self._changed:
            step.arrange()
        if self._respawn:
            step.reset(mask)
            self.physics_steps += len(self._respawn)
        self._changed = False
        self._respawn.clear()

    def launch(self) -> None:
        """Take the control steps up to the next poll."""
        self._step.run(self.poll_interval)
        self.control_steps += self.poll_interval
        self.world_steps += self.poll_interval * len(self._segments)
        self._launched = True

    def poll(self) -> list[Record]:
        """Return the records of episodes that have ended since the last poll."""
        if not self._launched:
            return []
        self._launched = False
        step, buffers = self._step, self._step.buffers
        found = torch.stack((buffers.ended, buffers.respawn, buffers.not_finite))
        if self.poll_interval == 1 and not bool(found.any()):
            return []
        ended, respawn, not_finite = (
            [world for world, flag in enumerate(row) if flag and world in self._segments] for row in found.tolist()
        )
        buffers.ended.zero_()
        buffers.respawn.zero_()
        self.physics_steps += step.take_world_steps() * self.backend.scene.physics.substeps
        if not_finite:
            raise self._policy_error(not_finite[0])
        self._respawn.update(respawn)
        if not ended:
            return []
        outcomes = self._outcomes(ended)
        records, hidden = self._queue.finish(outcomes)
        over = outcomes.keys() | hidden
        self._leave([world for world, segment in self._segments.items() if segment in over])
        return records

    # ---- worlds ---------------------------------------------------------------------------------------------------

    def _seat(self, worlds: list[int], segments: Sequence[Segment]) -> None:
        """Let segments begin in free worlds."""
        step, suite, rules = self._step, self.suite, self._step.rules
        episodes = [s.episode for s in segments]
        step.buffers.begin(
            worlds,
            segments,
            [self._terrain_index(e) for e in episodes],
            terrains=self.backend.scene.terrains,
            suite=suite,
            robot=self.backend.scene.robot,
            schedule=step.schedule,
            rules=rules,
        )
        sampled = [rules.most_steps(s) for s in segments if s.episode.stage == "eval"]
        if sampled:
            substeps = (max(sampled) + 2) * self.backend.scene.physics.substeps
            step.samples.reserve(math.ceil(substeps / suite.metrics.interval) + 2)
        step.samples.clear(step.buffers.mask(worlds))
        self._randomize(worlds, segments)
        if isinstance(self.backend, EpisodeAware):
            self.backend.assign(worlds, [f"{s.episode.key} {s.goal} {s.sub_command}" for s in segments])
        most = max(rules.most_steps(s) for s in segments)
        step.read_noise(worlds, episodes, [rules.noise_start(s) for s in segments], most)
        self._segments.update(zip(worlds, segments, strict=True))
        self._began.update(dict.fromkeys(worlds, self.control_steps))
        self._respawn.update(worlds)
        self._changed = True

    def _leave(self, worlds: list[int]) -> None:
        """Empty worlds."""
        for world in worlds:
            del self._segments[world], self._began[world]
        self._step.buffers.leave(worlds)
        self._respawn.difference_update(worlds)
        self._changed = True

    def _randomize(self, worlds: list[int], segments: Sequence[Segment]) -> None:
        """Give worlds the friction, payload and feet of their segments, where they have others."""
        wanted = {
            world: (s.episode.friction, s.episode.payload, foot_torsion(self.suite, s) if self._turning else 1.0)
            for world, s in zip(worlds, segments, strict=True)
        }
        wanted = {world: values for world, values in wanted.items() if self._randomized[world] != values}
        if not wanted:
            return
        mask, device, dtype = self._step.buffers.mask(list(wanted)), self.backend.device, self.backend.dtype
        values = torch.tensor([wanted[world] for world in sorted(wanted)], device=device, dtype=dtype)
        # a mass changes constants that an engine has to work out anew
        present = [self._randomized[world] for world in wanted]
        changed = any(old is None or old[1] != new[1] for old, new in zip(present, wanted.values(), strict=True))
        change = Randomization(
            friction=values[:, 0],
            base_mass_offset=values[:, 1] * self._mass_scale if changed else None,
            foot_torsion=values[:, 2] if self._turning else None,
        )
        self.backend.randomize(change, mask)
        for world, triple in wanted.items():
            self._randomized[world] = triple

    def _policy_error(self, world: int) -> PolicyError:
        """Return the error of a policy that answered a finite observation with something else."""
        segment, buffers = self._segments[world], self._step.buffers
        action = buffers.action[world]
        return PolicyError(
            f"the policy returned {float(action[~torch.isfinite(action)][0])} for a finite observation at control step "
            f"{int(buffers.control_steps[world])} of {segment.goal}, sub-command {segment.sub_command + 1}, of episode "
            f"{segment.episode.key}; a policy must return finite numbers"
        )

    def _outcomes(self, worlds: Sequence[int]) -> dict[Segment, SegmentOutcome]:
        """Return the outcomes of ended segments in some worlds."""
        buffers, table = self._step.buffers, self._step.samples
        counts = dict(zip(worlds, buffers.counts(worlds, table.count), strict=True))
        sampled = {world: c.samples for world, c in counts.items() if c.samples}
        samples: dict[int, Samples] = {}
        if sampled:
            tables = table.read(list(sampled), list(sampled.values()), buffers.limits, buffers.friction)
            samples = dict(zip(sampled, tables, strict=True))
        none = np.zeros(0, dtype=np.bool_)
        nothing = np.zeros((0, self._columns), dtype=np.float32), none, none
        segments = self._segments
        return {segments[w]: _outcome(segments[w], c, *samples.get(w, nothing)) for w, c in counts.items()}


def _outcome(
    segment: Segment,
    counts: SegmentCounts,
    values: NDArray[np.float32],
    keep: NDArray[np.bool_],
    touching: NDArray[np.bool_],
) -> SegmentOutcome:
    """Return a segment's outcome from its counts and its samples, (T, columns); those to ``keep``, (T,), count."""
    aims = segment.goal == TARGET
    lost = np.zeros((counts.lost_samples, values.shape[1]), dtype=np.float32)
    outcome = SegmentOutcome(
        samples=np.concatenate((values[keep], lost)),
        touching=np.concatenate((touching[keep], np.zeros(len(lost), dtype=np.bool_))),
        control_steps=counts.control_steps,
        physics_steps=counts.substeps,
        falls=counts.falls,
        diverged=counts.diverged,
        overflowed=counts.overflowed,
        reached=counts.reached,
        restarted=counts.penetrated and aims,
    )
    if not counts.penetrated or aims:
        return outcome
    # the beginning, up to a penetration after which its goal starts again
    before = int(keep[: counts.penetration_samples].sum())
    beginning = replace(
        outcome,
        samples=outcome.samples[:before],
        touching=outcome.touching[:before],
        control_steps=counts.penetration_control_steps,
        physics_steps=counts.penetration_substeps,
        overflowed=counts.penetration_overflowed,
        falls=0,
        diverged=False,
        restarted=True,
    )
    return replace(outcome, until_penetration=beginning)
