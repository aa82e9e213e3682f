"""Say which engines are compared on what, and how far a study is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge

from ...files.choices import (
    PLACE,
    PLAYED,
    Choice,
    ContractName,
    PolicyNames,
    RobotName,
    SuiteName,
    TerrainNames,
    ThreadCount,
    Trust,
)

MARGIN = 0.02
"""Difference of quality that does not matter: it moves the score of a levelled terrain by 0.004, less than its repeatability."""
_REFERENCE = "Engine that the others are compared with. Default: the first."
_DEVICE = "cpu or cuda, for the engines that can use a GPU. Default: a GPU."
_LEVELS = "Level (1-10) of the terrains that have levels; repeatable. Default: 3."
_FRICTIONS = "Friction coefficient; repeatable. Default: the nominal one; on a GPU the suite's."
_MARGIN = "Difference of quality that does not matter: below it engines are equivalent."
_FACTORS = "Factor that the attribution switches; repeatable. Default: all (docs/guides/consistency.md)."


class ConsistencyError(ValueError):
    """The study cannot be made; the message says why and what to change."""


@dataclass(frozen=True, kw_only=True)
class StudyRequest:
    """Policies, engines and episodes. Empty tuples and None stand for a choice that suits the machine."""

    policies: PolicyNames
    backends: tuple[str, ...] = ("mujoco", "mujoco-warp", "newton")
    """Engines, each as ``parse_variant`` reads it."""
    reference: Annotated[str | None, Choice(_REFERENCE, PLACE, "backends")] = None
    device: Annotated[str | None, Choice(_DEVICE, PLACE)] = None
    suite: SuiteName = "robogauge-1.1"
    robot: RobotName = None
    contract: ContractName = None
    terrains: TerrainNames = ()
    levels: Annotated[tuple[int, ...], Choice(_LEVELS, PLAYED)] = ()
    frictions: Annotated[tuple[float, ...], Choice(_FRICTIONS, PLAYED)] = ()
    seeds: Annotated[int | None, Choice("Number of seeds, at least 2. Default: 3; on a GPU 10.", PLAYED)] = None
    margin: Annotated[float, Ge(0.0), Choice(_MARGIN, PLAYED)] = MARGIN
    attribution: Annotated[bool, Choice("Switch one factor at a time and see what it does.", PLAYED)] = True
    factors: Annotated[tuple[str, ...], Choice(_FACTORS, PLAYED)] = ()
    threads: ThreadCount = None
    trust: Trust = False


@dataclass
class StudyStatus:
    """How far a study is, for the progress display."""

    policy: str
    variant: str
    part: int
    """Number of the present run of episodes, from 1."""
    parts: int
    done: int
    """Episodes of this run that have ended."""
    episodes: int
