"""Say which engines are compared on what, and how far a study is."""

from __future__ import annotations

from collections.abc import Mapping
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
_FRICTIONS = "Friction coefficient; repeatable. Default: the nominal one."
_MARGIN = "Difference of quality that does not matter: below it engines are equivalent."
_FACTORS = (
    "Factor that the attribution switches; repeatable. Default: all with --attribution (docs/guides/consistency.md)."
)


class ConsistencyError(ValueError):
    """The study cannot be made; the message says why and what to change."""


@dataclass(frozen=True, kw_only=True)
class StudyRequest:
    """Policies, engines and episodes. Empty tuples and None stand for a choice that suits the machine."""

    policies: PolicyNames
    backends: tuple[str, ...] = ()
    """Engines, each as ``parse_variant`` reads it. Empty: MuJoCo and one more, see ``default_engines``."""
    reference: Annotated[str | None, Choice(_REFERENCE, PLACE, "backends")] = None
    device: Annotated[str | None, Choice(_DEVICE, PLACE)] = None
    suite: SuiteName = "jury"
    robot: RobotName = None
    contract: ContractName = None
    terrains: TerrainNames = ()
    levels: Annotated[tuple[int, ...], Choice(_LEVELS, PLAYED)] = ()
    frictions: Annotated[tuple[float, ...], Choice(_FRICTIONS, PLAYED)] = ()
    seeds: Annotated[int, Choice("Number of seeds; an interval needs two.", PLAYED)] = 3
    margin: Annotated[float, Ge(0.0), Choice(_MARGIN, PLAYED)] = MARGIN
    attribution: Annotated[bool, Choice("Switch one factor at a time and see what it does.", PLAYED)] = False
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
    """Episodes of this run."""
    share: float = 0.0
    """Share of the study's time that is over, 0 to 1."""
    seconds_left: float | None = None
    """None while the speed of engines is measured."""


@dataclass(frozen=True, kw_only=True)
class StudyCost:
    """Estimates of what a study takes and what more of it would take, before anything is played."""

    runs: int
    episodes: int
    """Of a run."""
    seconds: float
    more: Mapping[str, float]
    """Whole time by option, for options that ask for more [s]."""
