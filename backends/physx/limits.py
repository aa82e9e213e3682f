"""Declare the limits of PhysX; this module needs no PhysX."""

from __future__ import annotations

from collections.abc import Mapping

from ..base import Capability, Support
from ..sequential.limits import HARD_CONTACTS

LIMITS: Mapping[str, Capability] = HARD_CONTACTS | {
    "penetration": Capability(support=Support.EXACT, note="seen one substep late"),
}
