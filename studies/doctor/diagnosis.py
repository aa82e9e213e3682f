"""What a policy was probably made for, where it does not walk as it is described: its contract and likely others, played side by side.

Every contract stands, walks forward, sideways and turns for a moment, nudged once, with the gauge's contacts and motors. What
counts is whether the robot stays up, whether it does what it is told, and how smoothly its motors work.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from ...backends.base import PhysicsBackend, PhysicsState, Randomization, Scene
from ...backends.registry import make_backend
from ...gauge.suite import load_suite
from ...policy.base import Policy
from ...policy.contract import PolicyContract, check_robot
from ...policy.observation import ObservationBuilder
from ...robots import Robot
from ...robots.rotation import rotate_inverse, tilt
from ...terrains.registry import make_terrain
from .alternatives import Alternative, alternatives

SOUND = 0.75
"""Score from which a robot walks."""
CLEAR = 0.05
"""How much better another contract must be before anything is said [score]."""
_GOOD = 0.85
"""Score from which no further mistake is looked for; trained policies that are described rightly have 0.85 to 0.92."""
_MOST = 3
"""Mistakes at once that are looked for."""
_TOGETHER = 8
"""Contracts that are played at once. Each world asks for some 14 MB, of which it uses little; where a process has asked for
more than the machine has, it cannot start another."""
_BEGUN = 4
"""Kinds of mistakes from which a next one is looked for."""
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
"""The suite whose contacts and motors' limits act."""
_TIMESTEP = 0.005
"""Length of a physics step [s], longer than the suite's: that changes scores by 0.004 at most and takes 10 s in place of 17."""


class DiagnosisError(ValueError):
    """A policy cannot be examined."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a policy did with one contract; shares and values from 0 to 1."""

    kind: str
    """What is otherwise than described; empty for the contract as it is."""
    text: str
    contract: PolicyContract
    survival: float
    """Share of the time before the robots fell."""
    tracking: float
    """How well they did what they were told, zero once they lay."""
    smoothness: float
    """How little the motors' torques jump."""

    @property
    def score(self) -> float:
        """All in one number."""
        return 0.4 * self.survival + 0.4 * self.tracking + 0.2 * self.smoothness * self.survival


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What a policy did as described, and with every likely other contract."""

    described: Outcome
    others: tuple[Outcome, ...]
    """Each one mistake away, best first."""
    mistakes: tuple[Outcome, ...]
    """Changes that make it clearly better, each on top of those before it; empty where there are none."""

    @property
    def best(self) -> Outcome:
        """The contract that the policy was most likely made for."""
        return self.mistakes[-1] if self.mistakes else self.described

    @property
    def sound(self) -> bool:
        """Whether the robot walks as described, and no other contract is clearly better."""
        return not self.mistakes and self.described.score >= SOUND

    @property
    def rivals(self) -> tuple[Outcome, ...]:
        """Changes of another kind that are about as good as the first mistake."""
        if not self.mistakes:
            return ()
        first = self.mistakes[0]
        return tuple(o for o in self.others if o.kind != first.kind and o.score > first.score - CLEAR)

    def verdict(self) -> str:
        """One sentence for people."""
        score, best = self.described.score, self.best.score
        if self.sound:
            return f"nothing looks wrong: as described the robot stays up and does what it is told (score {score:.2f} of 1)"
        if not self.mistakes:
            return (
                f"the robot does not walk as described (score {score:.2f} of 1), and none of {len(self.others)} likely changes "
                "helps: the policy was made for something else, or more than one thing is wrong"
            )
        kinds = list(dict.fromkeys(each.kind for each in self.mistakes))
        names = " and ".join(f"the {kind}" for kind in kinds)
        changes = ", then ".join(f"{each.kind} {each.text}" for each in self.mistakes)
        verb = "look" if len(kinds) > 1 else "looks"
        text = f"{names} {verb} wrong: with {changes}, the score rises from {score:.2f} to {best:.2f} of 1"
        if best < SOUND:
            text += ", which is not yet walking, so something else is wrong, too"
        elif len(self.mistakes) == 1 and self.rivals:
            others = ", ".join(dict.fromkeys(each.kind for each in self.rivals))
            text += f"; changes of another kind do about as well ({others})"
        return text


def diagnose(
    policy: Policy,
    robot: Robot,
    *,
    seconds: float = 2.0,
    threads: int = 1,
    report: Callable[[int, int, int], None] = lambda *_: None,
) -> Diagnosis:
    """Play a policy as described and with every likely other contract; where one is clearly better and the robot does not
    walk yet, go on from there.

    Args:
        seconds: how long each is played.
        threads: CPU threads of the physics; results do not depend on them.
        report: called with the number of mistakes that the contracts being played differ in, how many of these contracts have
            been played, and how many there are.

    Raises:
        ContractError: the policy is not for this robot.
        DiagnosisError: its control period is not a multiple of the physics step.
        BackendError: the engine cannot do this.
    """
    check_robot(policy.contract, robot)
    steps = round(seconds / policy.contract.control_period)

    def played(chosen: Sequence[Alternative]) -> list[Outcome]:
        worlds = _worlds(robot, policy.contract, len(chosen) * len(_SHARES), threads)
        with closing(worlds) as physics, torch.inference_mode():
            return _play(policy, chosen, physics, steps)

    def tried(contracts: Sequence[PolicyContract]) -> list[list[Outcome]]:
        """Outcomes of each contract and its alternatives, itself first."""
        own = [Alternative(kind="", text="as described", contract=c) for c in contracts]
        chosen = [[one, *alternatives(one.contract, robot)] for one in own]
        flat = [each for group in chosen for each in group]
        made: list[Outcome] = []
        while len(made) < len(flat):
            report(len(best) + 1, len(made), len(flat))
            made += played(flat[len(made) : len(made) + _TOGETHER])
        outcomes = iter(made)
        return [[next(outcomes) for _ in group] for group in chosen]

    best: tuple[Outcome, ...] = ()
    ((described, *others),) = tried([policy.contract])
    paths = _sorted((each,) for each in others)
    score = described.score
    while paths and paths[0][-1].score > score + CLEAR:
        best, score = paths[0], paths[0][-1].score
        if score >= _GOOD or len(best) == _MOST:
            break
        kinds = {path[-1].kind: path for path in reversed(paths)}  # the best of each kind
        begun = _sorted(kinds.values())[:_BEGUN]
        found = tried([path[-1].contract for path in begun])
        paths = _sorted((*path, each) for path, group in zip(begun, found, strict=True) for each in group[1:])
    return Diagnosis(
        described=described, others=tuple(path[0] for path in _sorted((o,) for o in others)), mistakes=best
    )


def _sorted(paths: Iterable[tuple[Outcome, ...]]) -> list[tuple[Outcome, ...]]:
    """Best end first."""
    return sorted(paths, key=lambda path: -path[-1].score)


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


def _play(policy: Policy, tried: Sequence[Alternative], physics: PhysicsBackend, steps: int) -> list[Outcome]:
    """All contracts at once, so many worlds for each."""
    robot, each = physics.scene.robot, len(_SHARES)
    count, device, dtype = physics.num_worlds, physics.device, physics.dtype
    rows = [slice(i * each, (i + 1) * each) for i in range(len(tried))]
    builders = [ObservationBuilder(one.contract, robot, each, device) for one in tried]
    session = policy.session(count, device=str(device))
    _to_start(physics, tried, each)
    limits = torch.tensor(policy.contract.command_limits, device=device, dtype=dtype)
    walking = (torch.tensor(_SHARES, device=device, dtype=dtype) * limits).repeat(len(tried), 1)
    action = torch.zeros(count, robot.num_joints, device=device)
    alive = torch.ones(count, dtype=torch.bool, device=device)
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
        output = session.act(torch.cat(parts))
        alive = alive & torch.isfinite(output).all(dim=1)
        action = torch.where(alive[:, None], output, 0.0)
        parts = [builder.targets(action[part]) for builder, part in zip(builders, rows, strict=True)]
        physics.step(torch.cat(parts).to(dtype), worlds=alive)
        before, torque = torque, physics.state.joint_torque.clone()
        alive = alive & ~_fallen(physics.state, robot)
        lived += alive
        if step >= begin:
            tracked += alive * _tracking(physics.state, command)
        if step > 0:
            jumped += alive * ((torque - before).abs() / torque_limit).mean(dim=1)
    roughness = jumped / lived.clamp(min=1.0)
    columns = (lived / steps, tracked / (steps - begin), torch.exp(-roughness / _ROUGH))
    survival, tracking, smoothness = (c.view(len(tried), each).mean(dim=1).tolist() for c in columns)
    return [
        Outcome(
            kind=one.kind,
            text=one.text,
            contract=one.contract,
            survival=survival[i],
            tracking=tracking[i],
            smoothness=smoothness[i],
        )
        for i, one in enumerate(tried)
    ]


def _to_start(physics: PhysicsBackend, tried: Sequence[Alternative], each: int) -> None:
    """Stand all robots up, each in its contract's own pose and with its gains."""
    robot, device, dtype = physics.scene.robot, physics.device, physics.dtype
    gains: list[list[list[float]]] = [[], []]
    for one in tried:
        index = [one.contract.joint_names.index(name) for name in robot.joint_names]
        for values, column in ((one.contract.stiffness, gains[0]), (one.contract.damping, gains[1])):
            column += [[values[i] for i in index]] * each
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
    """How well robots do what they are told at this instant, (N,)."""
    velocity = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)
    linear = (velocity[:, :2] - command[:, :2]).square().sum(dim=1) / _SPREAD[0] ** 2
    yaw = (state.base_angular_velocity_b[:, 2] - command[:, 2]).square() / _SPREAD[1] ** 2
    return torch.exp(-(linear + yaw) / 2.0)
