"""Declare the limits of Drake; this module needs no Drake."""

from __future__ import annotations

from collections.abc import Mapping

from ..base import Capability, Support
from ..sequential.limits import HARD_CONTACTS, about

LIMITS: Mapping[str, Capability] = HARD_CONTACTS | {
    "height_field": about("hydroelastic contact, which Drake has for meshes; feet are compliant there"),
    "joint_friction": about("an explicit torque that changes sign over a small speed: a joint at rest creeps"),
    "penetration": Capability(support=Support.EXACT, note="seen one substep late"),
}
