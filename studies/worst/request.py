"""Say which policy is searched for failures, where and for how long, and how far the search is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from ...files.choices import (
    PLACE,
    PLAYED,
    SPAN,
    Choice,
    ContractName,
    DeviceName,
    FirstSeed,
    PolicyName,
    RobotName,
    ThreadCount,
    Trust,
)

OTHERS = ("mujoco@foot_condim=3", "drake")
"""Engines in which failures are played again, those of them that are installed."""
_ENGINE = Choice(
    "Engine that is searched, see 'gaitgauge list backends'.", PLACE, "backends", flags=("--backend", "--engine")
)
_MINUTES = "Time that the search may take [min]; with --resume, from its beginning."
_BATCH = "Cases that are played side by side; results depend on it."


class WorstError(ValueError):
    """A search that cannot be made; the message says why and what to change."""


@dataclass(frozen=True, kw_only=True)
class WorstRequest:
    """A policy, engines and a budget."""

    policy: PolicyName
    minutes: Annotated[float, Ge(0.1), Le(100_000.0), Choice(_MINUTES, SPAN)] = 20.0
    seed: FirstSeed = 0
    batch: Annotated[int, Ge(1), Le(4096), Choice(_BATCH, PLACE)] = 32
    backend: Annotated[str, _ENGINE] = "mujoco"
    others: tuple[str, ...] | None = None
    """Engines in which failures are played again, as ``parse_variant`` reads them; None: those of ``OTHERS`` that are installed."""
    suite: Annotated[str, Choice("Suite that sets physics, noise and latency.", PLAYED, "suites")] = "gaitgauge-1"
    robot: RobotName = None
    contract: ContractName = None
    device: DeviceName = None
    threads: ThreadCount = None
    trust: Trust = False


@dataclass(frozen=True, kw_only=True)
class WorstStatus:
    """How far a search is, for the progress display."""

    stage: str
    """Present activity in a few words."""
    played: int
    """Cases so far."""
    fallen: int
    """Cases in which the robot fell."""
    share: float
    """Of the budget that is spent, 0 to 1."""
    seconds_left: float
    """To the end of the budget."""
