"""Describe a policy's input: terms of an observation, past frames, parts of a layout, a second network."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from ..files.parsing import Text, check_fields
from .observation_table import HEIGHT_SCAN, ObservationError, observation

HistoryOrder = Literal["frame-major", "term-major", "frame-major-newest-first", "term-major-newest-first"]


class ContractError(ValueError):
    """A contract is malformed, or does not fit the robot, suite or policy at hand."""


MOST = 1000
"""Joints, and entries of a term."""
RESTING = 0.1
"""Length of a command, speeds [m/s] and [rad/s] alike, below which a gait clock is at rest."""
Clip = Annotated[float, Field(strict=True, gt=0.0, le=1e9)]
"""Largest magnitude."""
Target = Annotated[float, Field(strict=True, ge=-1_000.0, le=1_000.0)]
"""A joint's target, or a value in an observation's unit."""
_Factor = Annotated[float, Field(strict=True, ge=-1e6, le=1e6)]
_Extent = Annotated[float, Field(strict=True, ge=0.0, le=20.0)]


@dataclass(frozen=True, kw_only=True)
class ObservationTerm:
    """One block of the observation vector: ``scale`` times what is observed less ``reference``, then clipped."""

    name: Text
    """Name of an observation of ``observation_table``. ``last_action`` is the network's output, within ``action_clip``."""
    scale: Annotated[tuple[_Factor, ...], Field(min_length=1, max_length=MOST)]
    """Factor per entry; one entry stands for all."""
    clip: Clip | Annotated[tuple[Clip, ...], Field(min_length=1, max_length=MOST)] | None = None
    """Largest magnitude after scaling, for all entries or per entry; None for no clipping."""
    reference: Annotated[tuple[Target, ...], Field(min_length=1, max_length=MOST)] | None = None
    """Subtracted before scaling, in the observation's unit, for all entries or per entry; None: the default pose for
    ``joint_position``, nothing for all others."""
    values: Annotated[tuple[Target, ...], Field(max_length=MOST)] = ()
    """The entries of ``constant``; of ``command``, those that follow the three speeds and stay as they are."""
    period: Annotated[float, Field(strict=True, gt=0.0, le=100.0)] | None = None
    """Of ``gait_phase``: time of one gait cycle [s]. The phase is 0 at each reset."""
    offsets: Annotated[tuple[Annotated[float, Field(strict=True, ge=-1.0, le=1.0)], ...], Field(min_length=1)] = (0.0,)
    """Of ``gait_phase``: shares of a cycle by which each clock is ahead, one clock per entry."""
    waves: Annotated[tuple[Literal["sin", "cos"], ...], Field(min_length=1, max_length=2)] = ("sin", "cos")
    """Of ``gait_phase``: functions of the phase; the first one of all clocks, then the second one."""
    at_rest: Literal["runs", "holds", "zeros", "half"] = "runs"
    """Of ``gait_phase``, while the command is below ``RESTING``: the clock runs, holds still, has entries of zero, or all clocks
    stand at half a cycle and begin anew afterwards."""

    size: tuple[_Extent, _Extent] = (1.6, 1.0)
    """Of ``height_scan``: length along the heading and width of the grid of points about the base [m]."""
    spacing: Annotated[float, Field(strict=True, ge=0.01, le=10.0)] = 0.1
    """Of ``height_scan``: distance between neighbouring points [m]."""
    fastest: Literal["x", "y"] = "x"
    """Of ``height_scan``: axis of neighbouring entries, along the heading (``x``) or across it; both ascend."""

    def __post_init__(self) -> None:
        check_fields(self, "contract", ContractError)
        try:
            observation(self.name)
        except ObservationError as error:
            raise ContractError(f"contract: {error}") from error
        if self.values and self.name not in ("constant", "command"):
            raise ContractError(f"contract: observation.{self.name} has values; only constant and command do")
        if self.name == "constant" and not self.values:
            raise ContractError("contract: observation.constant has no values; give a list of numbers")
        if math.prod(self.grid) > MOST:
            raise ContractError(
                f"contract: observation.{self.name} has {math.prod(self.grid)} points; at most {MOST} are"
            )
        if (self.period is None) == (self.name == "gait_phase"):
            wrong = (
                "has no period; give the time of a gait cycle [s]"
                if self.period is None
                else "has a period; only gait_phase does"
            )
            raise ContractError(f"contract: observation.{self.name} {wrong}")

    @property
    def grid(self) -> tuple[int, int]:
        """Return the numbers of points of ``height_scan`` along the heading and across it."""
        return round(self.size[0] / self.spacing) + 1, round(self.size[1] / self.spacing) + 1

    def width(self, joints: int) -> int:
        """Return the number of entries for a robot of so many joints."""
        if self.name == HEIGHT_SCAN:
            return math.prod(self.grid)
        if self.name == "gait_phase":
            return len(self.offsets) * len(self.waves)
        if self.name == "constant":
            return len(self.values)
        return (observation(self.name).width or joints) + len(self.values)


@dataclass(frozen=True, kw_only=True)
class History:
    """Past observations in a network's input; length 1 where the network keeps its own, for which ``start`` holds too."""

    length: Annotated[int, Field(strict=True, ge=1, le=1000)] = 1
    """Number of frames, the current one included."""
    order: HistoryOrder = "frame-major"
    """``frame-major``: whole frames, oldest first; ``term-major``: all frames of the first term, oldest first, then the
    next term; with ``-newest-first`` the frames are reversed.
    """
    start: Literal["zeros", "repeat"] = "zeros"
    """Content of the frames before the first one: ``zeros``, as in the published training, or ``repeat`` for copies of
    the first frame, as the robot's own controller does it."""

    def __post_init__(self) -> None:
        check_fields(self, "contract", ContractError)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of what a network is given, where that is more than one history of the whole observation."""

    terms: tuple[Text, ...] = ()
    """Observation terms in this part, in this order; empty for all."""
    length: Annotated[int, Field(strict=True, ge=1, le=1000)] | None = None
    """Number of frames, the current one included; None for that of ``history``."""
    order: HistoryOrder | None = None
    """Order of the frames; None for that of ``history``."""
    input: Annotated[str, Field(max_length=1000)] = ""
    """Input of the network: the name of an ONNX input or of an argument of ``forward``; empty for the only one. Parts of one
    input are joined."""

    def __post_init__(self) -> None:
        check_fields(self, "contract", ContractError)


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """A second network file, which runs first; what it gives is joined with the input of the main one."""

    file: Text
    """File beside the policy's."""
    input: Annotated[str, Field(max_length=1000)] = ""
    """Input of ``layout`` that goes to the encoder; empty: both are given the whole observation."""
    latent: Literal["first", "last"] = "last"
    """Place of the encoder's output in the main network's input."""

    def __post_init__(self) -> None:
        check_fields(self, "contract", ContractError)
