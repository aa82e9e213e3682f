"""Play a policy with several contracts side by side: stand, walk forward, sideways and turn for a moment, nudged once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from ...backends.base import PhysicsBackend, PhysicsState, Randomization, Scene
from ...backends.registry import make_backend
from ...gauge.suite import load_suite
from ...policy.base import Policy
from ...policy.contract import PolicyContract
from ...policy.ground import Ground
from ...policy.observation import ObservationBuilder
from ...robots import Robot
from ...robots.rotation import rotate_inverse, tilt
from ...terrains.registry import make_terrain
from .alternatives import Alternative

_TOGETHER = 8
"""Contracts that are played at once. Each world asks for some 14 MB, of which it uses little; where a process has asked for
more than the machine has, it cannot start another."""
_SHARES = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.5))
"""Commands, as shares of the contract's limits."""
_STAND = 0.4
"""Time at the beginning in which every robot is told to stand [s]."""
_NUDGE = (0.0, 0.3, 0.0)
"""Velocity that the base gets when it begins to walk, world frame [m/s]."""
_FALLEN = 1.0
"""Tilt of the base from which a robot has fallen [rad]."""
_LOW = 0.4
"""Height of the base at which it has fallen, a share of the height at the start."""
_SPREAD = (0.25, 0.5)
"""Errors of linear [m/s] and yaw speed [rad/s] at which tracking has fallen to 1/e."""
_ROUGH = 0.1
"""Mean change of a joint's torque from step to step, a share of its limit, at which smoothness has fallen to 1/e."""
_SUITE = "gaitgauge-1"
"""Suite of the contacts and the motors' limits."""
_TIMESTEP = 0.005
"""Length of a physics step [s], longer than the suite's: that changes scores by 0.004 at most and takes 10 s in place of 17."""


class DiagnosisError(ValueError):
    """A policy cannot be examined."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a policy did with one contract; shares and values from 0 to 1."""

    kind: str
    """Change against the description; empty for the contract as it is."""
    text: str
    contract: PolicyContract
    survival: float
    """Share of the time before the robots fell."""
    tracking: float
    """How much better they did what they were told than a robot that stands still, zero once they lay."""
    smoothness: float
    """How little the motors' torques jump."""

    @property
    def score(self) -> float:
        """All in one number."""
        return 0.4 * self.survival + 0.4 * self.tracking + 0.2 * self.smoothness * self.survival


class Bench:
    """Worlds in which contracts of one policy are played, some at once."""

    def __init__(self, policy: Policy, robot: Robot, *, threads: int = 1) -> None:
        """Build the worlds.

        Raises:
            DiagnosisError: the policy's control period is not a multiple of the physics step.
            BackendError: the engine cannot do this.
        """
        self._policy = policy
        self._physics = _worlds(robot, policy.contract, _TOGETHER * len(_SHARES), threads)

    def close(self) -> None:
        """Free the worlds."""
        self._physics.close()

    def play(
        self, chosen: Sequence[Alternative | Outcome], seconds: float, played: Callable[[int], None] = lambda _: None
    ) -> list[Outcome]:
        """Return the outcome of each contract; ``played`` is called with the number of those that have been played."""
        steps = round(seconds / self._policy.contract.control_period)
        made: list[Outcome] = []
        with torch.inference_mode():
            while len(made) < len(chosen):
                made += _play(self._policy, chosen[len(made) : len(made) + _TOGETHER], self._physics, steps)
                played(len(made))
        return made


def _worlds(robot: Robot, contract: PolicyContract, count: int, threads: int) -> PhysicsBackend:
    """Level ground in MuJoCo; motors with gains of 1, which factors turn into those of a contract."""
    physics = replace(
        load_suite(_SUITE).physics,
        timestep=_TIMESTEP,
        substeps=max(1, round(contract.control_period / _TIMESTEP)),
        watch_tilt=None,
        watch_penetration=None,
    )
    if abs(physics.control_period - contract.control_period) > 1e-9:
        raise DiagnosisError(
            f"the policy's control period is {contract.control_period:g} s, no multiple of the physics step of "
            f"{physics.timestep:g} s; give it one that is (control_period in contract.toml)"
        )
    ones = (1.0,) * robot.num_joints
    own = robot.parameters[robot.default_parameters]
    scene = Scene(
        robot=robot,
        parameters=replace(own, stiffness=ones, damping=ones),
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * count,
        physics=physics,
    )
    return make_backend("mujoco", scene, threads=threads)


def _play(policy: Policy, tried: Sequence[Alternative | Outcome], physics: PhysicsBackend, steps: int) -> list[Outcome]:
    """Play all contracts at once, so many worlds for each; worlds that no contract needs stand still."""
    robot, each = physics.scene.robot, len(_SHARES)
    count, device, dtype = physics.num_worlds, physics.device, physics.dtype
    used, spare = len(tried) * each, count - len(tried) * each
    rows = [slice(i * each, (i + 1) * each) for i in range(len(tried))]
    where = torch.zeros(each, dtype=torch.int64, device=device)
    grounds = [Ground.of(one.contract, physics.scene.terrains, where) for one in tried]
    builders = [
        ObservationBuilder(one.contract, robot, each, device, ground)
        for one, ground in zip(tried, grounds, strict=True)
    ]
    session = policy.session(count, device=str(device))
    _to_start(physics, [*tried, *[tried[-1]] * (spare // each)], each)
    limits = torch.tensor(policy.contract.command_limits, device=device, dtype=dtype)
    walking = (torch.tensor(_SHARES, device=device, dtype=dtype) * limits).repeat(count // each, 1)
    action = torch.zeros(count, policy.contract.num_joints, device=device)
    alive = torch.arange(count, device=device) < used
    still = torch.zeros(spare, policy.contract.observation_width, device=device)
    joints = torch.zeros(spare, robot.num_joints, device=device)
    lived, tracked, jumped = (torch.zeros(count, device=device, dtype=torch.float64) for _ in range(3))
    torque = before = torch.zeros(count, robot.num_joints, device=device, dtype=dtype)
    torque_limit = torch.tensor(physics.scene.parameters.torque_limit, device=device, dtype=dtype)
    begin = min(round(_STAND / policy.contract.control_period), steps // 2)
    for step in range(steps):
        if step == begin:
            nudge = torch.tensor(_NUDGE, device=device, dtype=dtype).expand(count, 3)
            physics.push(alive, linear_velocity_w=physics.state.base_linear_velocity_w + nudge)
        command = walking if step >= begin else torch.zeros_like(walking)
        state = physics.state
        parts = [
            builder.build(cast(PhysicsState, _Part(state, part)), command[part], action[part])
            for builder, part in zip(builders, rows, strict=True)
        ]
        output = session.act(torch.cat((*parts, still)))
        alive = alive & torch.isfinite(output).all(dim=1)
        action = torch.where(alive[:, None], output, 0.0)
        parts = [builder.targets(action[part]) for builder, part in zip(builders, rows, strict=True)]
        physics.step(torch.cat((*parts, joints)).to(dtype), worlds=alive)
        before, torque = torque, physics.state.joint_torque.clone()
        alive = alive & ~_fallen(physics.state, robot)
        if not bool(alive.any()):
            break
        lived += alive
        if step >= begin:
            tracked += alive * _tracking(physics.state, command)
        if step > 0:
            jumped += alive * ((torque - before).abs() / torque_limit).mean(dim=1)
    roughness = jumped / lived.clamp(min=1.0)
    idle = _accuracy(torch.zeros_like(walking), walking).mean().item()
    columns = (lived / steps, tracked / (steps - begin), torch.exp(-roughness / _ROUGH))
    survival, tracking, smoothness = (c[:used].view(-1, each).mean(dim=1).tolist() for c in columns)
    return [
        Outcome(
            kind=one.kind,
            text=one.text,
            contract=one.contract,
            survival=survival[i],
            tracking=max(0.0, tracking[i] - idle) / (1.0 - idle),
            smoothness=smoothness[i],
        )
        for i, one in enumerate(tried)
    ]


def _to_start(physics: PhysicsBackend, tried: Sequence[Alternative | Outcome], each: int) -> None:
    """Stand all robots up, each in its contract's own pose and with its gains."""
    robot, device, dtype = physics.scene.robot, physics.device, physics.dtype
    gains: list[list[list[float]]] = [[], []]
    for one in tried:
        own, names = robot.parameters[robot.default_parameters], one.contract.joint_names
        for sent, held, column in (
            (one.contract.stiffness, own.stiffness, gains[0]),
            (one.contract.damping, own.damping, gains[1]),
        ):
            values = dict(zip(robot.joint_names, held, strict=True)) | dict(zip(names, sent, strict=True))
            column += [list(values.values())] * each
    kp, kd = (torch.tensor(column, device=device, dtype=dtype) for column in gains)
    physics.randomize(Randomization(stiffness_scale=kp, damping_scale=kd))
    physics.reset(physics.standing())


class _Part:
    """Some worlds of a state; what is not looked at is not computed."""

    def __init__(self, state: PhysicsState, rows: slice) -> None:
        self._state, self._rows = state, rows

    def __getattr__(self, name: str) -> Any:
        return getattr(self._state, name)[self._rows]


def _fallen(state: PhysicsState, robot: Robot) -> torch.Tensor:
    """Which robots lie, (N,) bool."""
    low = state.base_position_w[:, 2] < _LOW * robot.stand_height
    return low | (tilt(state.base_quaternion_w) > _FALLEN) | state.diverged


def _tracking(state: PhysicsState, command: torch.Tensor) -> torch.Tensor:
    """Return how well robots do what they are told at this instant, (N,)."""
    velocity = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)
    return _accuracy(torch.cat((velocity[:, :2], state.base_angular_velocity_b[:, 2:]), dim=1), command)


def _accuracy(velocity: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
    """Return 1 for a velocity, forward, sideways [m/s] and yaw [rad/s], (N, 3), as commanded, less the farther it is off, (N,)."""
    error = (velocity - command).square()
    return torch.exp(-(error[:, :2].sum(dim=1) / _SPREAD[0] ** 2 + error[:, 2] / _SPREAD[1] ** 2) / 2.0)
