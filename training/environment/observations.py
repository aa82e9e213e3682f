"""Make the inputs of the networks: the noisy frame, its history, and the privileged state of teacher and critic.

The frame itself comes from the policy package's builder, the one that the gauge uses too. The privileged state is a table,
``PRIVILEGED_TERMS``, of functions of ``ObservationInputs``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from ...backends.base import PhysicsState
from ...policy.contract import PolicyContract
from ...policy.observation import ObservationBuilder
from ...policy.observation_table import ACTION_BEFORE_LAST, HEIGHT_SCAN, observation
from ...robots.rotation import rotate_inverse
from ...terrains.height_scan import HeightRasters, heading, place_pattern
from .configuration import NoiseConfiguration, ObservationConfiguration
from .memory import EnvironmentMemory
from .own_terms import resolve_own
from .randomness import UniformColumns

LINEAR_VELOCITY_SCALE = 2.0
JOINT_ACCELERATION_SCALE = 1e-4
HEIGHT_SCALE = 2.5


def noise_amplitude(contract: PolicyContract, noise: NoiseConfiguration, device: torch.device | str) -> torch.Tensor:
    """Half-width of the noise on each entry of a frame, in scaled units, (frame width,)."""
    amplitudes = [
        torch.tensor(term.scale).abs().expand(width) * observation(term.name).half_width(noise)
        for term, width in zip(contract.observation, contract.term_widths, strict=True)
    ]
    return torch.cat(amplitudes).to(device)


def push_history(history: torch.Tensor, frame: torch.Tensor, forget: torch.Tensor, *, start: str) -> torch.Tensor:
    """Return a history (N, H, width), oldest first, with one more frame (N, width) at its end and the oldest gone. In the worlds of
    ``forget``, (N,) bool, an episode has just begun, copies of the frame stand before it where ``start`` is ``repeat``, else zeros.
    """
    newest = frame[:, None]
    kept = torch.where(forget[:, None, None], newest if start == "repeat" else 0.0, history[:, 1:])
    return torch.cat((kept, newest), dim=1)


@dataclass(frozen=True, kw_only=True)
class ObservationInputs:
    """What is observed: the present state, which is fresh in worlds that were just reset. N worlds."""

    state: PhysicsState
    """The physics; poses and velocities are fresh, forces those of the last step."""
    memory: EnvironmentMemory
    """Commands, actions, and what the last step led to."""
    frame: torch.Tensor
    """Observation of the policy without noise, (N, 45)."""
    ground: torch.Tensor
    """Height of the ground at each point of the scan, world frame [m], (N, P)."""
    torque_limit: torch.Tensor
    """Largest torque of each joint [N·m], (J,)."""
    settings: ObservationConfiguration


def base_linear_velocity(inputs: ObservationInputs) -> torch.Tensor:
    """Velocity of the base in its own frame, (N, 3)."""
    state = inputs.state
    return rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w) * LINEAR_VELOCITY_SCALE


def frame(inputs: ObservationInputs) -> torch.Tensor:
    """The policy's observation without noise, (N, 45)."""
    return inputs.frame


def foot_force(inputs: ObservationInputs) -> torch.Tensor:
    """Norm of each foot's contact force, (N, F)."""
    return inputs.memory.foot_force * inputs.settings.foot_force_scale


def torque_ratio(inputs: ObservationInputs) -> torch.Tensor:
    """Torques over their limits, (N, J)."""
    return inputs.memory.joint_torque / inputs.torque_limit


def joint_acceleration(inputs: ObservationInputs) -> torch.Tensor:
    """Joint accelerations, (N, J). The published code has the opposite sign."""
    return inputs.memory.joint_acceleration * JOINT_ACCELERATION_SCALE


def height_scan(inputs: ObservationInputs) -> torch.Tensor:
    """Height of the base over each point of the scan less ``height_offset``, clipped to 1 m, (N, P)."""
    height = inputs.state.base_position_w[:, 2:3] - inputs.settings.height_offset - inputs.ground
    return height.clamp(-1.0, 1.0) * HEIGHT_SCALE


PrivilegedTerm = Callable[[ObservationInputs], torch.Tensor]

PRIVILEGED_TERMS: Mapping[str, PrivilegedTerm] = {
    f.__name__: f for f in (base_linear_velocity, frame, foot_force, torque_ratio, joint_acceleration, height_scan)
}
"""State that only training knows, without noise, in this order: 263 entries for 12 joints, 4 feet and 187 scan points."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """The three observation groups."""

    policy: torch.Tensor
    """Noisy frame, (N, 45)."""
    history: torch.Tensor
    """Noisy frames, oldest first, the current one last, (N, 225)."""
    privileged: torch.Tensor
    """(N, 263)."""

    def clone(self) -> Observations:
        """Copies."""
        return Observations(**{name: value.clone() for name, value in vars(self).items()})


class Observer:
    """Makes observations of the present state."""

    def __init__(
        self,
        configuration: ObservationConfiguration,
        *,
        contract: PolicyContract,
        builder: ObservationBuilder,
        scan: torch.Tensor,
        rasters: HeightRasters,
        torque_limit: torch.Tensor,
    ) -> None:
        """Choose the terms. Raises ConfigurationError: a term of one's own is not there."""
        own = resolve_own(
            configuration.own,
            "environment.observations.own",
            taken=PRIVILEGED_TERMS,
            gives=lambda inputs, found: found.ndim == 2 and found.shape[:1] == inputs.frame.shape[:1],
            rule="it must be numbers for each world, (N, width)",
        )
        self._terms: list[PrivilegedTerm] = [*PRIVILEGED_TERMS.values(), *own.values()]
        self._settings, self._builder, self._scan, self._rasters = configuration, builder, scan, rasters
        self._torque_limit = torque_limit
        self._noise = noise_amplitude(contract, configuration.noise, scan.device)
        self._start = contract.history.start
        self._remembers = any(t.name in (HEIGHT_SCAN, ACTION_BEFORE_LAST) for t in contract.observation)

    def __call__(self, state: PhysicsState, memory: EnvironmentMemory, uniform: UniformColumns) -> Observations:
        """Observations; the noisy frame is added to the history."""
        if self._remembers:
            self._builder.reset(memory.just_reset)
        clean = self._builder.build(state, memory.command, memory.action)
        noisy = clean + uniform.signed("noise") * self._noise
        memory.history.copy_(push_history(memory.history, noisy, memory.just_reset, start=self._start))
        points = place_pattern(self._scan, state.base_position_w[:, :2], heading(state.base_quaternion_w))
        inputs = ObservationInputs(
            state=state,
            memory=memory,
            frame=clean,
            ground=self._rasters.height(memory.terrain_index, points),
            torque_limit=self._torque_limit,
            settings=self._settings,
        )
        privileged = torch.cat([term(inputs) for term in self._terms], dim=1)
        return Observations(policy=noisy, history=memory.history.flatten(1), privileged=privileged)
