"""Runs the episodes of an agenda in lock step on any backend: the loop of gauge protocol §3.3, vectorized over worlds.

A world is a slot. Segments of episodes sit in the slots; when one ends, the next moves in, with its own terrain, friction and
payload. What happens in a segment depends on that segment alone: not on its slot, its neighbours, or the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
import torch

from ..backends.base import PhysicsBackend, Randomization
from ..policy.base import Policy, PolicyError
from ..policy.observation import ObservationBuilder
from ..policy.steady import steady_session
from ..robots.geometry import total_mass
from ..robots.rotation import from_yaw
from .episodes import QUALITY, Episode, Record
from .goals import LATERAL_SPEED, TARGET, Schedule, target_command, target_offset
from .noise import NoiseReader, make_stream
from .sampling import Samples, SampleTable
from .segments import Agenda, Outcome, Segment, SegmentQueue, SegmentRules, cut_short
from .suite import Suite

GRAVITY = 9.81


class Progress:
    """How far the runner is; handed to the ``watch`` callback after every control step, and good until it returns."""

    def __init__(self, runner: EpisodeRunner) -> None:
        self._runner = runner

    @property
    def control_steps(self) -> int:
        """Control steps so far, each of all worlds."""
        return self._runner.control_steps

    @property
    def physics_steps(self) -> int:
        """Physics steps so far, added up over worlds."""
        return self._runner.physics_steps

    def active(self) -> dict[Episode, int]:
        """Episodes at work, and the control steps that each has behind it, added up over its segments."""
        return self._runner.ages()


class EpisodeRunner:
    """Plays the episodes of an agenda on one backend."""

    def __init__(
        self, suite: Suite, policy: Policy, backend: PhysicsBackend, terrain_index: Callable[[Episode], int]
    ) -> None:
        """Prepare the slots, one for each of the backend's worlds.

        Args:
            suite: the rules.
            policy: what is judged.
            backend: worlds to play in; its scene's palette holds every terrain that an episode asks for.
            terrain_index: the palette index of an episode's terrain.
        """
        self.suite, self.backend = suite, backend
        self._terrain_index = terrain_index
        scene, k = backend.scene, backend.num_worlds
        self._slots, self._robot = k, scene.robot
        device, dtype = backend.device, backend.dtype
        self._device, self._dtype = device, dtype
        self._substeps = scene.physics.substeps
        # on the CPU a look at the data is free, and saves the work that nobody needs; on a GPU it would wait for the device
        self._cheap_checks = device.type == "cpu"
        if self._cheap_checks:
            self._session, self._few_rows_suffice = steady_session(policy, k)
        else:
            self._session, self._few_rows_suffice = policy.session(k, device=str(device)), False
        self._builder = ObservationBuilder(policy.contract, scene.robot, k, device)
        self._schedule = Schedule(suite, device, dtype)
        self._rules = SegmentRules(suite, self._schedule)
        self._noise = NoiseReader(make_stream(suite.noise, scene.robot.num_joints, k, device), k, device)
        self._table = SampleTable(suite, scene.robot, GRAVITY * total_mass(scene.robot), k, device, dtype)
        self.columns = (*self._table.names, QUALITY)
        commands = suite.commands
        fastest = max(commands.target_speed.values(), default=0.0)
        # velocity goals keep to the limits, and so does the way to the target unless the suite is an odd one
        self._must_clip = any(x < fastest or y < LATERAL_SPEED for x, y, _ in (commands.flat, commands.levelled))

        def zeros(*shape: int, kind: torch.dtype = dtype) -> torch.Tensor:
            return torch.zeros(k, *shape, device=device, dtype=kind)

        whole, truth = torch.int64, torch.bool
        # who sits where
        self._queue = SegmentQueue(self._rules, self.columns)
        self._segment: list[Segment | None] = [None] * k
        self._free = list(range(k))
        self._seated_at = [0] * k
        self._fitted: list[tuple[float, float] | None] = [None] * k
        self._active = zeros(kind=truth)
        self._rows_to_play: torch.Tensor | None = None
        self._any_target = False
        self._whole_step = zeros(kind=whole)
        # what does not change during a segment
        self._spawn, self._heading, self._terrain = zeros(3), zeros(4), zeros(kind=whole)
        self._target, self._backward, self._speed = zeros(3), zeros(kind=truth), zeros()
        self._limits, self._friction = zeros(3) + 1.0, zeros() + 1.0
        self._first_row, self._length = zeros(kind=whole), zeros(kind=whole)
        self._aims, self._sampled = zeros(kind=truth), zeros(kind=truth)
        # how far it is
        self._settling, self._part_steps = zeros(kind=truth), zeros(kind=whole)
        self._tick, self._steps = zeros(kind=whole), zeros(kind=whole)
        self._done, self._reached = zeros(kind=truth), zeros(kind=truth)
        self._falls, self._diverged, self._overflowed = zeros(kind=whole), zeros(kind=truth), zeros(kind=truth)
        self._lost = zeros(kind=whole)
        self._last_action = zeros(scene.robot.num_joints, kind=torch.float32)
        self._towards = zeros(3)
        # the first penetration: whether one still matters, whether there was one, and how far the segment was then
        self._watched, self._deep = zeros(kind=truth), zeros(kind=truth)
        self._deep_control, self._deep_steps = zeros(kind=whole), zeros(kind=whole)
        self._deep_count, self._deep_overflowed = zeros(kind=whole), zeros(kind=truth)
        self.control_steps = 0
        self.physics_steps = 0
        self._nobody, self._nothing = zeros(kind=truth), zeros(kind=whole)
        # what the last step brought: segments that ended, and robots that go back to their spawn during theirs
        self._ended, self._again = self._nobody, self._nobody

    # ---- segments come and go -------------------------------------------------------------------------------------

    def run(self, agenda: Agenda, watch: Callable[[Progress], None] | None = None) -> None:
        """Play until the agenda has nothing left.

        Raises:
            PolicyError: the policy's output is not finite.
        """
        with torch.inference_mode():
            while self._fill(agenda):
                self._control_step()
                again, ended = torch.stack((self._again, self._ended)).sum(1).tolist()
                if again:
                    self._reset(self._again, again)
                if ended:
                    needless: set[Episode] = set()
                    for record in self._collect():
                        needless.update(agenda.finished(record))
                    if needless:
                        self._drop(needless)
                if watch is not None:
                    watch(Progress(self))

    def ages(self) -> dict[Episode, int]:
        """Episodes with segments in the slots, and the control steps played of each, ended segments included."""
        ages: dict[Episode, int] = {}
        for segment, begun in zip(self._segment, self._seated_at, strict=True):
            if segment is not None:
                ages[segment.episode] = ages.get(segment.episode, 0) + self.control_steps - begun
        return {episode: age + self._queue.steps_behind(episode) for episode, age in ages.items()}

    def _fill(self, agenda: Agenda) -> bool:
        """Let segments begin in the free slots; returns whether any are at work."""
        if self._free:
            segments = self._queue.take(agenda, len(self._free))
            if segments:
                slots, self._free = self._free[: len(segments)], self._free[len(segments) :]
                self._seat(slots, segments)
        return len(self._free) < self._slots

    def _seat(self, slots: list[int], segments: Sequence[Segment]) -> None:
        """Let segments begin in free slots."""
        suite, schedule, device = self.suite, self._schedule, self._device
        at = torch.tensor(slots, device=device)
        episodes = [s.episode for s in segments]
        index = [self._terrain_index(e) for e in episodes]
        terrains = [self.backend.scene.terrains[i] for i in index]
        poses = [
            t.spawns["level_eval" if e.stage == "eval" else "level_search"]
            for t, e in zip(terrains, episodes, strict=True)
        ]
        aims, stand = [s.goal == TARGET for s in segments], self._robot.stand_height

        def write(into: torch.Tensor, values: Sequence[object]) -> None:
            into[at] = torch.tensor(values, device=device, dtype=into.dtype)

        write(self._spawn, [(p.position[0], p.position[1], p.position[2] + stand) for p in poses])
        self._heading[at] = from_yaw(torch.tensor([p.yaw for p in poses], device=device, dtype=self._dtype))
        write(self._terrain, index)
        if any(aims):
            write(self._target, [t.target or (0.0, 0.0, 0.0) for t in terrains])
            write(self._backward, [t.backward for t in terrains])
            write(self._speed, [suite.commands.target_speed.get(t.family, 0.0) for t in terrains])
        write(self._limits, [suite.command_limits(t.family) for t in terrains])
        write(self._friction, [e.friction for e in episodes])
        write(self._first_row, [schedule.first_row(s.goal, s.part) for s in segments])
        write(
            self._length,
            [
                schedule.target_steps.get(t.family, 0) if s.goal == TARGET else len(schedule.parts[s.goal][s.part])
                for s, t in zip(segments, terrains, strict=True)
            ],
        )
        write(self._aims, aims)
        write(self._watched, [self._rules.restarts and not s.again for s in segments])
        sampled = [e.stage == "eval" for e in episodes]
        write(self._sampled, sampled)
        if any(sampled):
            steps = max(self._rules.most_steps(s) for s, kept in zip(segments, sampled, strict=True) if kept)
            self._table.reserve(math.ceil((steps + 2) * self._substeps / suite.metrics.interval) + 2)
        mask = torch.zeros(self._slots, dtype=torch.bool, device=device)
        mask[at] = True
        for counter in (self._tick, self._steps, self._falls, self._lost):
            counter.masked_fill_(mask, 0)
        for flag in (self._done, self._reached, self._deep, self._diverged, self._overflowed):
            flag.masked_fill_(mask, 0)
        self._table.clear(mask)
        self._fit(slots, episodes)
        starts = [self._rules.noise_start(s) for s in segments]
        self._noise.begin(slots, episodes, starts, max(self._rules.most_steps(s) for s in segments))
        for slot, segment in zip(slots, segments, strict=True):
            self._segment[slot] = segment
            self._seated_at[slot] = self.control_steps
        self._active |= mask
        self._count_places()
        self._reset(mask, len(slots))

    def _fit(self, slots: list[int], episodes: Sequence[Episode]) -> None:
        """Give worlds the friction and payload of their episodes, where they have others."""
        wanted = {
            slot: (e.friction, e.payload)
            for slot, e in zip(slots, episodes, strict=True)
            if self._fitted[slot] != (e.friction, e.payload)
        }
        if not wanted:
            return
        mask = torch.zeros(self._slots, dtype=torch.bool, device=self._device)
        mask[torch.tensor(list(wanted), device=self._device)] = True
        values = torch.tensor([wanted[s] for s in sorted(wanted)], device=self._device, dtype=self._dtype)
        self.backend.randomize(Randomization(friction=values[:, 0], base_mass_offset=values[:, 1]), mask)
        for slot, pair in wanted.items():
            self._fitted[slot] = pair

    def _count_places(self) -> None:
        """Work out what depends on who is seated alone."""
        self._whole_step = self._active * self._substeps
        self._any_target = any(s is not None and s.goal == TARGET for s in self._segment)
        self._rows_to_play = None
        if self._few_rows_suffice and self._free:
            # slots that need an action, filled up to a multiple of eight
            taken = [slot for slot, s in enumerate(self._segment) if s is not None]
            count = (len(taken) + 7) // 8 * 8
            if count < self._slots:
                self._rows_to_play = torch.tensor((taken + self._free)[:count], device=self._device)

    def _collect(self) -> list[Record]:
        """Take the ended segments out of their slots; returns the records of the episodes that are complete with them."""
        slots = torch.nonzero(self._ended).flatten()
        whole = (self._table.count, self._steps, self._falls, self._lost)
        flags = (self._diverged, self._overflowed, self._reached, self._deep)
        beginning = (self._deep_control, self._deep_steps, self._deep_count, self._deep_overflowed)
        numbers = torch.stack([t.to(torch.int64) for t in (*whole, *flags, *beginning)], dim=1)
        rows = torch.cat((slots[:, None], numbers[slots]), dim=1).tolist()
        sampled = {slot: count for slot, count, *_ in rows if count}
        samples: dict[int, Samples] = {}
        if sampled:
            tables = self._table.read(list(sampled), list(sampled.values()), self._limits, self._friction)
            samples = dict(zip(sampled, tables, strict=True))
        outcomes = {}
        for slot, _, *row in rows:
            segment = self._segment[slot]
            assert segment is not None
            outcomes[segment] = self._outcome(slot, segment, row, samples.get(slot))
        records, hidden = self._queue.finish(outcomes)
        self._leave([slot for slot, segment in enumerate(self._segment) if segment in outcomes or segment in hidden])
        return records

    def _drop(self, episodes: Collection[Episode]) -> None:
        """Take episodes that nobody needs any more out of their slots."""
        self._queue.drop(episodes)
        seated = enumerate(self._segment)
        self._leave([slot for slot, segment in seated if segment is not None and segment.episode in episodes])

    def _leave(self, slots: list[int]) -> None:
        """Free slots."""
        for slot in slots:
            self._segment[slot] = None
        self._active[torch.tensor(slots, dtype=torch.int64, device=self._device)] = False
        self._free = sorted(self._free + slots)
        self._count_places()

    def _outcome(self, slot: int, segment: Segment, row: list[int], sampled: Samples | None) -> Outcome:
        """What came of the segment that has just ended in a slot; ``row`` holds its numbers as ``_collect`` reads them."""
        steps, falls, lost, diverged, overflowed, reached, deep, *at_penetration = row
        samples = np.zeros((lost, len(self.columns)), dtype=np.float32)
        keep = np.zeros(0, dtype=np.bool_)
        if sampled is not None:
            values, keep = sampled
            samples = np.concatenate((values[keep], samples))
        aims = segment.goal == TARGET
        outcome = Outcome(
            samples=samples,
            control_steps=self.control_steps - self._seated_at[slot],
            physics_steps=steps,
            falls=falls,
            diverged=bool(diverged),
            overflowed=bool(overflowed),
            reached=bool(reached),
            restarted=bool(deep) and aims,
        )
        if not deep or aims:
            return outcome
        control, physics, rows, was_overflowed = at_penetration
        beginning = cut_short(
            outcome,
            samples=int(keep[:rows].sum()),
            control_steps=control - self._seated_at[slot],
            physics_steps=physics,
            overflowed=bool(was_overflowed),
        )
        return replace(outcome, until_penetration=beginning)

    def _reset(self, mask: torch.Tensor, count: int) -> None:
        """Put ``count`` worlds back to their spawn, (K,) bool; the robot hangs limp for one physics step, then settles."""
        self.backend.reset(mask, base_position=self._spawn, base_quaternion=self._heading, terrain_index=self._terrain)
        self.backend.step(None, worlds=mask, substeps=1)
        self._builder.reset(mask)
        self._session.reset(mask)
        self._last_action.masked_fill_(mask[:, None], 0.0)
        self._table.forget_torque(mask)
        self._settling |= mask
        self._part_steps.masked_fill_(mask, 0)
        self._steps += mask
        if self.suite.metrics.clock == "run":
            self._tick += mask
        else:
            self._tick.masked_fill_(mask, 0)
        self.physics_steps += count

    # ---- one control step -----------------------------------------------------------------------------------------

    def _control_step(self) -> None:
        """One turn of the loop for all slots: command, observation, action, physics, samples, events."""
        active, interval = self._active, self.suite.metrics.interval
        leaving = self._leaving()
        commanded = active & ~self._settling
        self._part_steps += commanded
        command = clipped = self._schedule.commands(self._first_row + self._part_steps, self._limits)
        if self._any_target:
            command = clipped = torch.where((self._aims & commanded)[:, None], self._towards, command)
            if self._must_clip:
                clipped = torch.clamp(command, -self._limits, self._limits)
        noise, delay = self._noise.next()
        observation = self._builder.build(self.backend.state, clipped, self._last_action, noise)
        action = self._session.act(observation, self._rows_to_play)
        self._check_action(observation, action)
        self._last_action = action
        ahead = interval - self._tick % interval
        due = active & self._sampled & (ahead <= self._substeps)
        sample_at = ahead * due
        self.backend.step(
            self._builder.targets(action), delay=delay, sample_at=sample_at, worlds=active if self._free else None
        )
        self.control_steps += 1
        self.physics_steps += (self._slots - len(self._free)) * self._substeps
        fall, restart, ran = self._events(due, sample_at)
        self._tick += ran
        self._steps += ran
        if fall is not self._nobody:
            due = due & (sample_at <= ran)
        if not self._cheap_checks or bool(due.any()):
            keep = due if self.suite.settling.sampled else due & commanded
            self._table.write(self.backend.sample, due, keep, command)
        self._table.end_step(self.backend.state, active)
        if fall is not self._nobody:
            self._fall(fall, commanded, ran)
        if leaving is not self._nobody:
            self._settling &= ~leaving
        self._follow_up(fall, restart, commanded)

    def _leaving(self) -> torch.Tensor:
        """Which slots end settling with this step."""
        settling, settle = self._settling & self._active, self.suite.settling
        if self._cheap_checks and not bool(settling.any()):
            return self._nobody
        state = self.backend.state
        speed = torch.linalg.vector_norm(state.base_linear_velocity_w, dim=1)
        still = (speed < settle.speed) & (state.time > settle.shortest)
        return settling & (still | (state.time > settle.longest))

    def _check_action(self, observation: torch.Tensor, action: torch.Tensor) -> None:
        """A policy must answer finite observations with finite actions."""
        if math.isfinite(float(action.sum())):  # the sum of anything that is not finite is not finite
            return
        finite = torch.isfinite(action)
        bad = self._active & ~finite.all(1) & torch.isfinite(observation).all(1)
        if bool(bad.any()):
            slot = int(torch.nonzero(bad)[0])
            segment = self._segment[slot]
            assert segment is not None
            raise PolicyError(
                f"the policy returned {float(action[slot][~finite[slot]][0])} for a finite observation at control step "
                f"{self.control_steps - self._seated_at[slot]} of {segment.goal}, part {segment.part + 1}, of episode "
                f"{segment.episode.key}; a policy must return finite numbers"
            )

    def _events(self, due: torch.Tensor, sample_at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What happened in the step: falls, penetrations that make a target goal start again, and the number of substeps
        until then, (K,) each. The first penetration of a velocity goal's segment interrupts nothing and is remembered.
        """
        state, last, active = self.backend.state, self._substeps, self._active
        deepens = self._rules.restarts
        if self._cheap_checks:
            trouble = state.tilt_substep + state.diverged + state.overflowed
            if deepens:
                trouble += state.penetration_substep * self._watched
            if self._free:  # worlds without a robot keep what happened to their last one
                trouble *= active
            if not bool(trouble.any()):
                return self._nobody, self._nobody, self._whole_step
        never = torch.full_like(state.tilt_substep, last + 1)
        fell_at = torch.where(state.tilt_substep > 0, state.tilt_substep, never)
        # at which substep the state became invalid is not known: nothing of this control step counts
        fell_at = torch.where(state.diverged, torch.zeros_like(fell_at), fell_at)
        self._diverged |= state.diverged & active
        self._overflowed |= state.overflowed & active
        deep_at = never
        if deepens:
            deep_at = torch.where((state.penetration_substep > 0) & self._watched, state.penetration_substep, never)
        deep = active & (deep_at < fell_at)
        restart = deep & self._aims
        fall = active & (fell_at <= last) & ~restart
        if deepens:
            self._deep_control = torch.where(deep, self.control_steps, self._deep_control)
            self._deep_steps = torch.where(deep, self._steps + deep_at, self._deep_steps)
            seen = self._table.count + (due & (sample_at <= deep_at))
            self._deep_count = torch.where(deep, seen, self._deep_count)
            self._deep_overflowed = torch.where(deep, self._overflowed, self._deep_overflowed)
            self._deep |= deep
            self._watched &= ~deep
        ran = torch.minimum(torch.where(restart, deep_at, fell_at), never - 1) * active
        return fall, restart, ran

    def _fall(self, fall: torch.Tensor, commanded: torch.Tensor, ran: torch.Tensor) -> None:
        """Count falls; where they cost the rest of the sub-command, work out how many samples that is."""
        self._falls += fall
        if self._rules.fall_closes_goal:
            return
        # a fall while settling costs the whole sub-command that would have followed
        begun = torch.where(commanded, self._part_steps - 1, self._nothing)
        step_began = torch.where(commanded, self._tick - ran, self._tick)
        part_ends = step_began + (self._length - begun) * self._substeps
        interval = self.suite.metrics.interval
        lost = part_ends // interval - self._tick // interval
        self._lost = torch.where(fall & self._sampled & ~self._aims, lost, self._lost)

    def _follow_up(self, fall: torch.Tensor, restart: torch.Tensor, commanded: torch.Tensor) -> None:
        """Ends of segments: falls, sub-commands that are over, targets reached or missed; and who starts again."""
        quiet = fall is self._nobody
        self._again = self._nobody
        settled = self._active & ~self._settling
        full = settled & (self._part_steps >= self._length)
        if not self._any_target:
            self._ended = full if quiet else full | fall
            return
        commands, state = self.suite.commands, self.backend.state
        offset = target_offset(state, self._target, commands.target_distance)
        near = torch.hypot(offset[:, 0], offset[:, 1]) < commands.target_radius
        going = commanded & self._aims
        if not quiet:
            going &= ~(fall | restart)
        over = (near | full) & going
        if commands.heading_frame != commands.target_distance:
            offset = target_offset(state, self._target, commands.heading_frame)
        self._towards = target_command(offset, self._backward, self._speed, self._limits[:, 2])
        ended = full & ~self._aims
        if self._cheap_checks and quiet and not bool((over | self._done).any()):
            self._ended = ended
            return
        over &= ~self._done
        self._reached |= over & near
        if self._rules.restarts:
            # a penetration while the robot settles once more can still undo it
            self._done &= ~restart
            self._reached &= ~restart
            self._ended = ended | fall | (self._done & settled & ~restart)
            self._done |= over
            self._again = over | restart
        else:
            self._ended = ended | fall | over
