"""The worlds in which segments are played: what is known of each, and one control step of all (gauge protocol §3.3).

On the CPU a look at the data is free, and saves the work that nobody needs. On a GPU it would wait for the device: there several
control steps run between two looks, and a slot whose segment has ended, or whose robot has to go back to its spawn, stands
still until the next one. Its steps are counted on the device, so that nothing depends on when somebody looks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch

from ..backends.base import PhysicsBackend, Randomization
from ..policy.base import Policy
from ..policy.observation import ObservationBuilder
from ..policy.steady import steady_session
from ..robots.geometry import total_mass
from .episodes import Episode
from .goals import LATERAL_SPEED, Schedule, target_command, target_offset
from .noise import NoiseReader, make_stream
from .recording import StepRecording
from .sampling import Samples, SampleTable
from .seats import Figures, Seats
from .segments import Segment, SegmentRules
from .suite import Suite

GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class Look:
    """What a look finds."""

    ended: list[int]
    """Slots whose segment has ended, in order."""
    not_finite: list[int]
    """Slots whose policy answered a finite observation with something else."""


class Slots:
    """K worlds of one backend, stepped together."""

    def __init__(self, suite: Suite, policy: Policy, backend: PhysicsBackend, *, looks: bool, capture: bool) -> None:
        """Prepare empty slots.

        Args:
            suite: the rules.
            policy: what is judged.
            backend: the worlds.
            looks: whether every control step may look at the data; without, ``look`` is the only call that does.
            capture: whether to record control steps as CUDA graphs (a CUDA device, and without looks).
        """
        self.suite, self.backend = suite, backend
        scene, k = backend.scene, backend.num_worlds
        self.count, self._robot, self._substeps = k, scene.robot, scene.physics.substeps
        device, dtype = backend.device, backend.dtype
        self._device, self._dtype, self._looks = device, dtype, looks
        if device.type == "cpu":
            self._session, self._few_rows_suffice = steady_session(policy, k)
        else:
            self._session, self._few_rows_suffice = policy.session(k, device=str(device)), False
        self._builder = ObservationBuilder(policy.contract, scene.robot, k, device)
        self._schedule = Schedule(suite, device, dtype)
        self.rules = SegmentRules(suite, self._schedule)
        self._stream = make_stream(suite.noise, scene.robot.num_joints, k, device)
        self._noise = NoiseReader(self._stream, k, device)
        self._table = SampleTable(suite, scene.robot, GRAVITY * total_mass(scene.robot), k, device, dtype)
        self.metrics = self._table.names
        commands = suite.commands
        fastest = max(commands.target_speed.values(), default=0.0)
        # velocity goals keep to the limits, and so does the way to the target unless the suite is an odd one
        self._must_clip = any(x < fastest or y < LATERAL_SPEED for x, y, _ in (commands.flat, commands.levelled))
        self._seats = Seats(suite, scene.robot, self._schedule, self.rules, k, device, dtype)
        # who is at work
        self._taken: set[int] = set()
        self._back: set[int] = set()  # slots whose robots go to their spawn before the next step
        self._changed = False
        self._fitted: list[tuple[float, float] | None] = [None] * k
        self._terrain = torch.zeros(k, device=device, dtype=torch.int64)
        self._rows_to_play: torch.Tensor | None = None
        self._any_target, self._any_sampled = not looks, not looks
        # what a control step is about
        self._nobody, self._nothing = torch.zeros_like(self._seats.active), torch.zeros_like(self._seats.tick)
        self._whole_step = self._nothing
        self._action = torch.zeros_like(self._seats.last_action)
        self._refused = False
        self._world_steps = torch.zeros(1, device=device, dtype=torch.int64)
        self.physics_steps = 0
        """Physics steps up to the last look, added up over worlds."""
        self._recording = StepRecording(enabled=capture and not looks and device.type == "cuda")

    # ---- segments come and go -------------------------------------------------------------------------------------

    def seat(self, slots: list[int], segments: Sequence[Segment], terrain_index: Sequence[int]) -> None:
        """Let segments begin in free slots, on the given terrains of the scene's palette."""
        self._seats.write(slots, segments, [self.backend.scene.terrains[i] for i in terrain_index])
        at = torch.tensor(slots, device=self._device)
        self._terrain[at] = torch.tensor(terrain_index, device=self._device)
        sampled = [self.rules.most_steps(s) for s in segments if s.episode.stage == "eval"]
        if sampled:
            self._table.reserve(math.ceil((max(sampled) + 2) * self._substeps / self.suite.metrics.interval) + 2)
        self._table.clear(self._seats.mask(slots))
        episodes = [s.episode for s in segments]
        self._fit(slots, episodes)
        starts = [self.rules.noise_start(s) for s in segments]
        most = max(self.rules.most_steps(s) for s in segments)
        if self._looks:
            self._noise.begin(slots, episodes, starts, most)
        else:
            for slot, episode, start in zip(slots, episodes, starts, strict=True):
                self._stream.assign(slot, episode, start + most)
        self._taken.update(slots)
        self._back.update(slots)
        self._changed = True

    def leave(self, slots: Sequence[int]) -> None:
        """Empty slots."""
        self._seats.leave(slots)
        self._taken.difference_update(slots)
        self._back.difference_update(slots)
        self._changed = True

    def begin(self, *, targets: bool) -> None:
        """Put robots to their spawn, and work out what depends on who is seated.

        Args:
            targets: whether any segment in a slot aims at a target.
        """
        seats = self._seats
        if not self._changed and not self._back:
            return
        mask = seats.mask(sorted(self._back))
        seats.active |= mask
        if self._looks and self._changed:
            self._any_target, self._any_sampled = targets, bool((seats.sampled & seats.active).any())
            self._whole_step = seats.active * self._substeps
            self._rows_to_play = self._rows()
        self._changed = False
        if self._back:
            self._reset(mask)
            self.physics_steps += len(self._back)
            self._back.clear()

    def _rows(self) -> torch.Tensor | None:
        """Slots that need an action, filled up to a multiple of eight; None for all."""
        count = (len(self._taken) + 7) // 8 * 8
        if not self._few_rows_suffice or count >= self.count:
            return None
        free = [slot for slot in range(self.count) if slot not in self._taken]
        return torch.tensor((sorted(self._taken) + free)[:count], device=self._device)

    def _fit(self, slots: list[int], episodes: Sequence[Episode]) -> None:
        """Give worlds the friction and payload of their episodes, where they have others."""
        wanted = {
            slot: (e.friction, e.payload)
            for slot, e in zip(slots, episodes, strict=True)
            if self._fitted[slot] != (e.friction, e.payload)
        }
        if not wanted:
            return
        mask = self._seats.mask(list(wanted))
        values = torch.tensor([wanted[s] for s in sorted(wanted)], device=self._device, dtype=self._dtype)
        # a mass changes constants that an engine has to work out anew
        fitted = [self._fitted[slot] for slot in wanted]
        heavier = any(old is None or old[1] != new[1] for old, new in zip(fitted, wanted.values(), strict=True))
        change = Randomization(friction=values[:, 0], base_mass_offset=values[:, 1] if heavier else None)
        self.backend.randomize(change, mask)
        for slot, pair in wanted.items():
            self._fitted[slot] = pair

    def _reset(self, mask: torch.Tensor) -> None:
        """Put worlds back to their spawn, (K,) bool; the robot hangs limp for one physics step, then settles."""
        seats = self._seats
        self.backend.reset(mask, base_position=seats.spawn, base_quaternion=seats.heading, terrain_index=self._terrain)
        self.backend.step(None, worlds=mask, substeps=1)
        self._builder.reset(mask)
        self._session.reset(mask)
        seats.last_action.masked_fill_(mask[:, None], 0.0)
        self._table.forget_torque(mask)
        seats.settling |= mask
        seats.part_steps.masked_fill_(mask, 0)
        seats.steps += mask
        if self.suite.metrics.clock == "run":
            seats.tick += mask
        else:
            seats.tick.masked_fill_(mask, 0)

    # ---- looking --------------------------------------------------------------------------------------------------

    def look(self) -> Look:
        """See what the control steps since the last look brought; robots that start again go back before the next step."""
        seats = self._seats
        if self._looks and not self._refused and not bool((seats.ended | seats.again).any()):
            return Look(ended=[], not_finite=[])
        kinds = seats.ended + 2 * seats.again + 4 * seats.bad
        *found, steps = torch.cat((kinds, self._world_steps)).tolist()
        seats.ended.zero_()
        seats.again.zero_()
        self._world_steps.zero_()
        self.physics_steps += steps * self._substeps
        self._back.update(slot for slot, kind in enumerate(found) if kind & 2)
        return Look(
            ended=[slot for slot, kind in enumerate(found) if kind & 1],
            not_finite=[slot for slot, kind in enumerate(found) if kind & 4],
        )

    def figures(self, slots: Sequence[int]) -> list[tuple[Figures, Samples | None]]:
        """What some slots counted and sampled, None for no samples; they must not have been seated anew."""
        figures = self._seats.figures(slots, self._table.count)
        sampled = {slot: f.samples for slot, f in zip(slots, figures, strict=True) if f.samples}
        samples: dict[int, Samples] = {}
        if sampled:
            limits, friction = self._seats.limits, self._seats.friction
            tables = self._table.read(list(sampled), list(sampled.values()), limits, friction)
            samples = dict(zip(sampled, tables, strict=True))
        return [(f, samples.get(slot)) for slot, f in zip(slots, figures, strict=True)]

    def blame(self, slot: int) -> tuple[float, int]:
        """What the policy answered in a slot that ``Look.not_finite`` lists, and after how many control steps."""
        seats = self._seats
        action = seats.last_action[slot]
        return float(action[~torch.isfinite(action)][0]), int(seats.played[slot])

    # ---- one control step -----------------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Take control steps: command, observation, action, physics, samples, events."""
        seats, recording = self._seats, self._recording
        if recording.enabled:
            recording.prepare(self._tables())
        for _ in range(steps):
            recording.run(self._observe)
            # a recorded observation is overwritten by the next one, and a policy may keep what it is given
            seen = self._observation.clone() if recording.enabled else self._observation
            action = self._session.act(seen, self._rows_to_play)
            if recording.enabled:
                self._action.copy_(action)
            else:
                self._action = action
            recording.run(self._decide)
            if self._refused:
                return
            everyone = self._looks and len(self._taken) == self.count
            self.backend.step(
                self._targets, delay=self._delay, sample_at=self._sample_at, worlds=None if everyone else seats.active
            )
            recording.run(self._judge)
        if self._looks:
            self.physics_steps += steps * len(self._taken) * self._substeps

    def _tables(self) -> tuple[torch.Tensor, ...]:
        """Memory that a recorded step uses and that somebody else may move."""
        states = (self.backend.state, self.backend.sample)
        tensors = [getattr(state, field.name) for state in states for field in fields(state)]
        return (*tensors, *self._stream.tables, self._table.rows)

    def _observe(self) -> None:
        """Who is commanded what, and what the policies see."""
        seats = self._seats
        active = seats.active
        self._leaving = self._find_leaving()
        commanded = active & ~seats.settling
        seats.part_steps += commanded
        command = clipped = self._schedule.commands(seats.first_row + seats.part_steps, seats.limits)
        if self._any_target:
            command = clipped = torch.where((seats.aims & commanded)[:, None], seats.towards, command)
            if self._must_clip:
                clipped = torch.clamp(command, -seats.limits, seats.limits)
        noise, self._delay = self._noise.next() if self._looks else self._stream.draw(seats.noise_start + seats.played)
        self._observation = self._builder.build(self.backend.state, clipped, seats.last_action, noise)
        self._commanded, self._command = commanded, command

    def _find_leaving(self) -> torch.Tensor:
        """Which slots end settling with this step."""
        seats = self._seats
        settling, settle = seats.settling & seats.active, self.suite.settling
        if self._looks and not bool(settling.any()):
            return self._nobody
        state = self.backend.state
        speed = torch.linalg.vector_norm(state.base_linear_velocity_w, dim=1)
        still = (speed < settle.speed) & (state.time > settle.shortest)
        return settling & (still | (state.time > settle.longest))

    def _decide(self) -> None:
        """Take the policies' actions, and plan the samples."""
        seats = self._seats
        self._check_action()
        if self._refused:
            return
        seats.played += seats.active
        self._due, self._sample_at = self._nobody, self._nothing
        if self._any_sampled:
            interval = self.suite.metrics.interval
            ahead = interval - seats.tick % interval
            self._due = seats.active & seats.sampled & (ahead <= self._substeps)
            self._sample_at = ahead * self._due
        self._targets = self._builder.targets(self._action)

    def _check_action(self) -> None:
        """A policy must answer finite observations with finite actions; a slot in which it does not stands still."""
        seats = self._seats
        action = self._action
        if self._looks:
            seats.last_action = action
            if math.isfinite(float(action.sum())):  # the sum of anything that is not finite is not finite
                return
        refused = seats.active & ~torch.isfinite(action).all(1) & torch.isfinite(self._observation).all(1)
        if self._looks:
            seats.bad, self._refused = refused, bool(refused.any())
            return
        seats.last_action.copy_(torch.where(seats.bad[:, None], seats.last_action, action))
        seats.bad |= refused
        seats.active &= ~refused
        self._world_steps += seats.active.sum()

    def _judge(self) -> None:
        """What came of the step: events, samples, ends."""
        seats = self._seats
        state, active, due, commanded = self.backend.state, seats.active, self._due, self._commanded
        fall, restart, ran = self._events(due, self._sample_at)
        seats.tick += ran
        seats.steps += ran
        if self._any_sampled and fall is not self._nobody:
            due = due & (self._sample_at <= ran)
        if not self._looks or (self._any_sampled and bool(due.any())):
            keep = due if self.suite.settling.sampled else due & commanded
            self._table.write(self.backend.sample, due, keep, self._command)
        if self._any_sampled:
            self._table.end_step(state, active)
        if fall is not self._nobody:
            self._fall(fall, commanded, ran)
        if self._leaving is not self._nobody:
            seats.settling &= ~self._leaving
        again, ended = self._follow_up(fall, restart, commanded)
        if self._looks:
            seats.again, seats.ended = again, ended
            return
        seats.again |= again
        seats.ended |= ended
        seats.active &= ~(again | ended)

    def _events(self, due: torch.Tensor, sample_at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What happened in the step: falls, penetrations that make a target goal start again, and the number of substeps
        until then, (K,) each. The first penetration of a velocity goal's segment interrupts nothing and is remembered.
        """
        seats = self._seats
        state, last, active = self.backend.state, self._substeps, seats.active
        deepens = self.rules.restarts
        if self._looks and not self.backend.eventful:
            return self._nobody, self._nobody, self._whole_step
        if self._looks:
            trouble = state.tilt_substep + state.diverged + state.overflowed
            if deepens:
                trouble += state.penetration_substep * seats.watched
            if len(self._taken) < self.count:  # worlds without a robot keep what happened to their last one
                trouble *= active
            if not bool(trouble.any()):
                return self._nobody, self._nobody, self._whole_step
        never = torch.full_like(state.tilt_substep, last + 1)
        fell_at = torch.where(state.tilt_substep > 0, state.tilt_substep, never)
        # at which substep the state became invalid is not known: nothing of this control step counts
        fell_at = torch.where(state.diverged, torch.zeros_like(fell_at), fell_at)
        seats.diverged |= state.diverged & active
        seats.overflowed |= state.overflowed & active
        deep_at = never
        if deepens:
            deep_at = torch.where((state.penetration_substep > 0) & seats.watched, state.penetration_substep, never)
        deep = active & (deep_at < fell_at)
        restart = deep & seats.aims
        fall = active & (fell_at <= last) & ~restart
        if deepens:
            seen = self._table.count + (due & (sample_at <= deep_at))
            for kept, now in (
                (seats.deep_control, seats.played),
                (seats.deep_steps, seats.steps + deep_at),
                (seats.deep_count, seen),
                (seats.deep_overflowed, seats.overflowed),
            ):
                kept.copy_(torch.where(deep, now, kept))
            seats.deep |= deep
            seats.watched &= ~deep
        ran = torch.minimum(torch.where(restart, deep_at, fell_at), never - 1) * active
        return fall, restart, ran

    def _fall(self, fall: torch.Tensor, commanded: torch.Tensor, ran: torch.Tensor) -> None:
        """Count falls; where they cost the rest of the sub-command, work out how many samples that is."""
        seats = self._seats
        seats.falls += fall
        if self.rules.fall_closes_goal:
            return
        # a fall while settling costs the whole sub-command that would have followed
        begun = torch.where(commanded, seats.part_steps - 1, self._nothing)
        step_began = torch.where(commanded, seats.tick - ran, seats.tick)
        part_ends = step_began + (seats.length - begun) * self._substeps
        interval = self.suite.metrics.interval
        lost = part_ends // interval - seats.tick // interval
        seats.lost.copy_(torch.where(fall & seats.sampled & ~seats.aims, lost, seats.lost))

    def _follow_up(
        self, fall: torch.Tensor, restart: torch.Tensor, commanded: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Who starts again, and whose segment has ended: falls, sub-commands that are over, targets reached or missed."""
        seats = self._seats
        quiet = fall is self._nobody
        settled = seats.active & ~seats.settling
        full = settled & (seats.part_steps >= seats.length)
        if not self._any_target:
            return self._nobody, full if quiet else full | fall
        commands, state = self.suite.commands, self.backend.state
        offset = target_offset(state, seats.target, commands.target_distance)
        near = torch.hypot(offset[:, 0], offset[:, 1]) < commands.target_radius
        going = commanded & seats.aims
        if not quiet:
            going &= ~(fall | restart)
        over = (near | full) & going
        if commands.heading_frame != commands.target_distance:
            offset = target_offset(state, seats.target, commands.heading_frame)
        seats.towards.copy_(target_command(offset, seats.backward, seats.speed, seats.limits[:, 2]))
        ended = full & ~seats.aims
        if self._looks and quiet and not bool((over | seats.done).any()):
            return self._nobody, ended
        over &= ~seats.done
        seats.reached |= over & near
        if not self.rules.restarts:
            return self._nobody, ended | fall | over
        # a penetration while the robot settles once more can still undo it
        seats.done &= ~restart
        seats.reached &= ~restart
        ended = ended | fall | (seats.done & settled & ~restart)
        seats.done |= over
        return over | restart, ended
