"""What is known of the segment in every slot: what it is, how far it is, and what it has counted so far.

A control step reads and writes these tensors in place; a recorded one (``recording``) needs them to stay where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

from ..robots.base import Robot
from ..robots.rotation import from_yaw
from ..terrains.base import Terrain
from .goals import TARGET, Schedule
from .segments import Segment, SegmentRules
from .suite import Suite


class Figures(NamedTuple):
    """What a slot counted during a segment, or up to the first penetration (``deep_…``)."""

    control_steps: int
    physics_steps: int
    falls: int
    lost: int
    """Samples that a fall cost."""
    samples: int
    """Rows in the table of samples."""
    deep_control_steps: int
    deep_physics_steps: int
    deep_samples: int
    diverged: bool
    overflowed: bool
    reached: bool
    deep: bool
    """Whether there was a penetration."""
    deep_overflowed: bool


class Seats:
    """Tensors over K slots. K is the first axis of each."""

    def __init__(
        self,
        suite: Suite,
        robot: Robot,
        schedule: Schedule,
        rules: SegmentRules,
        count: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        """Allocate everything for ``count`` slots; ``dtype`` is that of the physics."""
        self._suite, self._robot, self._schedule, self._rules = suite, robot, schedule, rules
        self.count, self._device, self._dtype = count, device, dtype

        def zeros(*shape: int, kind: torch.dtype = dtype) -> torch.Tensor:
            return torch.zeros(count, *shape, device=device, dtype=kind)

        whole, truth = torch.int64, torch.bool
        self.active = zeros(kind=truth)
        # what does not change during a segment
        self.spawn, self.heading, self.terrain = zeros(3), zeros(4), zeros(kind=whole)
        self.target, self.backward, self.speed = zeros(3), zeros(kind=truth), zeros()
        self.limits, self.friction = zeros(3) + 1.0, zeros() + 1.0
        self.first_row, self.length = zeros(kind=whole), zeros(kind=whole)
        self.noise_start = zeros(kind=whole)
        self.aims, self.sampled = zeros(kind=truth), zeros(kind=truth)
        # how far it is
        self.settling, self.part_steps = zeros(kind=truth), zeros(kind=whole)
        self.tick, self.steps, self.played = zeros(kind=whole), zeros(kind=whole), zeros(kind=whole)
        self.done, self.reached = zeros(kind=truth), zeros(kind=truth)
        self.falls, self.diverged, self.overflowed = zeros(kind=whole), zeros(kind=truth), zeros(kind=truth)
        self.lost = zeros(kind=whole)
        self.last_action, self.towards = zeros(robot.num_joints, kind=torch.float32), zeros(3)
        # the first penetration: whether one still matters, whether there was one, and how far the segment was then
        self.watched, self.deep = zeros(kind=truth), zeros(kind=truth)
        self.deep_control, self.deep_steps = zeros(kind=whole), zeros(kind=whole)
        self.deep_count, self.deep_overflowed = zeros(kind=whole), zeros(kind=truth)
        # since the last look: segments that ended, robots that go back to their spawn, actions that are no numbers
        self.ended, self.again, self.bad = zeros(kind=truth), zeros(kind=truth), zeros(kind=truth)

    def write(self, slots: Sequence[int], segments: Sequence[Segment], terrains: Sequence[Terrain]) -> None:
        """Let segments begin in slots, each on a terrain of its own; nothing of the slots' earlier ones is left."""
        suite, schedule, device = self._suite, self._schedule, self._device
        at = torch.tensor(slots, device=device)
        episodes = [s.episode for s in segments]
        poses = [
            t.spawns["level_eval" if e.stage == "eval" else "level_search"]
            for t, e in zip(terrains, episodes, strict=True)
        ]
        aims, stand = [s.goal == TARGET for s in segments], self._robot.stand_height

        def write(into: torch.Tensor, values: Sequence[object]) -> None:
            into[at] = torch.tensor(values, device=device, dtype=into.dtype)

        write(self.spawn, [(p.position[0], p.position[1], p.position[2] + stand) for p in poses])
        self.heading[at] = from_yaw(torch.tensor([p.yaw for p in poses], device=device, dtype=self._dtype))
        if any(aims):
            write(self.target, [t.target or (0.0, 0.0, 0.0) for t in terrains])
            write(self.backward, [t.backward for t in terrains])
            write(self.speed, [suite.commands.target_speed.get(t.family, 0.0) for t in terrains])
        write(self.limits, [suite.command_limits(t.family) for t in terrains])
        write(self.friction, [e.friction for e in episodes])
        write(self.first_row, [schedule.first_row(s.goal, s.part) for s in segments])
        write(
            self.length,
            [
                schedule.target_steps.get(t.family, 0) if s.goal == TARGET else len(schedule.parts[s.goal][s.part])
                for s, t in zip(segments, terrains, strict=True)
            ],
        )
        write(self.noise_start, [self._rules.noise_start(s) for s in segments])
        write(self.aims, aims)
        write(self.watched, [self._rules.restarts and not s.again for s in segments])
        write(self.sampled, [e.stage == "eval" for e in episodes])
        mask = self.mask(slots)
        for counter in (self.tick, self.steps, self.played, self.falls, self.lost):
            counter.masked_fill_(mask, 0)
        for flag in (self.done, self.reached, self.deep, self.diverged, self.overflowed):
            flag.masked_fill_(mask, 0)

    def mask(self, slots: Sequence[int]) -> torch.Tensor:
        """(K,) bool, true for some slots."""
        mask = torch.zeros(self.count, dtype=torch.bool, device=self._device)
        if slots:
            mask[torch.tensor(slots, device=self._device)] = True
        return mask

    def leave(self, slots: Sequence[int]) -> None:
        """Nobody sits there any more."""
        at = torch.tensor(slots, dtype=torch.int64, device=self._device)
        for flag in (self.active, self.ended, self.again):
            flag[at] = False

    def figures(self, slots: Sequence[int], samples: torch.Tensor) -> list[Figures]:
        """What some slots counted; ``samples``: rows that each of the K slots has in the table of samples, (K,)."""
        whole = (self.played, self.steps, self.falls, self.lost, samples)
        beginning = (self.deep_control, self.deep_steps, self.deep_count)
        flags = (self.diverged, self.overflowed, self.reached, self.deep, self.deep_overflowed)
        numbers = torch.stack([t.to(torch.int64) for t in (*whole, *beginning, *flags)], dim=1)
        rows = numbers[torch.tensor(slots, device=self._device)].tolist()
        split = len(whole) + len(beginning)
        return [Figures(*row[:split], *map(bool, row[split:])) for row in rows]
