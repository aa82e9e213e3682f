"""Split the difference of two contracts into changes that can be made one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

from ...policy.contract import PER_JOINT, ObservationTerm, PolicyContract, reordered
from ...robots import Robot
from .alternatives import joint_order_text

Apply = Callable[[PolicyContract], PolicyContract]


@dataclass(frozen=True, kw_only=True)
class Change:
    """One thing that is otherwise; changes of one pair of contracts may be made in any order."""

    kind: str
    """Name of the change, in the words of ``alternatives``."""
    text: str
    """How it becomes."""
    apply: Apply
    """Make the change."""


def changed(contract: PolicyContract, changes: Iterable[Change]) -> PolicyContract:
    """Return a contract with these changes made."""
    for change in changes:
        contract = change.apply(contract)
    return contract


def differences(given: PolicyContract, wanted: PolicyContract, robot: Robot) -> list[Change]:
    """Return the changes that turn one contract into another of the same joints; provenance and command limits stay."""
    found = []
    if given.joint_names != wanted.joint_names:
        moved = partial(reordered, joint_names=wanted.joint_names)
        stays = partial(replace, joint_names=wanted.joint_names)
        apply = min((moved, stays), key=lambda order: len(_values(order(given), wanted)))
        text = joint_order_text(robot, wanted.joint_names)
        if apply is stays:
            text += "; values per joint as they stand"
        found.append(Change(kind="joint order", text=text, apply=apply))
        given = apply(given)
    return found + _values(given, wanted)


def _values(given: PolicyContract, wanted: PolicyContract) -> list[Change]:
    """Return the changes of two contracts with joints in one order."""
    found: list[Change] = []
    names = wanted.joint_names

    def add(kind: str, text: str, apply: Apply) -> None:
        found.append(Change(kind=kind, text=text, apply=apply))

    for field in ("action_scale", "default_joint_position"):
        old, new = getattr(given, field), getattr(wanted, field)
        if old != new:
            kind = _KINDS[field]
            turned = field == "action_scale" and new == tuple(-v for v in old)
            text = "turned round" if turned else f"{_told(new)} rad"
            kind = "sign of actions" if turned else kind
            add(kind, text, partial(_per_joint, names=names, values={field: new}))
    gains = {"stiffness": wanted.stiffness, "damping": wanted.damping}
    if any(getattr(given, name) != values for name, values in gains.items()):
        text = f"kp {_told(wanted.stiffness)}, kd {_told(wanted.damping)}"
        add("gains", text, partial(_per_joint, names=names, values=gains))
    found += _terms(given, wanted)
    for field, kind in (("order", "order of history"), ("start", "start of history"), ("length", "length of history")):
        new = getattr(wanted.history, field)
        if getattr(given.history, field) != new:
            add(kind, str(new), partial(_history, values={field: new}))
    for entry in fields(PolicyContract):
        old, new = getattr(given, entry.name), getattr(wanted, entry.name)
        if old != new and entry.name not in _HANDLED:
            text = "none" if new is None else _told(new) if isinstance(new, tuple) else str(new)
            apply = partial(_per_joint, names=names) if entry.name in PER_JOINT and new else _plain
            add(entry.name.replace("_", " "), text, partial(apply, values={entry.name: new}))
    return found


_KINDS = {"action_scale": "action scale", "default_joint_position": "default pose"}
_HANDLED = {
    *("robot", "joint_names", "provenance", "schema_version", "command_limits", "observation", "history"),
    *("action_scale", "default_joint_position", "stiffness", "damping"),
}


def _per_joint(contract: PolicyContract, names: Sequence[str], values: dict[str, Any]) -> PolicyContract:
    """Set values given in the order of ``names``, whatever the contract's own order is."""
    index = [names.index(name) for name in contract.joint_names]
    return _plain(contract, {field: tuple(each[i] for i in index) for field, each in values.items()})


def _plain(contract: PolicyContract, values: dict[str, Any]) -> PolicyContract:
    return replace(contract, **values)


def _history(contract: PolicyContract, values: dict[str, Any]) -> PolicyContract:
    return replace(contract, history=replace(contract.history, **values))


def _terms(given: PolicyContract, wanted: PolicyContract) -> list[Change]:
    old, new = ({t.name: t for t in c.observation} for c in (given, wanted))
    order = tuple(new)
    if old.keys() != new.keys():
        whole = partial(_plain, values={"observation": wanted.observation})
        return [Change(kind="observations", text=", ".join(order), apply=whole)]
    found = []
    if tuple(old) != order:
        found.append(Change(kind="order of observations", text=", ".join(order), apply=partial(_ordered, order=order)))
    for name, term in new.items():
        if _spelled(old[name]) != _spelled(term):
            scale, before = _single(term.scale), _single(old[name].scale)
            turned = name == "projected_gravity_b" and scale == tuple(-s for s in before)
            kind = "sign of gravity" if turned else "observation scale" if scale != before else "clip of observations"
            text = "turned round" if turned else f"{name} × {_told(term.scale)}"
            found.append(Change(kind=kind, text=text, apply=partial(_term, term=term)))
    return found


def _ordered(contract: PolicyContract, order: tuple[str, ...]) -> PolicyContract:
    terms = {t.name: t for t in contract.observation}
    return replace(contract, observation=tuple(terms[name] for name in order))


def _term(contract: PolicyContract, term: ObservationTerm) -> PolicyContract:
    return replace(contract, observation=tuple(term if t.name == term.name else t for t in contract.observation))


def _spelled(term: ObservationTerm) -> ObservationTerm:
    return replace(term, scale=_single(term.scale))


def _single(scale: tuple[float, ...]) -> tuple[float, ...]:
    return scale[:1] if len(set(scale)) == 1 else scale


def _told(values: Sequence[Any]) -> str:
    """Return values in short: one where all are equal."""
    shown = [f"{v:g}" if isinstance(v, float) else str(v) for v in values]
    return shown[0] if len(set(shown)) == 1 else "(" + ", ".join(shown) + ")"
