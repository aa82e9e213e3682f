"""Declare the capabilities of engines with hard contacts; this module imports no engine."""

from __future__ import annotations

from collections.abc import Mapping

from ..base import CAPABILITY_NAMES, Capability, Support


def about(note: str) -> Capability:
    """Return an approximate capability."""
    return Capability(support=Support.APPROXIMATE, note=note)


def missing(note: str) -> Capability:
    """Return a capability that is not there."""
    return Capability(support=Support.NONE, note=note)


HARD_CONTACTS: dict[str, Capability] = {
    "foot_contact": missing("the feet's contacts are the same in all worlds, but for sliding friction"),
    "elliptic_cone": about("friction is the exact cone of a hard contact; impratio has no meaning here"),
    "foot_condim_6": missing("contacts slide, they have no torsional or rolling friction"),
    "contact_forces": about("hard contacts: the impulse of a touchdown falls into one physics step"),
    "gpu": missing("one CPU core a process"),
}
"""Limits that engines with hard contacts share."""


def declare(limits: Mapping[str, Capability]) -> dict[str, Capability]:
    """Return all capabilities as exact, except the named ones."""
    return {name: limits.get(name, Capability(support=Support.EXACT)) for name in CAPABILITY_NAMES}
