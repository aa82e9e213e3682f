"""The two control steps of a rollout, for a CPU and for a GPU (gauge protocol §3.3): two lists of the same functions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import fields
from typing import NamedTuple

import torch

from ...backends.base import BackendError, PhysicsBackend, ResetState, Scene, unsupported
from ...policy.base import Policy
from ...policy.batch_invariance import steady_session
from ...policy.ground import Ground
from ...policy.observation import ObservationBuilder
from ...robots.anatomy.body_plan import total_mass
from ..episodes import Episode
from ..goals import LATERAL_SPEED, Schedule
from ..suite import Suite
from .noise import NoiseReader, make_stream
from .recording import StepRecording
from .sampling import GRAVITY, SampleTable
from .segments import SegmentRules
from .step_functions import (
    Events,
    SamplePlan,
    StepCommand,
    accept_action,
    advance,
    count_falls,
    end_segments,
    find_events,
    find_push,
    give_commands,
    plan_samples,
)
from .world_buffers import WorldBuffers


class Seen(NamedTuple):
    """The policy's input in a control step."""

    command: StepCommand
    observation: torch.Tensor
    """(K, W)."""
    delay: torch.Tensor
    """Delay of the action [substeps], (K,) int64."""


class Motion(NamedTuple):
    """The physics engine's input in a control step."""

    targets: torch.Tensor
    """Joint targets [rad], (K, J)."""
    force: torch.Tensor | None
    """Force on every base, world axes [N], (K, 3); None where the suite does not push."""
    plan: SamplePlan


def fixed_delay(scene: Scene, count: int, device: torch.device) -> torch.Tensor | None:
    """Return the substeps for which a measured robot's targets wait, (K,), in place of a drawn latency; None where not measured.

    Raises:
        BackendError: a delay is longer than a control period.
    """
    delay, physics = scene.parameters.delay, scene.physics
    if delay is None:
        return None
    substeps = round(delay / physics.timestep)
    if substeps > physics.substeps:
        longest = f"{1e3 * physics.control_period:g} ms"
        raise BackendError(
            f"the parameter set has a delay of {1e3 * delay:.1f} ms; a control period, {longest}, is the most"
        )
    return torch.full((count,), substeps, dtype=torch.int64, device=device)


class ControlStep(ABC):
    """Take control steps of all worlds of a rollout: observe, act, step, judge. The tensors of a step go from function to function."""

    def __init__(self, suite: Suite, policy: Policy, backend: PhysicsBackend, *, one_by_one: bool) -> None:
        """Prepare empty worlds, ``one_by_one`` as for ``SampleTable``; ``BackendError``: the suite pushes robots, the engine cannot."""
        if suite.push is not None and unsupported(["external_force"], backend.capabilities()):
            raise BackendError(
                f"suite '{suite.name}' pushes robots, and engine '{backend.name}' knows no external force; choose another engine "
                "(--backend), or a suite with push = false"
            )
        self.suite, self.backend = suite, backend
        scene, count, device, dtype = backend.scene, backend.num_worlds, backend.device, backend.dtype
        self.substeps = scene.physics.substeps
        self._delay = fixed_delay(scene, count, device)
        if device.type == "cpu":
            self.session, self.few_rows_suffice = steady_session(policy, count)
        else:
            self.session, self.few_rows_suffice = policy.session(count, device=str(device)), False
        self.buffers = WorldBuffers.allocate(count, policy.contract.num_joints, device, dtype)
        contract, noise = policy.contract, suite.noise
        maps = {"cell": noise.map_cell, "delay": noise.map_delay}
        ground = Ground.of(contract, scene.terrains, self.buffers.terrain_index, **maps)
        self.builder = ObservationBuilder(contract, scene.robot, count, device, ground)
        self.schedule = Schedule(suite, device, dtype)
        self.rules = SegmentRules(suite, self.schedule)
        self.stream = make_stream(noise, scene.robot.num_joints, count, device, scan=contract.scan_points)
        weight = GRAVITY * total_mass(scene.robot)
        self.samples = SampleTable(suite, scene.robot, weight, backend.state, one_by_one=one_by_one)
        commands = suite.commands
        fastest = max(commands.target_speed.values(), default=0.0)
        # velocity goals keep to the limits, and so does the way to the target unless the suite is an odd one
        self._must_clip = any(x < fastest or y < LATERAL_SPEED for x, y, _ in (commands.flat, commands.levelled))
        self._world_steps = torch.zeros(1, device=device, dtype=torch.int64)

    @property
    def captured(self) -> bool:
        """Return whether parts of the steps are captured as CUDA graphs, or will be."""
        return False

    @abstractmethod
    def run(self, steps: int) -> None:
        """Take control steps."""

    @abstractmethod
    def read_noise(self, worlds: Sequence[int], episodes: Sequence[Episode], starts: Sequence[int], steps: int) -> None:
        """Let worlds read their episodes' noise from control step ``starts`` on, no more than ``steps`` of it."""

    def arrange(self) -> None:  # noqa: B027  (a step that does the same in every world has nothing to arrange)
        """Work out the values that depend on which worlds are active and which of them aim at a target."""

    def take_world_steps(self) -> int:
        """Return the control steps since the last call, added up over worlds."""
        steps = int(self._world_steps)
        self._world_steps.zero_()
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
        self.builder.reset(mask)
        self.session.reset(mask)
        buffers.action.masked_fill_(mask[:, None], 0.0)
        self.samples.forget_torque(mask)
        buffers.settling |= mask
        buffers.commanded_steps.masked_fill_(mask, 0)
        buffers.substeps += mask
        if self.suite.metrics.clock == "run":
            buffers.tick += mask
        else:
            buffers.tick.masked_fill_(mask, 0)

    def observe(self, command: StepCommand, noise: dict[str, torch.Tensor], *, aimed: bool) -> torch.Tensor:
        """Return the observations, (K, W); ``noise`` by observation term, ``aimed``: any robot may aim at a target."""
        told, limits = command.velocity, self.buffers.limits
        if aimed and self._must_clip:
            told = torch.clamp(told, -limits, limits)
        return self.builder.build(self.backend.state, told, self.buffers.action, noise)

    def act(self, seen: Seen, action: torch.Tensor, *, pushed: bool = True) -> Motion:
        """Return the engine's input for the policy's action, (K, J). An action that is not finite makes its world inactive.

        ``pushed``: any active world may have a push.
        """
        buffers, suite = self.buffers, self.suite
        accept_action(buffers, action, seen.observation)
        self._world_steps += buffers.active.sum()
        plan = plan_samples(buffers, suite.metrics.interval, self.substeps)
        targets = self.builder.targets(action)
        force = None
        if pushed and suite.push is not None:
            force = find_push(buffers, self.backend.state, seen.command.commanded)
            force = force if self.samples.push_scale == 1.0 else force * self.samples.push_scale
        return Motion(targets, force, plan)

    def move(self, seen: Seen, motion: Motion) -> None:
        """Let the engine take the step in the active worlds."""
        if motion.force is not None:
            self.backend.apply_force(motion.force)
        delay = seen.delay if self._delay is None else self._delay
        self.backend.step(motion.targets, delay=delay, sample_at=motion.plan.at, worlds=self.buffers.active)


class CpuStep(ControlStep):
    """Take control steps where reading a value is free, and leave out work that no world needs. The rollout polls after each."""

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
        self._pushed = bool((self.buffers.push_end * active).any())
        # rows that need an action, filled up to a multiple of eight
        rows = (int(active.sum()) + 7) // 8 * 8
        few = self.few_rows_suffice and rows < len(active)
        self._rows = torch.argsort(~active, stable=True)[:rows] if few else None

    def run(self, steps: int) -> None:
        """Take control steps up to one in which the policy's action is not finite; that one ends before its physics."""
        buffers, suite, backend, table, aimed = self.buffers, self.suite, self.backend, self.samples, self._aimed
        for _ in range(steps):
            command = give_commands(buffers, backend.state, suite, self.schedule, aimed=aimed)
            noise, delay = self._noise.next()
            seen = Seen(command, self.observe(command, noise, aimed=aimed), delay)
            motion = self.act(seen, self.session.act(seen.observation, self._rows), pushed=self._pushed)
            if bool(buffers.not_finite.any()):
                return
            self.move(seen, motion)
            state, plan, happened = backend.state, motion.plan, self._something_happened()
            events = self._no_events
            if happened:
                events = find_events(buffers, state, plan, table.count, suite, self.substeps)
            due, keep = advance(buffers, plan, command, events, suite)
            if bool(due.any()):
                table.write(backend.sample, due, keep, command.velocity)
            table.end_step(state, buffers.active)
            if happened:
                count_falls(buffers, command, events, suite, self.substeps)
            end_segments(buffers, state, command, events, suite, aimed=aimed)

    def _something_happened(self) -> bool:
        """Return whether the engine saw a fall, an error or a penetration that matters in an active world."""
        if not self.backend.eventful:
            return False
        state, buffers = self.backend.state, self.buffers
        trouble = state.tilt_substep + state.diverged + state.overflowed
        if self.rules.restarts:
            trouble = trouble + state.penetration_substep * buffers.watched
        return bool((trouble * buffers.active).any())


class GpuStep(ControlStep):
    """Take control steps without waiting for the device, as CUDA graphs where the device has them.

    Everything is worked out for every world. A world stands still once its segment has ended, or once its robot has to go back to
    its spawn, until the rollout polls. Control steps are counted on the device, so no result depends on when the rollout polls.
    """

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
        command = give_commands(buffers, self.backend.state, self.suite, self.schedule, aimed=True)
        noise, delay = self.stream.draw(buffers.noise_start + buffers.control_steps)
        return Seen(command, self.observe(command, noise, aimed=True), delay)

    def _judge(self, seen: Seen, motion: Motion) -> None:
        buffers, suite, table, command, plan = self.buffers, self.suite, self.samples, seen.command, motion.plan
        state = self.backend.state
        events = find_events(buffers, state, plan, table.count, suite, self.substeps)
        due, keep = advance(buffers, plan, command, events, suite)
        table.write(self.backend.sample, due, keep, command.velocity)
        table.end_step(state, buffers.active)
        count_falls(buffers, command, events, suite, self.substeps)
        end_segments(buffers, state, command, events, suite, aimed=True)
        buffers.active &= ~(buffers.respawn | buffers.ended)
