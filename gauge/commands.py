"""Commands over time as data: what goals of one's own suites and field trials are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

_Speed = Annotated[float, Field(ge=-100.0, le=100.0)]
Command = tuple[float, float, float]
"""Forward, lateral and yaw."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A command for a time."""

    seconds: Annotated[float, Field(gt=0.0, le=600.0)]
    velocity: tuple[_Speed, _Speed, _Speed]
    """Forward, lateral [m/s] and yaw [rad/s] speed; in a suite's goal, multiples of the terrain's command limits, -1 to 1."""

    def steps(self, period: float) -> int:
        """Control steps of a length [s] that the phase takes, at least one."""
        return max(round(self.seconds / period), 1)
