"""Feet with and without torsional friction: which factor on it a sub-command or level test has."""

from __future__ import annotations

import zlib

from ...backends.base import BackendError, PhysicsBackend, Support, unsupported
from ..suite import Suite
from .segments import Segment


def foot_torsion(suite: Suite, segment: Segment) -> float:
    """Return the factor on the torsional and rolling friction of a segment's feet.

    Sub-commands and seeds of an environment take the factors in turn. Where they begin is drawn for each environment and level.
    """
    e, factors = segment.episode, suite.matrix.foot_torsion
    place = f"feet {e.stage} {e.terrain} {e.level} {e.friction:.12g} {e.payload:.12g}"
    return factors[(zlib.crc32(place.encode()) + e.seed + segment.goal_index + segment.sub_command) % len(factors)]


def torsion_varies(suite: Suite, backend: PhysicsBackend) -> bool:
    """Return whether feet differ between segments; they all slide in an engine without torsional friction.

    Raises:
        BackendError: the engine has torsional friction and cannot change it.
    """
    capabilities = backend.capabilities()
    if suite.matrix.foot_torsion == (1.0,) or capabilities["foot_condim_6"].support is Support.NONE:
        return False
    if unsupported(["foot_contact"], capabilities):
        raise BackendError(
            f"suite '{suite.name}' plays feet with and without torsional friction, and engine '{backend.name}' cannot change it; "
            "choose another engine (--backend), or a suite with matrix.foot_torsion = [1.0]"
        )
    return True
