"""The state of the segment in every world of a rollout: its description, its progress, and its counts.

A control step reads and writes these tensors in place; where it is captured as a CUDA graph they have to stay where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple, get_type_hints

import torch

from ...robots.base import Robot
from ...robots.rotation import from_yaw
from ...terrains.base import Terrain
from ..goals import TARGET, Schedule
from ..suite import Suite
from .pushes import push_force, push_steps
from .segments import Segment, SegmentRules


class SegmentCounts(NamedTuple):
    """Counts of a world during a segment, and up to its first penetration."""

    control_steps: int
    substeps: int
    falls: int
    lost_samples: int
    samples: int
    """Rows in the table of samples."""
    penetration_control_steps: int
    penetration_substeps: int
    penetration_samples: int
    diverged: bool
    overflowed: bool
    reached: bool
    penetrated: bool
    penetration_overflowed: bool


# Shape behind the worlds, and kind; None for that of the physics.
Flags = Annotated[torch.Tensor, (), torch.bool]
Counts = Annotated[torch.Tensor, (), torch.int64]
Numbers = Annotated[torch.Tensor, (), None]
Vectors = Annotated[torch.Tensor, (3,), None]
Quaternions = Annotated[torch.Tensor, (4,), None]
JointValues = Annotated[torch.Tensor, ("joints",), torch.float32]


@dataclass(kw_only=True)
class WorldBuffers:
    """Tensors over K worlds, the first axis of each: (K,) where nothing else is said; floating point as in the physics."""

    active: Flags
    """True in worlds that take part in control steps."""

    # what does not change during a segment
    spawn: Vectors
    """Base position after a reset [m], world frame, (K, 3)."""
    heading: Quaternions
    """Base orientation after a reset, wxyz, (K, 4)."""
    terrain_index: Counts
    """Terrain of the scene."""
    target: Vectors
    """Position to reach [m], world frame, (K, 3)."""
    backward: Flags
    """True where the robot walks backwards to the target."""
    speed: Numbers
    """Forward speed on the way to the target [m/s]."""
    limits: Vectors
    """Command limits, forward, lateral [m/s] and yaw [rad/s], (K, 3)."""
    friction: Numbers
    """Sliding friction coefficient."""
    first_row: Counts
    """First row of the sub-command in ``Schedule.commands``."""
    length: Counts
    """Control steps of the sub-command, or those that the target goal may take."""
    noise_start: Counts
    """Beginning of the segment in its episode's noise [control steps]."""
    push_force: Numbers
    """Sideways push, to the left of the heading [N]."""
    push_begin: Counts
    push_end: Counts
    """Commanded steps from which and before which it acts; none where both are the same."""
    aims: Flags
    """True for a segment that aims at a target."""
    sampled: Flags
    """True where samples are taken."""

    # how far it is
    settling: Flags
    """True until the robot stands after a reset."""
    commanded_steps: Counts
    """Control steps since it stood."""
    tick: Counts
    """Substeps on the grid of samples."""
    substeps: Counts
    """Substeps so far."""
    control_steps: Counts
    """Control steps so far."""
    done: Flags
    """True once the way to the target is over, while the robot settles again."""
    reached: Flags
    """True once the target was reached."""
    falls: Counts
    diverged: Flags
    overflowed: Flags
    lost_samples: Counts
    """Samples that a fall cost."""
    action: JointValues
    """The last action, (K, J)."""
    target_command: Vectors
    """Command that leads to the target, forward, lateral [m/s] and yaw [rad/s], (K, 3)."""

    # the first penetration, and how far the segment was then
    watched: Flags
    """True while a penetration would matter."""
    penetrated: Flags
    """True once a penetration mattered."""
    penetration_control_steps: Counts
    penetration_substeps: Counts
    penetration_samples: Counts
    penetration_overflowed: Flags

    # since the last poll
    ended: Flags
    """True once the segment has ended."""
    respawn: Flags
    """True where the robot goes back to its spawn."""
    not_finite: Flags
    """True where the policy's action for a finite observation is not finite."""

    @classmethod
    def allocate(cls, count: int, joints: int, device: torch.device, dtype: torch.dtype) -> WorldBuffers:
        """Return the buffers of ``count`` empty worlds; ``dtype`` is that of the physics."""
        tensors = {}
        for name, hint in get_type_hints(cls, include_extras=True).items():
            shape, kind = hint.__metadata__
            sizes = [joints if size == "joints" else size for size in shape]
            tensors[name] = torch.zeros(count, *sizes, dtype=kind or dtype, device=device)
        made = cls(**tensors)
        made.limits.fill_(1.0)
        made.friction.fill_(1.0)
        return made

    def mask(self, worlds: Sequence[int]) -> torch.Tensor:
        """Return a mask, (K,) bool, True for some worlds."""
        mask = torch.zeros_like(self.active)
        if worlds:
            mask[torch.tensor(worlds, device=mask.device)] = True
        return mask

    def begin(
        self,
        worlds: Sequence[int],
        segments: Sequence[Segment],
        terrain_index: Sequence[int],
        *,
        terrains: Sequence[Terrain],
        suite: Suite,
        robot: Robot,
        schedule: Schedule,
        rules: SegmentRules,
    ) -> None:
        """Let segments begin in worlds, on ``terrains`` by their ``terrain_index``; nothing of the worlds' earlier ones is left."""
        device = self.active.device
        at = torch.tensor(worlds, device=device)
        episodes, grounds = [s.episode for s in segments], [terrains[i] for i in terrain_index]
        spawns = ["level_eval" if e.stage == "eval" else "level_search" for e in episodes]
        poses = [ground.spawns[spawn] for ground, spawn in zip(grounds, spawns, strict=True)]
        aims, stand = [s.goal == TARGET for s in segments], robot.stand_height

        def write(into: torch.Tensor, values: Sequence[object]) -> None:
            into[at] = torch.tensor(values, device=device, dtype=into.dtype)

        write(self.spawn, [(p.position[0], p.position[1], p.position[2] + stand) for p in poses])
        self.heading[at] = from_yaw(torch.tensor([p.yaw for p in poses], device=device, dtype=self.heading.dtype))
        write(self.terrain_index, terrain_index)
        if any(aims):
            write(self.target, [t.target or (0.0, 0.0, 0.0) for t in grounds])
            write(self.backward, [t.backward for t in grounds])
            write(self.speed, [suite.commands.target_speed.get(t.family, 0.0) for t in grounds])
        write(self.limits, [suite.command_limits(t.family) for t in grounds])
        write(self.friction, [e.friction for e in episodes])
        write(self.first_row, [schedule.first_row(s.goal, s.sub_command) for s in segments])
        lengths = [
            schedule.target_steps.get(t.family, 0)
            if s.goal == TARGET
            else len(schedule.sub_commands[s.goal][s.sub_command])
            for s, t in zip(segments, grounds, strict=True)
        ]
        write(self.length, lengths)
        write(self.noise_start, [rules.noise_start(s) for s in segments])
        if suite.push is not None:
            steps = [push_steps(suite, s) if s.goal == suite.push.goal else (0, 0) for s in segments]
            write(self.push_force, [push_force(suite.push, s) for s in segments])
            write(self.push_begin, [begin for begin, _ in steps])
            write(self.push_end, [end for _, end in steps])
        write(self.aims, aims)
        write(self.watched, [rules.restarts and not s.again for s in segments])
        write(self.sampled, [e.stage == "eval" for e in episodes])
        mask = self.mask(worlds)
        for counter in (self.tick, self.substeps, self.control_steps, self.falls, self.lost_samples):
            counter.masked_fill_(mask, 0)
        for flag in (self.done, self.reached, self.penetrated, self.diverged, self.overflowed):
            flag.masked_fill_(mask, 0)

    def leave(self, worlds: Sequence[int]) -> None:
        """Empty worlds."""
        at = torch.tensor(worlds, dtype=torch.int64, device=self.active.device)
        for flag in (self.active, self.ended, self.respawn, self.not_finite):
            flag[at] = False

    def counts(self, worlds: Sequence[int], samples: torch.Tensor) -> list[SegmentCounts]:
        """Return the counts of some worlds; ``samples``: rows that each of the K worlds has in the table of samples, (K,)."""
        whole = (self.control_steps, self.substeps, self.falls, self.lost_samples, samples)
        beginning = (self.penetration_control_steps, self.penetration_substeps, self.penetration_samples)
        flags = (self.diverged, self.overflowed, self.reached, self.penetrated, self.penetration_overflowed)
        numbers = torch.stack([t.to(torch.int64) for t in (*whole, *beginning, *flags)], dim=1)
        rows = numbers[torch.tensor(worlds, device=numbers.device)].tolist()
        split = len(whole) + len(beginning)
        return [SegmentCounts(*row[:split], *map(bool, row[split:])) for row in rows]
