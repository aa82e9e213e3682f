"""Say which policies are judged, by which engines and on what, and how far a jury is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from ...files.choices import PLACE, PLAYED, Choice, ContractName, PolicyNames, RobotName, ThreadCount, Trust

ENGINES = ("mujoco", "mujoco@foot_condim=3", "newton:steel", "drake", "physx")
"""One engine of each family, and MuJoCo with feet that turn freely."""


class JuryError(ValueError):
    """The jury cannot judge; the message says why and what to change."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A suite's goals at fixed levels, which every engine plays."""

    suite: str
    grounds: tuple[tuple[str, int], ...]
    """Terrains with their levels; flat ground has level 0."""
    frictions: tuple[float, ...]
    seeds: int
    """Seeds of each terrain and friction, from 0 on."""


PARTS: Mapping[str, Part] = {
    "short": Part(
        suite="jury", grounds=(("flat", 0), ("slope_fd", 6), ("stairs_fd", 6)), frictions=(0.6,), seeds=2
    ),
    "long": Part(
        suite="jury",
        grounds=(
            ("flat", 0), ("slope_fd", 6), ("slope_bd", 6), ("stairs_fd", 6), ("stairs_bd", 6), ("wave", 5), ("obstacle", 6)
        ),
        frictions=(0.3, 0.6, 0.9),
        seeds=3,
    ),
}  # fmt: skip
BIPED_PARTS: Mapping[str, Part] = {
    "short": Part(
        suite="jury-biped", grounds=(("flat", 0), ("slope_fd", 6), ("stairs_fd", 3)), frictions=(0.6,), seeds=2
    ),
    "long": Part(
        suite="jury-biped",
        grounds=(("flat", 0), ("slope_fd", 6), ("stairs_fd", 3), ("wave", 5), ("obstacle", 3)),
        frictions=(0.4, 0.6, 1.0),
        seeds=3,
    ),
}
"""The parts for two legs, on ground in their own measure: on the Go2's stairs a G1 begins with its soles inside a step."""
_PART = "What is played: short takes minutes on two cores, long has all terrains and three frictions."
_DEVICE = "cpu or cuda, for the engines that can use a GPU. Default: a GPU."


@dataclass(frozen=True, kw_only=True)
class JuryRequest:
    """Policies, engines and what they play."""

    policies: PolicyNames
    engines: tuple[str, ...] = ()
    """Each as ``parse_variant`` reads it. Empty: those of ``ENGINES`` that are installed."""
    part: Annotated[str, Choice(_PART, PLAYED, tuple(PARTS))] = "short"
    robot: RobotName = None
    contract: ContractName = None
    device: Annotated[str | None, Choice(_DEVICE, PLACE)] = None
    threads: ThreadCount = None
    trust: Trust = False


@dataclass(frozen=True, kw_only=True)
class JuryCost:
    """What a jury plays, said before it begins."""

    episodes: int
    """In each engine, of each policy."""
    world_steps: int
    """Physics steps of one world in these episodes, at most."""
    engines: int
    policies: int
    seconds: float
    """Of all engines and policies, estimated."""


@dataclass(frozen=True, kw_only=True)
class JuryStatus:
    """How far a jury is, for the progress display."""

    policy: str
    engine: str
    number: int
    """Number of the engine, from 1, over all policies."""
    count: int
    share: float
    """Of all the time that the jury takes, 0 to 1."""
    seconds_left: float | None
    """None while too little has been played to say."""
