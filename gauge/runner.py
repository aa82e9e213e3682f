"""Runs a list of episodes in lock step on any backend: the loop of gauge protocol §3.3, vectorized over worlds.

A world is a slot. When its episode ends, the next one of the list moves in, with its own terrain, friction and payload. What
happens in an episode depends on that episode alone: not on its slot, its neighbours, or the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch

from ..backends.base import PhysicsBackend, PhysicsState, Randomization
from ..policy.base import Policy, PolicyError
from ..policy.observation import ObservationBuilder
from ..robots.geometry import total_mass
from ..robots.rotation import from_yaw
from .episodes import QUALITY, Episode, Record
from .goals import GoalTable, target_command, target_offset
from .metrics import MetricEvaluator
from .noise import make_stream
from .suite import Suite

GRAVITY = 9.81


class Agenda(Protocol):
    """Who says which episodes run next."""

    def take(self, most: int) -> Sequence[Episode]:
        """Up to ``most`` episodes that can start now."""

    def finished(self, record: Record) -> None:
        """An episode has ended."""


@dataclass
class Progress:
    """How far the runner is; handed to the ``watch`` callback after every control step."""

    active: tuple[Episode, ...]
    ages: tuple[int, ...]
    """Control steps that each active episode has behind it."""
    control_steps: int
    physics_steps: int


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
        self._session = policy.session(k, device=str(device))
        self._builder = ObservationBuilder(policy.contract, scene.robot, k, device)
        self._goals = GoalTable(suite, device, dtype)
        self._stream = make_stream(suite.noise, scene.robot.num_joints, k, device)
        weight = GRAVITY * total_mass(scene.robot)
        self._metrics = MetricEvaluator(suite.metrics, scene.robot, weight, device, dtype)
        self.columns = (*self._metrics.names, QUALITY)

        def zeros(*shape: int, kind: torch.dtype = dtype) -> torch.Tensor:
            return torch.zeros(k, *shape, device=device, dtype=kind)

        whole, truth, joints = torch.int64, torch.bool, scene.robot.num_joints
        self._rows = torch.arange(k, device=device)
        self._episode: list[Episode | None] = [None] * k
        self._seated_at = [0] * k
        self._active, self._ended = zeros(kind=truth), zeros(kind=truth)
        # what does not change during an episode
        self._spawn, self._heading = zeros(3), zeros(4)
        self._target, self._backward = zeros(3), zeros(kind=truth)
        self._limits, self._speed, self._most_steps = zeros(3) + 1.0, zeros(), zeros(kind=whole)
        self._friction, self._terrain = zeros() + 1.0, zeros(kind=whole)
        self._sequence, self._num_goals = zeros(len(suite.goals), kind=whole), zeros(kind=whole)
        self._sampled = zeros(kind=truth)
        # how far it is
        self._goal_at, self._goal_time = zeros(kind=whole), zeros(kind=torch.float64)
        self._part, self._part_steps, self._settling = zeros(kind=whole), zeros(kind=whole), zeros(kind=truth)
        self._tick, self._draws, self._steps = zeros(kind=whole), zeros(kind=whole), zeros(kind=whole)
        self._done, self._reached, self._restarted = zeros(kind=truth), zeros(kind=truth), zeros(kind=truth)
        self._falls, self._diverged, self._overflowed = zeros(kind=whole), zeros(kind=truth), zeros(kind=truth)
        self._last_action = zeros(joints, kind=torch.float32)
        self._torque, self._torque_known = zeros(joints), zeros(kind=truth)
        # what was seen of it
        self.capacity = _most_samples(suite)
        self._values = zeros(self.capacity, len(self.columns), kind=torch.float32)
        self._where = zeros(self.capacity, 2, kind=torch.int16)
        self._count = zeros(kind=whole)
        self.control_steps = 0
        self.physics_steps = 0
        # on the CPU a look at the data is free, and saves the work that nobody needs; on a GPU it would wait for the device
        self._cheap_checks = device.type == "cpu"
        self._few_rows_suffice = self._cheap_checks and _rows_are_stable(policy, k)
        self._nobody = zeros(kind=truth)
        self._last_ran = zeros(kind=whole)

    # ---- episodes come and go -------------------------------------------------------------------------------------

    def run(self, agenda: Agenda, watch: Callable[[Progress], None] | None = None) -> None:
        """Play until the agenda has nothing left.

        Raises:
            PolicyError: the policy's output is not finite.
        """
        with torch.inference_mode():
            self._run(agenda, watch)

    def _run(self, agenda: Agenda, watch: Callable[[Progress], None] | None) -> None:
        while True:
            free = [s for s, e in enumerate(self._episode) if e is None]
            if free:
                episodes = agenda.take(len(free))
                self._seat(free[: len(episodes)], episodes)
                if len(free) == self._slots and not episodes:
                    return
            self._stream.reserve(self.control_steps - min(self._begun()) + 2)
            self._control_step()
            for record in self._collect():
                agenda.finished(record)
            if watch is not None:
                active = tuple(e for e in self._episode if e is not None)
                ages = tuple(self.control_steps - begun for begun in self._begun())
                watch(Progress(active, ages, self.control_steps, self.physics_steps))

    def _begun(self) -> list[int]:
        """The runner's control step at which each present episode began."""
        return [self._seated_at[s] for s, e in enumerate(self._episode) if e is not None]

    def _seat(self, slots: list[int], episodes: Sequence[Episode]) -> None:
        """Let episodes begin in free slots."""
        if not episodes:
            return
        suite, device = self.suite, self._device
        at = torch.tensor(slots, device=device)
        terrains = [self.backend.scene.terrains[self._terrain_index(e)] for e in episodes]
        poses = [
            t.spawns["level_eval" if e.stage == "eval" else "level_search"]
            for t, e in zip(terrains, episodes, strict=True)
        ]
        stand, times = self._robot.stand_height, suite.commands.target_time

        def write(into: torch.Tensor, values: list) -> None:
            into[at] = torch.tensor(values, device=device, dtype=into.dtype)

        write(self._spawn, [(p.position[0], p.position[1], p.position[2] + stand) for p in poses])
        self._heading[at] = from_yaw(torch.tensor([p.yaw for p in poses], device=device, dtype=self._dtype))
        write(self._target, [t.target or (0.0, 0.0, 0.0) for t in terrains])
        write(self._backward, [t.backward for t in terrains])
        write(self._limits, [suite.command_limits(t.family) for t in terrains])
        write(self._speed, [suite.commands.target_speed.get(t.family, 0.0) for t in terrains])
        write(self._most_steps, [round(times.get(t.family, 0.0) / self._goals.period) for t in terrains])
        write(self._friction, [e.friction for e in episodes])
        write(self._terrain, [self._terrain_index(e) for e in episodes])
        names = self._goals.names
        order = [[names.index(g) for g in names if g in e.goals] for e in episodes]
        write(self._sequence, [o + [0] * (len(names) - len(o)) for o in order])
        write(self._num_goals, [len(o) for o in order])
        write(self._sampled, [e.stage == "eval" for e in episodes])
        for counter in (self._goal_at, self._goal_time, self._part, self._tick, self._draws, self._steps):
            counter[at] = 0
        for counter in (self._done, self._reached, self._restarted, self._falls, self._diverged, self._overflowed):
            counter[at] = 0
        self._values[at] = 0.0
        self._count[at] = 0
        self._active[at] = True
        mask = torch.zeros(self._slots, dtype=torch.bool, device=device)
        mask[at] = True
        self.backend.randomize(
            Randomization(
                friction=torch.tensor([e.friction for e in episodes], device=device, dtype=self._dtype),
                base_mass_offset=torch.tensor([e.payload for e in episodes], device=device, dtype=self._dtype),
            ),
            mask,
        )
        for slot, episode in zip(slots, episodes, strict=True):
            self._stream.assign(slot, episode)
            self._episode[slot] = episode
            self._seated_at[slot] = self.control_steps
        self._reset(mask)

    def _collect(self) -> list[Record]:
        """Records of the episodes that have just ended; their slots are free afterwards."""
        if not bool(self._ended.any()):
            return []
        records = []
        for slot in torch.nonzero(self._ended).flatten().tolist():
            episode = self._episode[slot]
            assert episode is not None
            count = int(self._count[slot])
            where = self._where[slot, :count].cpu().numpy().copy()
            has_target = any(g == "target_pos_velocity" for g in episode.goals)
            records.append(
                Record(
                    episode=episode,
                    success=bool(self._reached[slot]) if has_target else None,
                    falls=int(self._falls[slot]),
                    diverged=bool(self._diverged[slot]),
                    overflowed=bool(self._overflowed[slot]),
                    restarted=bool(self._restarted[slot]),
                    control_steps=int(self._draws[slot]),
                    physics_steps=int(self._steps[slot]),
                    columns=self.columns if count else (),
                    samples=self._values[slot, :count].cpu().numpy().copy(),
                    goal_index=where[:, 0],
                    part_index=where[:, 1],
                )
            )
            self._episode[slot] = None
        self._active &= ~self._ended
        self._ended.zero_()
        return records

    def _reset(self, mask: torch.Tensor) -> None:
        """Put episodes back to their spawn; the robot hangs limp for one physics step, then settles."""
        if not bool(mask.any()):
            return
        self.backend.reset(mask, base_position=self._spawn, base_quaternion=self._heading, terrain_index=self._terrain)
        self.backend.step(None, worlds=mask, substeps=1)
        self._builder.reset(mask)
        self._session.reset(mask)
        self._last_action.masked_fill_(mask[:, None], 0.0)
        self._torque_known &= ~mask
        self._settling |= mask
        self._part_steps.masked_fill_(mask, 0)
        self._steps += mask
        if self.suite.metrics.clock == "run":
            self._tick += mask
        else:
            self._tick.masked_fill_(mask, 0)
        self.physics_steps += int(mask.sum())

    # ---- one control step -----------------------------------------------------------------------------------------

    def _control_step(self) -> None:
        """One turn of the loop for all slots: command, observation, action, physics, samples, events."""
        leaving, commanded, goal = self._advance_goals()
        active = self._active & ~self._ended
        state = self.backend.state
        command = self._command(state, goal, commanded)
        noise, delay = self._stream.draw(self._draws)
        clipped = torch.clamp(command, -self._limits, self._limits)
        observation = self._builder.build(state, clipped, self._last_action, noise)
        action = self._session.act(observation, self._rows_to_play(active))
        self._check_action(observation, action, active)
        self._last_action = action
        self._draws += active
        ahead = self.suite.metrics.interval - self._tick % self.suite.metrics.interval
        due = active & self._sampled & (ahead <= self._substeps)
        sample_at = torch.where(due, ahead, torch.zeros_like(ahead))
        everyone = not self._cheap_checks or bool(active.all())
        self.backend.step(
            self._builder.targets(action), delay=delay, sample_at=sample_at, worlds=None if everyone else active
        )
        self.control_steps += 1
        fall, penetration, ran = self._events(active)
        self._last_ran = ran
        self._tick += ran
        self._steps += ran
        due &= sample_at <= ran
        if not self._cheap_checks or bool(due.any()):
            self._take_samples(due, command, commanded)
        if self.suite.metrics.smoothness == "control-steps":
            self._torque.copy_(self.backend.state.joint_torque)
            self._torque_known |= active
        self._follow_up(fall, penetration, commanded, leaving, goal)

    def _advance_goals(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Move the goal clocks on, close goals that are over.

        Returns:
            Which slots end settling with this step, which are commanded by their goal, and the goal of each.
        """
        state, settle = self.backend.state, self.suite.settling
        settling = self._settling & self._active
        leaving = self._nobody
        if not self._cheap_checks or bool(settling.any()):
            speed = torch.linalg.vector_norm(state.base_linear_velocity_w, dim=1)
            still = (speed < settle.speed) & (state.time > settle.shortest)
            leaving = settling & (still | (state.time > settle.longest))
        commanded = self._active & ~settling
        self._goal_time += commanded.to(torch.float64) * self._goals.period
        goal = self._present_goal()
        over = commanded & torch.where(self._goals.is_target[goal], self._done, self._goals.over(goal, self._goal_time))
        if bool(over.any()):
            self._close_goal(over)
            self._reset(over & ~self._ended)
            commanded = commanded & ~over
            goal = self._present_goal()
        self._part_steps += commanded
        return leaving, commanded, goal

    def _rows_to_play(self, active: torch.Tensor) -> torch.Tensor | None:
        """Slots that need an action, filled up to a multiple of eight; None for all."""
        if not self._few_rows_suffice:
            return None
        order = torch.argsort((~active).to(torch.int8), stable=True)
        count = (int(active.sum()) + 7) // 8 * 8
        return order[:count] if count < self._slots else None

    def _present_goal(self) -> torch.Tensor:
        """Goal number of every slot, (K,)."""
        at = torch.clamp(self._goal_at, max=self._sequence.shape[1] - 1)
        return self._sequence[self._rows, at]

    def _close_goal(self, mask: torch.Tensor) -> None:
        """Go on to the next goal; an episode without one ends."""
        self._goal_at += mask
        self._goal_time.masked_fill_(mask, 0.0)
        self._part.masked_fill_(mask, 0)
        self._done &= ~mask
        self._ended |= mask & (self._goal_at >= self._num_goals)

    def _end_part(self, mask: torch.Tensor, goal: torch.Tensor) -> None:
        """Go on to the next sub-command of a velocity goal; a goal without one closes."""
        self._part += mask
        self._close_goal(mask & (self._part >= self._goals.parts[goal]))

    def _command(self, state: PhysicsState, goal: torch.Tensor, commanded: torch.Tensor) -> torch.Tensor:
        """What the goals command, (K, 3); zero while settling."""
        aims = self._goals.is_target[goal] & commanded
        if self._cheap_checks and torch.equal(aims, commanded):
            command = torch.zeros_like(self._limits)
        else:
            command = self._goals.velocity_command(goal, self._goal_time, self._limits)
        if not self._cheap_checks or bool(aims.any()):
            offset = target_offset(state, self._target, self.suite.commands.heading_frame)
            towards = target_command(offset, self._backward, self._speed, self._limits[:, 2])
            command = torch.where(aims[:, None], towards, command)
        return torch.where(commanded[:, None], command, torch.zeros_like(command))

    def _check_action(self, observation: torch.Tensor, action: torch.Tensor, active: torch.Tensor) -> None:
        """A policy must answer finite observations with finite actions."""
        finite = torch.isfinite(action)
        if bool(finite.all()):
            return
        bad = active & ~finite.all(1)
        if bool(bad.any()):
            bad &= torch.isfinite(observation).all(1)
            if bool(bad.any()):
                slot = int(torch.nonzero(bad)[0])
                raise PolicyError(
                    f"the policy returned {_first_bad(action[slot])} for a finite observation at control step "
                    f"{int(self._draws[slot])} of episode {_key(self._episode[slot])}; a policy must return finite numbers"
                )

    def _events(self, active: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What interrupted the step: falls, penetrations, and the number of substeps until then, (K,) each."""
        state, last = self.backend.state, self._substeps
        self.physics_steps += int(active.sum()) * last
        deepens = self.suite.events.penetration is not None
        if self._cheap_checks:
            calm = not (bool(state.tilt_substep.any()) or bool(state.diverged.any()) or bool(state.overflowed.any()))
            if calm and not (deepens and bool(state.penetration_substep.any())):
                return self._nobody, self._nobody, active * last
        never = torch.full_like(state.tilt_substep, last + 1)
        fell_at = torch.where(state.tilt_substep > 0, state.tilt_substep, never)
        # at which substep the state became invalid is not known: nothing of this control step counts
        fell_at = torch.where(state.diverged, torch.zeros_like(fell_at), fell_at)
        self._diverged |= state.diverged & active
        self._overflowed |= state.overflowed & active
        deep_at = never
        if deepens:
            deep = (state.penetration_substep > 0) & ~self._restarted
            deep_at = torch.where(deep, state.penetration_substep, never)
        fall = active & (fell_at <= last) & (fell_at <= deep_at)
        penetration = active & (deep_at <= last) & ~fall
        ran = torch.minimum(torch.minimum(fell_at, deep_at), never - 1) * active
        return fall, penetration, ran

    def _take_samples(self, due: torch.Tensor, command: torch.Tensor, commanded: torch.Tensor) -> None:
        """Write one row for every slot whose sample is due."""
        sample = self.backend.sample
        values = self._metrics.evaluate(sample, command, self._limits, self._friction, self._torque, self._torque_known)
        if self.suite.metrics.smoothness == "samples":
            self._torque = torch.where(due[:, None], sample.joint_torque, self._torque)
            self._torque_known |= due
        keep = due if self.suite.settling.sampled else due & commanded
        at = torch.clamp(self._count, max=self.capacity - 1)
        old = self._values[self._rows, at]
        self._values[self._rows, at] = torch.where(keep[:, None], values.to(torch.float32), old)
        where = torch.stack((self._goal_at, self._part), dim=1).to(torch.int16)
        self._where[self._rows, at] = torch.where(keep[:, None], where, self._where[self._rows, at])
        self._count += keep

    def _follow_up(
        self,
        fall: torch.Tensor,
        penetration: torch.Tensor,
        commanded: torch.Tensor,
        leaving: torch.Tensor,
        goal: torch.Tensor,
    ) -> None:
        """Ends of sub-commands, reached targets, falls and penetrations; then reset whom it concerns."""
        commands = self.suite.commands
        going = commanded & ~fall & ~penetration
        aims = self._goals.is_target[goal]
        back = going & ~aims & (self._part_steps >= self._goals.steps[goal])
        if not self._cheap_checks or bool(back.any()):
            self._end_part(back, goal)
        if not self._cheap_checks or bool((going & aims).any()):
            offset = target_offset(self.backend.state, self._target, commands.target_distance)
            near = torch.hypot(offset[:, 0], offset[:, 1]) < commands.target_radius
            reached = going & aims & near
            late = self._part_steps >= self._most_steps
            over = reached | (going & aims & late)
            self._reached |= reached
            if self.suite.events.penetration is None:
                self._close_goal(over)
            else:
                self._done |= over  # a penetration while the robot settles can still undo it
            back = back | over
        self._settling &= ~leaving
        if fall is not self._nobody and bool((fall | penetration).any()):
            self._interrupt(fall, penetration, commanded, goal)
            back = back | fall | penetration
        self._reset(back & ~self._ended)

    def _interrupt(
        self, fall: torch.Tensor, penetration: torch.Tensor, commanded: torch.Tensor, goal: torch.Tensor
    ) -> None:
        """Falls close the goal or cost the rest of the sub-command; a penetration starts the goal again."""
        self._falls += fall
        self._restarted |= penetration
        self._goal_time.masked_fill_(penetration, 0.0)
        self._part.masked_fill_(penetration, 0)
        again = penetration & self._goals.is_target[goal]
        self._done &= ~again
        self._reached &= ~again
        if self.suite.events.fall == "close-goal":
            self._close_goal(fall)
            return
        aims = self._goals.is_target[goal]
        self._close_goal(fall & aims)
        fall = fall & ~aims
        # as many zeros as there would have been samples; a fall while settling costs the whole sub-command that follows
        steps = torch.where(aims, torch.zeros_like(goal), self._goals.steps[goal])
        begun = torch.where(commanded, self._part_steps - 1, torch.zeros_like(steps))
        step_began = torch.where(commanded, self._tick - self._last_ran, self._tick)
        part_ends = step_began + (steps - begun) * self._substeps
        interval = self.suite.metrics.interval
        lost = (part_ends // interval - self._tick // interval) * fall * self._sampled
        row = torch.arange(self.capacity, device=self._device)
        blank = (row >= self._count[:, None]) & (row < (self._count + lost)[:, None])
        where = torch.stack((self._goal_at, self._part), dim=1).to(torch.int16)
        self._where = torch.where(blank[..., None], where[:, None], self._where)
        self._count += lost
        next_part = (self._part + 1) * torch.where(aims, torch.ones_like(self._goal_time), self._goals.duration[goal])
        self._goal_time = torch.where(fall, next_part, self._goal_time)
        self._end_part(fall, goal)


def _most_samples(suite: Suite) -> int:
    """Number of samples that no episode exceeds: every goal with the longest settling before each sub-command, twice over
    where a penetration may start a goal again.
    """
    seconds = max(suite.commands.target_time.values(), default=0.0) + 3.0 * suite.settling.longest
    parts = 1
    for goal in suite.goals:
        count = GoalTable.PARTS[goal.name] if goal.phases else 0
        parts += count
        seconds += count * (sum(goal.phases) + suite.settling.longest + 2.0 * suite.physics.control_period)
    repeats = 1 if suite.events.penetration is None else 2
    return repeats * (math.ceil(seconds / (suite.metrics.interval * suite.physics.timestep)) + 2 * parts)


def _rows_are_stable(policy: Policy, slots: int) -> bool:
    """Whether a policy answers to the last bit the same for an episode, however many others go through it with it.

    Matrix products may sum in another order for another number of rows. Only where a trial shows that they do not, is the
    policy run on fewer rows than there are slots.
    """
    width = policy.contract.observation_width
    generator = torch.Generator().manual_seed(0)
    observations = torch.randn(4, slots, width, generator=generator)
    for count in range(8, slots, 8):
        whole, part = policy.session(slots), policy.session(slots)
        for observation in observations:
            rows = torch.randperm(slots, generator=generator)[:count]
            if not torch.equal(whole.act(observation)[rows], part.act(observation, rows)[rows]):
                return False
    return True


def _first_bad(action: torch.Tensor) -> str:
    """The first entry that is not finite."""
    return str(float(action[~torch.isfinite(action)][0]))


def _key(episode: Episode | None) -> str:
    return episode.key if episode is not None else "?"
