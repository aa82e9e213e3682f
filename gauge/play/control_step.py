"""The base of the two control steps, for a CPU and for a GPU: all that both work with (gauge protocol §3.3).

Both are lists of the same functions (``step_functions.py``), which hand on values.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch

from ...backends.base import BackendError, PhysicsBackend, ResetState, unsupported
from ...policy.base import Policy
from ...policy.batch_invariance import steady_session
from ...policy.observation import ObservationBuilder
from ...robots.body_plan import total_mass
from ..episodes import Episode
from ..goals import LATERAL_SPEED, Schedule
from ..suite import Suite
from .noise import make_stream
from .sampling import GRAVITY, SampleTable
from .segments import SegmentRules
from .step_functions import SamplePlan, StepCommand, accept_action, find_push, plan_samples
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


class ControlStep(ABC):
    """Take control steps of all worlds of a rollout: observe, act, step, judge."""

    def __init__(self, suite: Suite, policy: Policy, backend: PhysicsBackend, *, one_by_one: bool) -> None:
        """Prepare empty worlds.

        Args:
            one_by_one: see ``SampleTable``.

        Raises:
            BackendError: the engine cannot push robots, and the suite does.
        """
        if suite.push is not None and unsupported(["external_force"], backend.capabilities()):
            raise BackendError(
                f"suite '{suite.name}' pushes robots, and engine '{backend.name}' knows no external force; choose another engine "
                "(--backend), or a suite with push = false"
            )
        self.suite, self.backend = suite, backend
        scene, count, device, dtype = backend.scene, backend.num_worlds, backend.device, backend.dtype
        self.substeps = scene.physics.substeps
        if device.type == "cpu":
            self.session, self.few_rows_suffice = steady_session(policy, count)
        else:
            self.session, self.few_rows_suffice = policy.session(count, device=str(device)), False
        self.builder = ObservationBuilder(policy.contract, scene.robot, count, device)
        self.schedule = Schedule(suite, device, dtype)
        self.rules = SegmentRules(suite, self.schedule)
        self.stream = make_stream(suite.noise, scene.robot.num_joints, count, device)
        weight = GRAVITY * total_mass(scene.robot)
        self.samples = SampleTable(suite, scene.robot, weight, count, device, dtype, one_by_one=one_by_one)
        self.buffers = WorldBuffers.allocate(count, scene.robot.num_joints, device, dtype)
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
        """Return the observations, (K, W); ``noise`` by observation term, ``aimed`` as for ``give_commands``."""
        told, limits = command.velocity, self.buffers.limits
        if aimed and self._must_clip:
            told = torch.clamp(told, -limits, limits)
        return self.builder.build(self.backend.state, told, self.buffers.action, noise)

    def act(self, seen: Seen, action: torch.Tensor) -> Motion:
        """Return what the engine gets for the policy's action, (K, J); ``accept_action`` tells what becomes of one that is not finite."""
        buffers, suite = self.buffers, self.suite
        accept_action(buffers, action, seen.observation)
        self._world_steps += buffers.active.sum()
        plan = plan_samples(buffers, suite.metrics.interval, self.substeps)
        targets = self.builder.targets(action)
        force = None if suite.push is None else find_push(buffers, self.backend.state, seen.command.commanded)
        return Motion(targets, force, plan)

    def move(self, seen: Seen, motion: Motion) -> None:
        """Let the engine take the step in the active worlds."""
        if motion.force is not None:
            self.backend.apply_force(motion.force)
        self.backend.step(motion.targets, delay=seen.delay, sample_at=motion.plan.at, worlds=self.buffers.active)
