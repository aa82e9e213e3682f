"""The control step where reading a value is free: work that no world needs is left out."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ...backends.base import PhysicsBackend
from ...policy.base import Policy
from ..episodes import Episode
from ..suite import Suite
from .control_step import ControlStep, Seen
from .noise import NoiseReader
from .step_functions import Events, advance, count_falls, end_settling, find_events, give_commands, lead_to_target


class CpuStep(ControlStep):
    """Take a control step, after each of which the rollout polls."""

    def __init__(self, suite: Suite, policy: Policy, backend: PhysicsBackend) -> None:
        """Prepare empty worlds; see ``ControlStep``."""
        super().__init__(suite, policy, backend, one_by_one=True)
        self._noise = NoiseReader(self.stream, backend.num_worlds, backend.device)
        self.arrange()

    def read_noise(self, worlds: Sequence[int], episodes: Sequence[Episode], starts: Sequence[int], steps: int) -> None:
        """See ``ControlStep.read_noise``."""
        self._noise.begin(worlds, episodes, starts, steps)

    def arrange(self) -> None:
        """See ``ControlStep.arrange``."""
        active = self.buffers.active
        none = torch.zeros_like(active)
        self._no_events = Events(none, none, active * self.substeps)
        self._aimed = bool((self.buffers.aims & active).any())
        # rows that need an action, filled up to a multiple of eight
        rows = (int(active.sum()) + 7) // 8 * 8
        few = self.few_rows_suffice and rows < len(active)
        self._rows = torch.argsort(~active, stable=True)[:rows] if few else None

    def run(self, steps: int) -> None:
        """Take control steps up to one in which the policy's action is not finite; that one ends before its physics."""
        buffers, suite, rules, backend, table = self.buffers, self.suite, self.rules, self.backend, self.samples
        interval, aimed = suite.metrics.interval, self._aimed
        for _ in range(steps):
            command = give_commands(buffers, self.schedule, backend.state, suite.settling, aimed=aimed)
            noise, delay = self._noise.next()
            seen = Seen(command, self.observe(command, noise, aimed=aimed), delay)
            motion = self.act(seen, self.session.act(seen.observation, self._rows))
            if bool(buffers.not_finite.any()):
                return
            self.move(seen, motion)
            state, plan, events = backend.state, motion.plan, self._no_events
            happened = self._something_happened()
            if happened:
                events = find_events(buffers, state, plan, table.count, self.substeps, watches=rules.restarts)
            due, keep = advance(buffers, plan, command, events, settling_counts=suite.settling.sampled)
            if bool(due.any()):
                table.write(backend.sample, due, keep, command.velocity)
            table.end_step(state, buffers.active)
            if happened:
                count_falls(
                    buffers, events, command.commanded, interval, self.substeps, closes_goal=rules.fall_closes_goal
                )
            settled, full = end_settling(buffers, command)
            ended = full | events.fall
            if aimed:
                ended = lead_to_target(
                    buffers, state, suite.commands, command, events, settled, full, settles_again=rules.restarts
                )
            buffers.ended |= ended

    def _something_happened(self) -> bool:
        """Return whether the engine saw a fall, an error or a penetration that matters in an active world."""
        if not self.backend.eventful:
            return False
        state, buffers = self.backend.state, self.buffers
        trouble = state.tilt_substep + state.diverged + state.overflowed
        if self.rules.restarts:
            trouble = trouble + state.penetration_substep * buffers.watched
        return bool((trouble * buffers.active).any())
