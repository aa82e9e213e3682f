"""Robots of one policy side by side that are told at every control step what to do; an episode gives each its noise and latency.

The loop of what is no evaluation: field trials, looks inside a policy, and watching one. Observation, network, latency and noise
are those of the gauge's rollout; goals, settling and samples are the caller's affair.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import torch

from ..backends.base import PhysicsBackend, PhysicsState, ResetState
from ..gauge.episodes import Episode
from ..gauge.play.control_step import fixed_delay
from ..gauge.play.noise import NoiseReader, make_stream
from ..gauge.suite import Noise
from ..policy.base import Policy, PolicyError, PolicySession
from ..policy.batch_invariance import steady_session
from ..policy.ground import Ground
from ..policy.observation import ObservationBuilder


class Walk:
    """N robots at work. What a robot does depends on its episode and its commands alone, not on N, its place or threads."""

    def __init__(
        self,
        policy: Policy,
        backend: PhysicsBackend,
        noise: Noise | None = None,
        episodes: Sequence[Episode] = (),
        *,
        steps: int = 0,
        session: PolicySession | None = None,
        latency: Sequence[int | None] = (),
    ) -> None:
        """Prepare the robots; ``reset`` puts them to their start.

        Args:
            backend: one world for each robot.
            noise: how noisy and late everything is; None for nothing of it.
            episodes: with noise, one for each robot, whose stream of random numbers it has.
            steps: with noise, control steps that are not exceeded.
            session: the policy at work, where it is not to be an ordinary one.
            latency: physics steps by which each robot's actions take effect late; None, or none at all, for the noise's own.

        Raises:
            ContractError: the policy is not for this robot.
        """
        self.policy, self.backend = policy, backend
        count, device, robot = backend.num_worlds, backend.device, backend.scene.robot
        if session is None:
            on_cpu = device.type == "cpu"
            session = steady_session(policy, count)[0] if on_cpu else policy.session(count, device=str(device))
        self._session = session
        contract, maps = policy.contract, {} if noise is None else {"cell": noise.map_cell, "delay": noise.map_delay}
        where = torch.tensor(backend.scene.terrain_index, device=device)
        ground = Ground.of(contract, backend.scene.terrains, where, **maps)
        self._builder = ObservationBuilder(contract, robot, count, device, ground)
        self._noise: NoiseReader | None = None
        if noise is not None:
            stream = make_stream(noise, robot.num_joints, count, device, scan=contract.scan_points)
            self._noise = NoiseReader(stream, count, device)
            self._noise.begin(range(count), episodes, [0] * count, steps)
        self._action = torch.zeros(count, policy.contract.num_joints, device=device)
        self._measured = fixed_delay(backend.scene, count, device)
        self._latency: torch.Tensor | None = None
        if any(late is not None for late in latency):
            self._latency = torch.tensor([-1 if late is None else late for late in latency], device=device)
            self._targets: deque[torch.Tensor] = deque(maxlen=1 + int(self._latency.max()) // self._substeps)

    @property
    def _substeps(self) -> int:
        return self.backend.scene.physics.substeps

    @property
    def state(self) -> PhysicsState:
        """State of the worlds."""
        return self.backend.state

    def tensor(self, values: object) -> torch.Tensor:
        """Numbers as the physics has them."""
        return torch.tensor(values, device=self.backend.device, dtype=self.backend.dtype)

    def reset(self, position: torch.Tensor, quaternion: torch.Tensor) -> None:
        """Put all robots to base poses, (N, 3) and wxyz (N, 4), at rest in their standing pose, which the motors hold."""
        pose = self.tensor(self.backend.scene.robot.default_joint_position).expand(len(position), -1)
        self.backend.reset(ResetState(base_position=position, base_quaternion=quaternion, held_target=pose))
        self._builder.reset()
        self._session.reset()
        self._action.zero_()
        if self._latency is not None:
            self._targets.extend([pose] * (self._targets.maxlen or 0))

    def step(self, command: torch.Tensor, worlds: torch.Tensor | None = None) -> None:
        """Advance one control period.

        Args:
            command: forward, lateral [m/s] and yaw [rad/s] speed, (N, 3).
            worlds: robots that take part, (N,) bool, None for all; the others stand still.

        Raises:
            PolicyError: the policy's output is not finite.
        """
        noise, delay = (None, None) if self._noise is None else self._noise.next()
        if self._measured is not None:
            delay = self._measured
        observation = self._builder.build(self.state, command, self._action, noise)
        action = self._session.act(observation)
        if worlds is not None:
            action = torch.where(worlds[:, None], action, self._action)
        refused = ~torch.isfinite(action).all(dim=1) & torch.isfinite(observation).all(dim=1)
        if bool(refused.any()):
            raise PolicyError(
                f"'{self.policy.path}' returned an action that is not finite for a finite observation; a policy must return "
                "finite numbers"
            )
        self._action = action
        targets = self._builder.targets(action)
        if self._latency is not None:
            targets, delay = self._late(targets, delay)
        self.backend.step(targets, delay=delay, worlds=worlds)

    def _late(self, targets: torch.Tensor, delay: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the targets of whole control periods ago, and the physics steps by which these are late besides."""
        assert self._latency is not None
        self._targets.append(targets)
        late = self._latency.clamp(min=0)
        ago = len(self._targets) - 1 - late // self._substeps
        chosen = torch.stack(tuple(self._targets))[ago, torch.arange(len(late), device=late.device)]
        own = torch.zeros_like(late) if delay is None else delay
        return chosen, torch.where(self._latency < 0, own, late % self._substeps)
