"""One control step of all worlds of a rollout: observe, act, step, judge (gauge protocol §3.3).

On a CPU reading a value is free, and saves the work that no world needs: ``early_outs``. On a GPU it would wait for the device.
There everything is worked out for every world, and a world whose segment has ended, or whose robot has to go back to its
spawn, stands still until the rollout polls. Its steps are counted on the device, so that nothing depends on when that is.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import fields
from typing import NamedTuple

import torch

from ...backends.base import BackendError, PhysicsBackend, ResetState, unsupported
from ...policy.base import Policy
from ...policy.batch_invariance import steady_session
from ...policy.observation import ObservationBuilder
from ...robots.body_plan import total_mass
from ..episodes import Episode
from ..goals import LATERAL_SPEED, Schedule, target_command, target_offset
from ..suite import Suite
from .noise import NoiseReader, make_stream
from .pushes import sideways
from .recording import StepRecording
from .sampling import GRAVITY, SampleTable
from .segments import SegmentRules
from .world_buffers import WorldBuffers


class StepEvents(NamedTuple):
    """What happened in a control step, (K,) each."""

    fall: torch.Tensor
    """bool."""
    restart: torch.Tensor
    """Whether a penetration makes a target goal start again, bool."""
    substeps: torch.Tensor
    """Substeps until then, all of them where nothing happened, 0 where inactive."""


class ControlStep:
    """Everything that a control step works with."""

    def __init__(
        self, suite: Suite, policy: Policy, backend: PhysicsBackend, *, early_outs: bool, capture: bool
    ) -> None:
        """Prepare empty worlds.

        Args:
            early_outs: whether values may be read during a step; without, nothing in it waits for the device.
            capture: whether to capture steps as CUDA graphs (a CUDA device, and no early outs).

        Raises:
            BackendError: the engine cannot push robots, and the suite does.
        """
        if suite.push is not None and unsupported(["external_force"], backend.capabilities()):
            raise BackendError(
                f"suite '{suite.name}' pushes robots, and engine '{backend.name}' knows no external force; choose another engine "
                "(--backend), or a suite with push = false"
            )
        self.suite, self.backend, self.early_outs = suite, backend, early_outs
        scene, count = backend.scene, backend.num_worlds
        self.robot, self._substeps = scene.robot, scene.physics.substeps
        device, dtype = backend.device, backend.dtype
        if device.type == "cpu":
            self._session, self._few_rows_suffice = steady_session(policy, count)
        else:
            self._session, self._few_rows_suffice = policy.session(count, device=str(device)), False
        self._builder = ObservationBuilder(policy.contract, scene.robot, count, device)
        self.schedule = Schedule(suite, device, dtype)
        self.rules = SegmentRules(suite, self.schedule)
        self._stream = make_stream(suite.noise, scene.robot.num_joints, count, device)
        self._noise = NoiseReader(self._stream, count, device)
        weight = GRAVITY * total_mass(scene.robot)
        self.samples = SampleTable(suite, scene.robot, weight, count, device, dtype, one_by_one=early_outs)
        self.buffers = WorldBuffers.allocate(count, scene.robot.num_joints, device, dtype)
        commands = suite.commands
        fastest = max(commands.target_speed.values(), default=0.0)
        # velocity goals keep to the limits, and so does the way to the target unless the suite is an odd one
        self._must_clip = any(x < fastest or y < LATERAL_SPEED for x, y, _ in (commands.flat, commands.levelled))
        # which worlds are at work: as ``arrange`` says where that saves something, any of them elsewhere
        self._any_target = self._any_sampled = not early_outs
        self._everyone, self._count = False, 0
        self._pushing = False
        self._force: torch.Tensor | None = None
        self.refused = False
        """Whether an early out found that the policy's answer is not finite."""
        self._rows_to_play: torch.Tensor | None = None
        self._nothing = self._whole_step = torch.zeros_like(self.buffers.tick)
        self._action = torch.zeros_like(self.buffers.action)
        # control steps since they were asked for, added up over worlds: a plain number where values may be read
        self._world_steps = 0 if early_outs else torch.zeros(1, device=device, dtype=torch.int64)
        self.recording = StepRecording(device, enabled=capture and not early_outs and device.type == "cuda")

    # ---- between control steps ------------------------------------------------------------------------------------

    def read_noise(self, worlds: Sequence[int], episodes: Sequence[Episode], starts: Sequence[int], steps: int) -> None:
        """Let worlds read their episodes' noise from a place on, no more than so many control steps of it."""
        if self.early_outs:
            self._noise.begin(worlds, episodes, starts, steps)
            return
        for world, episode, start in zip(worlds, episodes, starts, strict=True):
            self._stream.assign(world, episode, start + steps)

    def arrange(self, at_work: Collection[int], *, targets: bool) -> None:
        """Work out what depends on the worlds that are at work, and on whether any of them aims at a target."""
        if not self.early_outs:
            return
        buffers, count = self.buffers, self.backend.num_worlds
        self._any_target, self._any_sampled = targets, bool((buffers.sampled & buffers.active).any())
        self._count = len(at_work)
        self._everyone, self._whole_step = self._count == count, buffers.active * self._substeps
        # rows that need an action, filled up to a multiple of eight
        self._rows_to_play, rows = None, (len(at_work) + 7) // 8 * 8
        if self._few_rows_suffice and rows < count:
            free = [world for world in range(count) if world not in at_work]
            self._rows_to_play = torch.tensor((sorted(at_work) + free)[:rows], device=self.backend.device)

    def take_world_steps(self) -> int:
        """Control steps since the last call, added up over worlds."""
        steps = int(self._world_steps)
        self._world_steps *= 0
        return steps

    def reset(self, mask: torch.Tensor) -> None:
        """Put worlds back to their spawn, (K,) bool; the robot hangs limp for one physics step, then settles."""
        buffers = self.buffers
        self.backend.reset(
            ResetState(
                base_position=buffers.spawn, base_quaternion=buffers.heading, terrain_index=buffers.terrain_index
            ),
            mask,
        )
        self.backend.step(None, worlds=mask, substeps=1)
        self._builder.reset(mask)
        self._session.reset(mask)
        buffers.action.masked_fill_(mask[:, None], 0.0)
        self.samples.forget_torque(mask)
        buffers.settling |= mask
        buffers.commanded_steps.masked_fill_(mask, 0)
        buffers.substeps += mask
        if self.suite.metrics.clock == "run":
            buffers.tick += mask
        else:
            buffers.tick.masked_fill_(mask, 0)

    # ---- one control step -----------------------------------------------------------------------------------------

    def run(self, steps: int) -> None:
        """Take control steps. With early outs, one in which the policy's answer is not finite ends before its physics."""
        buffers, recording = self.buffers, self.recording
        if recording.enabled:
            recording.prepare(self._moving_memory())
        for _ in range(steps):
            recording.run(self._observe)
            # a captured observation is overwritten by the next one, and a policy may keep what it is given
            seen = self._observation.clone() if recording.enabled else self._observation
            answer = self._session.act(seen, self._rows_to_play)
            if recording.enabled:
                self._action.copy_(answer)
            else:
                self._action = answer
            recording.run(self._act)
            if self.refused:
                return
            if self._force is not None:
                self.backend.apply_force(self._force)
            worlds = None if self._everyone else buffers.active
            self.backend.step(self._targets, delay=self._delay, sample_at=self._sample_at, worlds=worlds)
            recording.run(self._judge)

    def _moving_memory(self) -> tuple[torch.Tensor, ...]:
        """Memory that a captured step uses and that may move."""
        states = (self.backend.state, self.backend.sample)
        tensors = [getattr(state, field.name) for state in states for field in fields(state)]
        return (*tensors, *self._stream.tables, self.samples.rows)

    def _worth(self, mask: torch.Tensor) -> bool:
        """Whether something is to be worked out that matters to the masked worlds alone."""
        return not self.early_outs or bool(mask.any())

    def _observe(self) -> None:
        """What is commanded, and what the policy sees."""
        buffers = self.buffers
        settling = buffers.settling & buffers.active
        self._stands = self._find_standing(settling) if self._worth(settling) else None
        commanded = buffers.active & ~buffers.settling
        buffers.commanded_steps += commanded
        command = clipped = self.schedule.commands(buffers.first_row + buffers.commanded_steps, buffers.limits)
        if self._any_target:
            command = clipped = torch.where((buffers.aims & commanded)[:, None], buffers.target_command, command)
            if self._must_clip:
                clipped = torch.clamp(command, -buffers.limits, buffers.limits)
        if self.early_outs:
            noise, self._delay = self._noise.next()
        else:
            noise, self._delay = self._stream.draw(buffers.noise_start + buffers.control_steps)
        self._observation = self._builder.build(self.backend.state, clipped, buffers.action, noise)
        self._commanded, self._command = commanded, command

    def _find_standing(self, settling: torch.Tensor) -> torch.Tensor:
        """Which of the settling robots stand, or have been waited for long enough: they settle in this step for the last time."""
        state, rules = self.backend.state, self.suite.settling
        speed = torch.linalg.vector_norm(state.base_linear_velocity_w, dim=1)
        still = (speed < rules.speed) & (state.time > rules.shortest)
        return settling & (still | (state.time > rules.longest))

    def _act(self) -> None:
        """Take the policy's actions, and plan the samples."""
        buffers = self.buffers
        self._check_action()
        if self.refused:
            return
        buffers.control_steps += buffers.active
        self._world_steps += self._count if self.early_outs else buffers.active.sum()
        self._due, self._sample_at = None, self._nothing
        if self._any_sampled:
            interval = self.suite.metrics.interval
            ahead = interval - buffers.tick % interval
            self._due = buffers.active & buffers.sampled & (ahead <= self._substeps)
            self._sample_at = ahead * self._due
        self._targets = self._builder.targets(self._action)
        if self.suite.push is not None:
            self._push()

    def _push(self) -> None:
        """The force on every base: that of a push on the robots whose time it is, zero on the others."""
        buffers, steps = self.buffers, self.buffers.commanded_steps
        pushed = self._commanded & (steps >= buffers.push_begin) & (steps < buffers.push_end)
        self._force = None
        if self.early_outs:
            before, self._pushing = self._pushing, bool(pushed.any())
            if not (before or self._pushing):
                return
        self._force = sideways(self.backend.state.base_quaternion_w, pushed * buffers.push_force)

    def _check_action(self) -> None:
        """A policy must answer finite observations with finite actions; a world in which it does not stands still."""
        buffers, action = self.buffers, self._action
        if self.early_outs and math.isfinite(
            float(action.sum())
        ):  # the sum of anything that is not finite is not finite
            buffers.action.copy_(action)
            return
        buffers.action.copy_(torch.where(buffers.not_finite[:, None], buffers.action, action))
        refused = buffers.active & ~torch.isfinite(action).all(1) & torch.isfinite(self._observation).all(1)
        buffers.not_finite |= refused
        buffers.active &= ~refused
        self.refused = self.early_outs and bool(refused.any())

    def _judge(self) -> None:
        """What came of the step: events, samples, ends."""
        buffers = self.buffers
        state, active, due, commanded = self.backend.state, buffers.active, self._due, self._commanded
        events = self._find_events(due)
        substeps = self._whole_step if events is None else events.substeps
        buffers.tick += substeps
        buffers.substeps += substeps
        if due is not None:
            if events is not None:
                due = due & (self._sample_at <= substeps)
            if self._worth(due):
                keep = due if self.suite.settling.sampled else due & commanded
                self.samples.write(self.backend.sample, due, keep, self._command)
            self.samples.end_step(state, active)
        if events is not None:
            self._count_falls(events, commanded)
        if self._stands is not None:
            buffers.settling &= ~self._stands
        settled = active & ~buffers.settling
        full = settled & (buffers.commanded_steps >= buffers.length)
        if self._any_target:
            respawn, ended = self._follow_target(events, commanded, settled, full)
        else:
            respawn, ended = None, full if events is None else full | events.fall
        buffers.ended |= ended
        if respawn is not None:
            buffers.respawn |= respawn
        if not self.early_outs:
            buffers.active &= ~(buffers.respawn | ended)

    def _find_events(self, due: torch.Tensor | None) -> StepEvents | None:
        """Falls, and penetrations that make a target goal start again; None where nothing happened.

        The first penetration of a velocity goal's segment interrupts nothing and is remembered.
        """
        buffers, state, last = self.buffers, self.backend.state, self._substeps
        active, watches = buffers.active, self.rules.restarts
        if self.early_outs:
            if not self.backend.eventful:
                return None
            trouble = state.tilt_substep + state.diverged + state.overflowed
            if watches:
                trouble += state.penetration_substep * buffers.watched
            if not self._everyone:  # worlds without a robot keep what happened to their last one
                trouble *= active
            if not bool(trouble.any()):
                return None
        never = torch.full_like(state.tilt_substep, last + 1)
        fell_at = torch.where(state.tilt_substep > 0, state.tilt_substep, never)
        # at which substep the state became invalid is not known: nothing of this control step counts
        fell_at = torch.where(state.diverged, torch.zeros_like(fell_at), fell_at)
        buffers.diverged |= state.diverged & active
        buffers.overflowed |= state.overflowed & active
        deep_at = never
        if watches:
            watched = (state.penetration_substep > 0) & buffers.watched
            deep_at = torch.where(watched, state.penetration_substep, never)
        deep = active & (deep_at < fell_at)
        restart = deep & buffers.aims
        fall = active & (fell_at <= last) & ~restart
        if watches:
            samples = self.samples.count
            if due is not None:
                samples = samples + (due & (self._sample_at <= deep_at))
            for kept, now in (
                (buffers.penetration_control_steps, buffers.control_steps),
                (buffers.penetration_substeps, buffers.substeps + deep_at),
                (buffers.penetration_samples, samples),
                (buffers.penetration_overflowed, buffers.overflowed),
            ):
                kept.copy_(torch.where(deep, now, kept))
            buffers.penetrated |= deep
            buffers.watched &= ~deep
        substeps = torch.minimum(torch.where(restart, deep_at, fell_at), never - 1) * active
        return StepEvents(fall, restart, substeps)

    def _count_falls(self, events: StepEvents, commanded: torch.Tensor) -> None:
        """Count falls; where they cost the rest of the sub-command, work out how many samples that is."""
        buffers = self.buffers
        buffers.falls += events.fall
        if self.rules.fall_closes_goal:
            return
        # a fall while settling costs the whole sub-command that would have followed
        begun = torch.where(commanded, buffers.commanded_steps - 1, self._nothing)
        step_began = torch.where(commanded, buffers.tick - events.substeps, buffers.tick)
        ends = step_began + (buffers.length - begun) * self._substeps
        interval = self.suite.metrics.interval
        lost = ends // interval - buffers.tick // interval
        costs = events.fall & buffers.sampled & ~buffers.aims
        buffers.lost_samples.copy_(torch.where(costs, lost, buffers.lost_samples))

    def _follow_target(
        self, events: StepEvents | None, commanded: torch.Tensor, settled: torch.Tensor, full: torch.Tensor
    ) -> tuple[torch.Tensor | None, torch.Tensor]:
        """Lead robots to their targets.

        Args:
            commanded: robots that were commanded in it, (K,) bool.
            settled: robots that are not settling any more.
            full: those of them whose sub-command, or time for the way, is over.

        Returns:
            Robots that go back to their spawn, None for none of them, and segments that have ended, (K,) bool.
        """
        buffers, commands, state = self.buffers, self.suite.commands, self.backend.state
        offset = target_offset(state, buffers.target, commands.target_distance)
        near = torch.hypot(offset[:, 0], offset[:, 1]) < commands.target_radius
        going = commanded & buffers.aims
        if events is not None:
            going &= ~(events.fall | events.restart)
        over = (near | full) & going
        if commands.heading_frame != commands.target_distance:
            offset = target_offset(state, buffers.target, commands.heading_frame)
        command = target_command(offset, buffers.backward, buffers.speed, buffers.limits[:, 2])
        buffers.target_command.copy_(command)
        ended = full & ~buffers.aims
        if events is None and not self._worth(over | buffers.done):
            return None, ended
        over &= ~buffers.done
        buffers.reached |= over & near
        if events is not None:
            ended = ended | events.fall
        if not self.rules.restarts:
            return None, ended | over
        restart = over
        if events is not None:  # a penetration while the robot settles once more can still undo it
            buffers.done &= ~events.restart
            buffers.reached &= ~events.restart
            settled = settled & ~events.restart
            restart = over | events.restart
        ended = ended | (buffers.done & settled)
        buffers.done |= over
        return restart, ended
