"""Say which policies are looked into, and where they walk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from ...files.choices import PLAYED, Choice, SuiteName
from ..request import PoliciesRequest

_ROBOTS = "Robots for each terrain and command; the probe is tried on each in turn."


@dataclass(frozen=True, kw_only=True)
class LatentRequest(PoliciesRequest):
    """Policies and their walks."""

    terrains: Annotated[
        tuple[str, ...], Choice("Terrain; repeatable. Default: the gauge's seven.", PLAYED, "terrains")
    ] = ()
    level: Annotated[int, Ge(1), Choice("Level of the terrains that have levels.", PLAYED)] = 5
    friction: Annotated[float, Choice("Friction coefficient of the ground.", PLAYED)] = 0.8
    suite: SuiteName = "gaitgauge-1"
    settling: float = 1.0
    """Time for which every robot stands before its first command [s]."""
    seconds: Annotated[float, Ge(0.2), Le(60.0), Choice("How long every robot walks [s].", PLAYED)] = 5.0
    robots: Annotated[int, Ge(2), Le(1000), Choice(_ROBOTS, PLAYED)] = 4
