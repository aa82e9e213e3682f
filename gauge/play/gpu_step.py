"""The control step on a device for which the host must not wait.

It works out everything for every world. A world stands still once its segment has ended, or once its robot has to go back to its
spawn, until the rollout polls. Control steps are counted on the device, so no result depends on when the rollout polls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import torch

from ...backends.base import PhysicsBackend
from ...policy.base import Policy
from ..episodes import Episode
from ..suite import Suite
from .control_step import ControlStep, Motion, Seen
from .recording import StepRecording
from .step_functions import advance, count_falls, end_settling, find_events, give_commands, lead_to_target


class GpuStep(ControlStep):
    """Take control steps without waiting for the device, as CUDA graphs where the device has them."""

    def __init__(self, suite: Suite, policy: Policy, backend: PhysicsBackend, *, capture: bool) -> None:
        """Prepare empty worlds; see ``ControlStep``. ``capture``: capture steps as CUDA graphs on a CUDA device."""
        super().__init__(suite, policy, backend, one_by_one=False)
        self._action = torch.zeros_like(self.buffers.action)
        self._recording = StepRecording(backend.device, enabled=capture and backend.device.type == "cuda")

    @property
    def captured(self) -> bool:
        """See ``ControlStep.captured``."""
        return self._recording.enabled

    def read_noise(self, worlds: Sequence[int], episodes: Sequence[Episode], starts: Sequence[int], steps: int) -> None:
        """See ``ControlStep.read_noise``."""
        for world, episode, start in zip(worlds, episodes, starts, strict=True):
            self.stream.assign(world, episode, start + steps)

    def run(self, steps: int) -> None:
        """See ``ControlStep.run``."""
        recording = self._recording
        if recording.enabled:
            recording.prepare(self._moving_memory())
        for _ in range(steps):
            seen = recording.run(self._observe)
            # a captured observation is overwritten by the next one, and a policy may keep what it is given
            answer = self.session.act(seen.observation.clone() if recording.enabled else seen.observation)
            motion = recording.run(self.act, seen, self._action.copy_(answer) if recording.enabled else answer)
            self.move(seen, motion)
            recording.run(self._judge, seen, motion)

    def _moving_memory(self) -> tuple[torch.Tensor, ...]:
        """Return the memory that a captured step uses and that may move."""
        states = (self.backend.state, self.backend.sample)
        tensors = [getattr(state, field.name) for state in states for field in fields(state)]
        return (*tensors, *self.stream.tables, self.samples.rows)

    def _observe(self) -> Seen:
        buffers = self.buffers
        command = give_commands(buffers, self.schedule, self.backend.state, self.suite.settling, aimed=True)
        noise, delay = self.stream.draw(buffers.noise_start + buffers.control_steps)
        return Seen(command, self.observe(command, noise, aimed=True), delay)

    def _judge(self, seen: Seen, motion: Motion) -> None:
        buffers, suite, rules, table, state = self.buffers, self.suite, self.rules, self.samples, self.backend.state
        command, interval, closes_goal = seen.command, suite.metrics.interval, rules.fall_closes_goal
        events = find_events(buffers, state, motion.plan, table.count, self.substeps, watches=rules.restarts)
        due, keep = advance(buffers, motion.plan, command, events, settling_counts=suite.settling.sampled)
        table.write(self.backend.sample, due, keep, command.velocity)
        table.end_step(state, buffers.active)
        count_falls(buffers, events, command.commanded, interval, self.substeps, closes_goal=closes_goal)
        settled, full = end_settling(buffers, command)
        ended = lead_to_target(
            buffers, state, suite.commands, command, events, settled, full, settles_again=rules.restarts
        )
        buffers.ended |= ended
        buffers.active &= ~(buffers.respawn | ended)
