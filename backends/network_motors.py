"""Motors by network in any engine: a backend around a backend calls the network at its own period and holds the torques.

The inner engine gets ``motor = "torque"``: what it takes as a joint's target is its motor's torque, before limits and strength.
A step of the contract is cut into pieces of the network's period; the network is called at the beginning of each. A target that
is delayed acts from the first call on at which its delay is over. A reset clears a world's old samples and hidden state; limp
motors are not called.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch

from ..robots.motor_network import MotorNetwork, load_motor_network
from .arguments import check_randomization, check_start, check_step
from .base import BackendError, Capability, PhysicsBackend, Randomization, ResetState, Scene
from .wrapped import WrappedBackend

_FIRST = ("tilt_substep", "penetration_substep")
_WITHOUT_GAINS = ("stiffness_scale", "damping_scale")
_ACTIVATIONS = {
    "softsign": torch.nn.functional.softsign,
    "tanh": torch.tanh,
    "relu": torch.relu,
    "elu": torch.nn.functional.elu,
    "identity": lambda x: x,
}


def steps_between_calls(network: MotorNetwork, timestep: float, control_period: float) -> int:
    """Return the number of physics steps, ``timestep`` [s] each, for which a network's torque is held.

    Raises:
        BackendError: physics steps do not divide the network's period, or that does not divide the control period [s].
    """
    pieces, periods = network.period / timestep, control_period / network.period
    if round(pieces) < 1 or abs(pieces - round(pieces)) > 1e-6 or abs(periods - round(periods)) > 1e-6:
        raise BackendError(
            f"the motor network was made for a call every {1e3 * network.period:g} ms, which physics steps of {1e3 * timestep:g} ms in "
            f"control steps of {1e3 * control_period:g} ms do not give; use a suite variant with 2.5 ms steps (gaitgauge-1-network)"
        )
    return round(pieces)


class NetworkState:
    """The memory of a network for N × J joints, and its calls."""

    def __init__(self, network: MotorNetwork, worlds: int, joints: int, device: torch.device) -> None:
        """Begin with old samples and hidden states of zero."""
        self.network = network
        self._shape = worlds, joints
        self._arrays = {k: torch.tensor(v, dtype=torch.float32, device=device) for k, v in network.arrays.items()}
        samples = (2, network.history, worlds, joints)
        self._samples = torch.zeros(samples, dtype=torch.float32, device=device)
        hidden = (2, network.lstm_layers, worlds, joints, network.hidden)
        self._hidden = torch.zeros(hidden, dtype=torch.float32, device=device)

    def reset(self, worlds: torch.Tensor) -> None:
        """Clear the memory of some worlds, (N,) bool."""
        self._samples[:, :, worlds] = 0.0
        self._hidden[:, :, worlds] = 0.0

    @torch.no_grad()
    def call(self, error: torch.Tensor, velocity: torch.Tensor, worlds: torch.Tensor) -> torch.Tensor:
        """Return torques [N·m], (N, J), and remember this call in some worlds.

        Args:
            error: target − position [rad], (N, J).
            velocity: [rad/s], (N, J).
            worlds: (N,) bool; the memory of the others stays.
        """
        network = self.network
        now = torch.stack(
            (error * (network.error_sign * network.error_scale), velocity * network.velocity_scale)
        ).float()
        samples = torch.cat((now[:, None], self._samples[:, :-1]), dim=1)
        value = samples.flatten(0, 1).permute(1, 2, 0)
        hidden = self._hidden
        if network.lstm_layers:
            value, hidden = self._lstm(value)
        for i in range(network.layers):
            value = torch.nn.functional.linear(value, self._arrays[f"weight_{i}"], self._arrays[f"bias_{i}"])
            if i < network.layers - 1:
                value = _ACTIVATIONS[network.activation](value)
        self._samples = torch.where(worlds[:, None], samples, self._samples)
        self._hidden = torch.where(worlds[:, None, None], hidden, self._hidden)
        return value[..., 0] * network.torque_scale

    def _lstm(self, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        outputs, cells = [], []
        for i in range(self.network.lstm_layers):
            weights, bias = self._arrays[f"lstm_{i}_input"], self._arrays[f"lstm_{i}_bias"]
            gates = torch.nn.functional.linear(value, weights, bias)
            gates = gates + torch.nn.functional.linear(self._hidden[0, i], self._arrays[f"lstm_{i}_hidden"])
            enter, keep, new, leave = gates.chunk(4, dim=-1)
            cell = torch.sigmoid(keep) * self._hidden[1, i] + torch.sigmoid(enter) * torch.tanh(new)
            value = torch.sigmoid(leave) * torch.tanh(cell)
            outputs.append(value)
            cells.append(cell)
        return value, torch.stack((torch.stack(outputs), torch.stack(cells)))


class NetworkMotors(WrappedBackend):
    """An engine whose motors are a network. Made by ``make_backend`` where a parameter set says ``motor = "network"``."""

    name: ClassVar[str] = "network motors"

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Raise ``BackendError``: the engine inside has capabilities of its own."""
        raise BackendError("network motors are no engine; ask the engine inside")

    def __init__(
        self, scene: Scene, *, device: str = "cpu", threads: int = 1, engine: type[PhysicsBackend] | None = None
    ) -> None:
        """Build ``engine``'s worlds with torque motors.

        Raises:
            BackendError: the engine has no torque motors, or the scene's physics steps do not divide the network's period, or that
                does not divide the control period.
            MotorNetworkError: the network's file cannot be used.
        """
        assert engine is not None and scene.parameters.network is not None
        if scene.robot.velocity_joints:
            raise BackendError(
                f"motors by network take targets of position, and robot '{scene.robot.name}' has velocity_joints; choose "
                "another set with --parameters"
            )
        network = load_motor_network(scene.parameters.network)
        physics = scene.physics
        self._piece = steps_between_calls(network, physics.timestep, physics.control_period)
        inside = replace(scene, parameters=replace(scene.parameters, motor="torque", network=None))
        if not engine.torque_motors:
            raise BackendError(
                f"engine '{engine.name}' has no motors that take a torque, which motors by network need; choose another --backend"
            )
        super().__init__(engine(inside, device=device, threads=threads), scene)
        self.name, self.capabilities = self.inner.name, engine.capabilities  # type: ignore[misc, method-assign]
        n, joints = scene.num_worlds, scene.robot.num_joints
        self._network = NetworkState(network, n, joints, self.device)

        def zeros(*shape: int, dtype: torch.dtype = self.dtype) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=self.device)

        self._held, self._offset = zeros(n, joints), zeros(n, joints)
        self._limp = torch.ones(n, dtype=torch.bool, device=self.device)
        self._everyone = torch.ones(n, dtype=torch.bool, device=self.device)

    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.reset``; the network forgets."""
        check_start(self.scene, start, worlds)
        chosen = self._everyone if worlds is None else worlds
        zeros = None if start.held_target is None else torch.zeros_like(start.held_target)
        self.inner.reset(replace(start, held_target=zeros), worlds)
        self._network.reset(chosen)
        self._limp = torch.where(chosen, torch.tensor(start.held_target is None, device=self.device), self._limp)
        if start.held_target is not None:
            self._held = torch.where(chosen[:, None], start.held_target.to(self._held), self._held)

    def step(
        self,
        joint_targets: torch.Tensor | None,
        *,
        delay: torch.Tensor | None = None,
        sample_at: torch.Tensor | None = None,
        worlds: torch.Tensor | None = None,
        substeps: int | None = None,
    ) -> None:
        """See ``PhysicsBackend.step``."""
        total = check_step(self.scene, joint_targets, delay, sample_at, worlds, substeps)
        chosen = self._everyone if worlds is None else worlds
        new = self._held if joint_targets is None else joint_targets.to(self._held)
        limp_after = self._limp & (joint_targets is None)
        first = {key: torch.zeros_like(getattr(self.inner.state, key)) for key in _FIRST}
        eventful = False
        for begin in range(0, total, self._piece):
            count = min(self._piece, total - begin)
            state = self.inner.state
            waits = torch.zeros_like(chosen) if delay is None else delay > begin
            target = torch.where(waits[:, None], self._held, new)
            limp = torch.where(waits, self._limp, limp_after)
            at_work = chosen & ~limp
            error = target + self._offset - state.joint_position
            torque = self._network.call(error, state.joint_velocity, at_work).to(self.dtype)
            torque = torch.where(limp[:, None], 0.0, torque)
            at = (
                None
                if sample_at is None
                else torch.where((sample_at > begin) & (sample_at <= begin + count), sample_at - begin, 0)
            )
            self.inner.step(torque, sample_at=at, worlds=worlds, substeps=count)
            eventful |= self.inner.eventful
            for key, found in first.items():
                own = getattr(self.inner.state, key)
                found.copy_(torch.where((found == 0) & (own > 0), own + begin, found))
        self.eventful = eventful
        for key, found in first.items():
            own = getattr(self.inner.state, key)  # of the last piece; the contract asks for the first of the whole step
            own.copy_(torch.where(chosen, found, own))
        self._held = torch.where(chosen[:, None], new, self._held)
        self._limp = torch.where(chosen, limp_after, self._limp)

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``. Raises ``BackendError`` for scales of gains, which a network does not have."""
        check_randomization(self.scene, randomization, worlds)
        if scaled := next((k for k in _WITHOUT_GAINS if getattr(randomization, k) is not None), None):
            raise BackendError(f"Randomization.{scaled} changes gains, and motors by network have none; leave it out")
        if randomization.motor_offset is not None:
            rows = torch.nonzero(self._everyone if worlds is None else worlds).flatten()
            offset = randomization.motor_offset.to(self._offset)
            self._offset[rows] = offset if len(offset) == len(rows) else offset[rows]
        self.inner.randomize(replace(randomization, motor_offset=None), worlds)

    def describe(self) -> Mapping[str, list[float]] | None:
        """See ``PhysicsBackend.describe``; stiffness and damping are left out."""
        found = self.inner.describe()
        return None if found is None else {k: v for k, v in found.items() if k not in ("stiffness", "damping")}
