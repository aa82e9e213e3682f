"""List contracts of the same input and output that a policy may have been made for, each one likely mistake away.

The choices are those that published training codes and controllers really make; robots are known by their model alone, never
by the names of their joints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import get_args

from ...policy.contract import ContractError, HistoryOrder, ObservationTerm, PolicyContract, reordered
from ...policy.observation_table import observation
from ...robots import Robot, RobotError
from ...robots.anatomy.body_plan import BodyPlan, body_plan

_ACTION_SCALES = (0.1, 0.2, 0.25, 0.3, 0.5, 1.0)
"""Action scales that are in use [rad]."""
_GAINS = ((0.5, 1.0), (2.0, 1.0), (1.0, 0.5), (1.0, 2.0), (0.5, 0.5), (2.0, 2.0), (4.0, 2.0), (0.25, 0.5))
"""Factors on kp and kd."""


@dataclass(frozen=True, kw_only=True)
class Alternative:
    """A contract that a policy may have been made for."""

    kind: str
    """Name of the change, for example ``joint order``."""
    text: str
    """How it is otherwise."""
    contract: PolicyContract


def alternatives(contract: PolicyContract, robot: Robot) -> list[Alternative]:
    """All contracts that are one likely mistake away from this one, none twice."""
    found: dict[str, Alternative] = {contract.hash: Alternative(kind="", text="", contract=contract)}
    for make in (_joint_orders, _action_scales, _histories, _scales, _gains, _poses, _term_orders):
        for each in make(contract, robot):
            found.setdefault(each.contract.hash, each)
    return list(found.values())[1:]


# ---- joints ---------------------------------------------------------------------------------------------------------


def _joint_orders(contract: PolicyContract, robot: Robot) -> Iterator[Alternative]:
    """The same joints in other orders; values per joint go with their joints, or stay where they stand."""
    for text, names in _orders(robot):
        if sorted(names) != sorted(contract.joint_names):
            continue
        yield Alternative(kind="joint order", text=text, contract=reordered(contract, names))
        if "assumed" not in contract.provenance:  # else the values are the robot's, by the names of its joints
            stayed = replace(contract, joint_names=names)
            yield Alternative(kind="joint order", text=f"{text}; values per joint as they stand", contract=stayed)


def joint_order_text(robot: Robot, names: tuple[str, ...]) -> str:
    """Return an order of joints in words, the names themselves where nothing is known that lists joints so."""
    return next((text for text, order in _orders(robot) if order == names), ", ".join(names))


def _orders(robot: Robot) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Orders in which simulators and makers list joints, with words for each."""
    yield f"as robot '{robot.name}' lists them", robot.joint_names
    if robot.sdk_joint_names is not None:
        yield "as the maker's SDK numbers them", robot.sdk_joint_names
    plan = _plan(robot)
    if plan is not None and len({len(leg) for leg in plan.legs}) == 1:
        x, y = plan.foot_position[:, 0].round(1), plan.foot_position[:, 1].round(1)
        keys: tuple[Callable[[int], tuple[float, float]], ...] = (
            lambda foot: (-x[foot], -y[foot]),
            lambda foot: (-x[foot], y[foot]),
            lambda foot: (-y[foot], -x[foot]),
            lambda foot: (y[foot], -x[foot]),
            lambda foot: (x[foot], -y[foot]),
            lambda foot: (x[foot], y[foot]),
        )
        for key in keys:
            feet = sorted(range(len(plan.legs)), key=key)
            legs = [[robot.joint_names[j] for j in plan.legs[foot]] for foot in feet]
            told = ", ".join(robot.foot_names[foot] for foot in feet)
            yield f"leg by leg ({told})", tuple(name for leg in legs for name in leg)
            yield (
                f"kind by kind of joint, legs {told}",
                tuple(name for kind in zip(*legs, strict=True) for name in kind),
            )
    yield "in the order of their names", tuple(sorted(robot.joint_names))


def _plan(robot: Robot) -> BodyPlan | None:
    """A robot's legs, None where its feet do not hang on legs of listed joints."""
    try:
        return body_plan(robot)
    except RobotError:
        return None


def _hips(contract: PolicyContract, robot: Robot) -> list[bool]:
    """Return whether each of the policy's joints swings a leg sideways."""
    plan = _plan(robot)
    sideways = {robot.joint_names[j] for j in plan.abduction} if plan else set()
    return [name in sideways for name in contract.joint_names]


def _action_scales(contract: PolicyContract, robot: Robot) -> Iterator[Alternative]:
    own = contract.action_scale
    hips = _hips(contract, robot)

    def made(kind: str, text: str, values: Sequence[float]) -> Alternative:
        return Alternative(kind=kind, text=text, contract=replace(contract, action_scale=tuple(values)))

    yield made("sign of actions", "turned round", [-v for v in own])
    for factor in (0.5, 2.0):
        with suppress(ContractError):  # larger than any
            yield made("action scale", f"{factor:g} times what is said", [v * factor for v in own])
    for value in _ACTION_SCALES:
        yield made("action scale", f"{value:g} rad for all joints", [value] * len(own))
    for factor in (0.5, 2.0):
        scaled = [v * factor if hip else v for v, hip in zip(own, hips, strict=True)]
        with suppress(ContractError):
            yield made("action scale", f"{factor:g} times what is said at the hips", scaled)


def _gains(contract: PolicyContract, robot: Robot) -> Iterator[Alternative]:
    index = [robot.joint_names.index(n) for n in contract.joint_names]
    for name, motors in robot.parameters.items():
        stiffness = tuple(motors.stiffness[i] for i in index)
        damping = tuple(motors.damping[i] for i in index)
        changed = replace(contract, stiffness=stiffness, damping=damping)
        yield Alternative(kind="gains", text=f"those of robot '{robot.name}', set '{name}'", contract=changed)
    for kp, kd in _GAINS:
        with suppress(ContractError):
            changed = replace(
                contract,
                stiffness=tuple(v * kp for v in contract.stiffness),
                damping=tuple(v * kd for v in contract.damping),
            )
            yield Alternative(kind="gains", text=f"kp × {kp:g}, kd × {kd:g}", contract=changed)


def _poses(contract: PolicyContract, robot: Robot) -> Iterator[Alternative]:
    index = [robot.joint_names.index(n) for n in contract.joint_names]
    own, hips = contract.default_joint_position, _hips(contract, robot)
    standing = [robot.default_joint_position[i] for i in index]
    for text, pose in (
        (f"that of robot '{robot.name}'", standing),
        ("all zero", [0.0] * len(own)),
        ("hips straight", [0.0 if hip else v for v, hip in zip(own, hips, strict=True)]),
        ("hips spread the other way", [-v if hip else v for v, hip in zip(own, hips, strict=True)]),
        (
            f"that of robot '{robot.name}' with straight hips",
            [0.0 if h else v for v, h in zip(standing, hips, strict=True)],
        ),
    ):
        changed = replace(contract, default_joint_position=tuple(pose))
        yield Alternative(kind="default pose", text=text, contract=changed)


# ---- observations ---------------------------------------------------------------------------------------------------


def _histories(contract: PolicyContract, robot: Robot) -> Iterator[Alternative]:
    """The same frames in other orders, begun otherwise."""
    length = contract.history.length
    if length == 1:
        return
    orders: tuple[HistoryOrder, ...] = get_args(HistoryOrder)
    for order in orders:
        changed = replace(contract, history=replace(contract.history, order=order))
        yield Alternative(kind="order of history", text=order, contract=changed)
    history = replace(contract.history, start="repeat" if contract.history.start == "zeros" else "zeros")
    yield Alternative(kind="start of history", text=history.start, contract=replace(contract, history=history))


def _scales(contract: PolicyContract, robot: Robot) -> Iterator[Alternative]:
    terms = contract.observation

    def made(kind: str, text: str, changes: dict[str, tuple[float, ...]]) -> Alternative:
        changed = tuple(replace(t, scale=changes.get(t.name, t.scale)) for t in terms)
        return Alternative(kind=kind, text=text, contract=replace(contract, observation=changed))

    for term in terms:
        if term.name == "projected_gravity_b":
            yield made("sign of gravity", "turned round", {term.name: tuple(-s for s in term.scale)})
        for scale in observation(term.name).scales_in_use:
            told = ", ".join(f"{s:g}" for s in scale)
            yield made("observation scale", f"{term.name} × {told}", {term.name: scale})
    names = [t.name for t in terms]
    yield made("observation scale", "nothing is scaled", dict.fromkeys(names, (1.0,)))
    yield made("observation scale", "as in legged_gym", {n: observation(n).scale for n in names})


def _term_orders(contract: PolicyContract, robot: Robot) -> Iterator[Alternative]:
    """Neighbours exchanged, and each of the short terms at every other place."""
    terms = contract.observation
    for i, (a, b) in enumerate(pairwise(terms)):
        yield _ordered(contract, f"{b.name} before {a.name}", (*terms[:i], b, a, *terms[i + 2 :]))
    for term in terms:
        rest = [t for t in terms if t is not term]
        for place in range(len(terms) if observation(term.name).width else 0):
            where = f"after {rest[place - 1].name}" if place else "first"
            yield _ordered(contract, f"{term.name} {where}", (*rest[:place], term, *rest[place:]))


def _ordered(contract: PolicyContract, text: str, terms: tuple[ObservationTerm, ...]) -> Alternative:
    return Alternative(kind="order of observations", text=text, contract=replace(contract, observation=terms))
