"""Which environments a pipeline gauges (gauge protocol: Base, Multi, Level, Stress; §7). What is played in each says ``plan``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .suite import LEAST_PAYLOAD, MOST_FRICTION, MOST_PAYLOAD, Suite, SuiteError

PIPELINES = ("base", "multi", "level", "stress")


@dataclass(frozen=True, kw_only=True)
class Environment:
    """One terrain at one friction and payload."""

    terrain: str
    friction: float
    payload: float
    """Mass added to the base [kg]."""
    level: float | None
    """The level to play at, a whole number, 0 on flat ground; None to search for it."""

    @property
    def searched(self) -> bool:
        """True where the level is found by search."""
        return self.level is None

    @property
    def key(self) -> str:
        """Unique name."""
        return f"{self.terrain}-f{self.friction:.12g}-m{self.payload:.12g}"


def check_friction(friction: float) -> None:
    """Raise SuiteError for a coefficient with which nothing is played."""
    if not 0.0 < friction <= MOST_FRICTION:
        raise SuiteError(
            f"friction {friction:g} is not possible; give a coefficient above 0 and at most {MOST_FRICTION:g} (--friction)"
        )


def check_payload(payload: float) -> None:
    """Raise SuiteError for a payload [kg] with which nothing is played."""
    if not LEAST_PAYLOAD <= payload <= MOST_PAYLOAD:
        raise SuiteError(
            f"payload {payload:g} kg is not possible; give {LEAST_PAYLOAD:g} to {MOST_PAYLOAD:g} kg (--payload)"
        )


def make_environments(
    suite: Suite,
    *,
    terrains: Sequence[str],
    frictions: Sequence[float] | None,
    payloads: Sequence[float] | None,
    level: int | None,
) -> list[Environment]:
    """The environments of a run: terrain by terrain, payload by payload, friction by friction.

    Args:
        frictions: None for the suite's. Without payloads they are played at the nominal one where the suite does not cross both.
        payloads: None for the suite's. Without frictions they are played as the suite does: a payload other than the nominal one
            at the nominal friction only, unless it crosses both.
        level: the level to play at; None to search for it.

    Raises:
        SuiteError: a level outside the suite's.
    """
    matrix = suite.matrix
    if level is not None and not 1 <= level <= suite.scoring.levels:
        raise SuiteError(f"level {level} does not exist; choose 1 to {suite.scoring.levels}")
    pairs = [
        (f, p) for p in dict.fromkeys(payloads or matrix.payloads) for f in dict.fromkeys(frictions or matrix.frictions)
    ]
    if not matrix.crossed and frictions is None:
        pairs = [(f, p) for f, p in pairs if p == matrix.nominal_payload or f == matrix.nominal_friction]
    elif not matrix.crossed and payloads is None:
        pairs = [(f, p) for f, p in pairs if p == matrix.nominal_payload]
    return [
        Environment(terrain=terrain, friction=f, payload=p, level=0 if terrain == "flat" else level)
        for terrain in terrains
        for f, p in pairs
    ]
