"""What a consistency study is asked for, and how far it is."""

from __future__ import annotations

from dataclasses import dataclass

from .statistics import MARGIN


class ConsistencyError(ValueError):
    """The study cannot be made; the message says why and what to change."""


@dataclass(frozen=True, kw_only=True)
class StudyRequest:
    """What is to be compared. Empty tuples and None stand for a choice that suits the machine."""

    policies: tuple[str, ...]
    backends: tuple[str, ...] = ("mujoco", "mujoco-warp", "newton")
    """Engines, each as ``parse_variant`` reads it."""
    reference: str | None = None
    """The one that the others are compared with; None for the first."""
    device: str | None = None
    """Device of the engines that can use a GPU; None: a GPU, and engines made for one are left out where there is none."""
    suite: str = "robogauge-1.1"
    robot: str | None = None
    """Name or path; None for the one that the policies are for."""
    terrains: tuple[str, ...] = ()
    """Empty: all of the suite's."""
    levels: tuple[int, ...] = ()
    """Empty: level 3."""
    frictions: tuple[float, ...] = ()
    """Empty: the nominal one on a CPU, all of the suite's where every engine but the reference runs on a GPU."""
    seeds: int | None = None
    """Number of seeds, at least 2; None: 3 on a CPU, 10 on a GPU."""
    margin: float = MARGIN
    """Difference of quality that does not matter: engines whose difference surely lies within it are equivalent."""
    attribution: bool = True
    factors: tuple[str, ...] = ()
    """Factors to switch; empty: all."""
    threads: int = 1
    trust: bool = False
    """Run the programs that policy files of the project's own format carry inside."""


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
