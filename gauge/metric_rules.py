"""The rules by which a suite takes its metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from ..files.parsing import NotNegative, Positive, Share, Text
from ..terrains.measured import GO2_LEG as GO2_LEG

GO2_MASS = 15.2064
"""Mass [kg] of the robot that scales are stated for."""


class RobotScales(NamedTuple):
    """Factors on scales that are stated for the Go2."""

    force: float = 1.0
    torque: float = 1.0
    power: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """The metrics of a suite, and how they are taken."""

    weights: Annotated[Mapping[str, Annotated[float, Field(ge=0.0, le=1000.0)]], Field(min_length=1)]
    """Exponent of each metric in the quality of a sample; its keys are the suite's metrics. A metric of weight 0 is measured alone."""
    interval: Annotated[int, Field(ge=1, le=100_000)]
    """Substeps between samples."""
    clock: Literal["run", "reset"]
    """``run``: samples on a grid that runs through resets; ``reset``: the grid starts anew at every reset."""
    angular_velocity: Literal["twice-rotated", "body", "commanded"]
    """``twice-rotated``: the reference's three components; ``body``: the same in the body frame; ``commanded``: yaw alone."""
    linear_velocity: Literal["body", "commanded"]
    """``body``: three components in the body frame; ``commanded``: the two commanded ones, forward and lateral."""
    smoothness: Literal["samples", "control-steps"]
    """Torque difference between ``samples``, or between consecutive ``control-steps``."""
    power_scale: Positive
    """RMS joint power that scores zero [W]."""
    torque_scale: Positive
    """RMS torque difference that scores zero [N·m]."""
    measure: Literal["fixed", "robot"] = "fixed"
    """``fixed``: these scales and the force of pushes hold for every robot; ``robot``: they are the Go2's, and grow with a robot's
    mass m and leg length l: pushes by m, torque by m l, power by m √l."""
    soft_limit: Annotated[float, Field(gt=0.0, le=1.0)]
    """Share of each joint range, around its middle, inside which no limit is exceeded."""
    soft_limit_joints: Annotated[tuple[Text, ...], Field(min_length=1, max_length=100)]
    """The joints that the limit metric watches: ``hip``, ``thigh`` and ``calf`` by their place in the leg, ``leg`` for all of legs,
    else parts of names."""
    motors: Literal["all", "legs"] = "all"
    """Joints over which power and torque are averaged: of robots with arms the idle ones would dilute the mean."""
    zmp_span: Positive | None = None
    """Diagonal stance span that normalizes the ZMP distance [m]; None: that of the robot's default pose."""
    contact_share: Share = 0.05
    """Share of the weight that the ground must carry for the contact metrics to be defined."""
    foot_force: NotNegative = 0.0
    """Normal force up to which a foot does not count in the friction margin, and limit of friction up to which its margin is
    zero [N]."""
    flight: Literal["left-out", "filled", "perfect"] = "left-out"
    """Value of a contact metric in the quality of a sample without contact: nothing (``left-out``), the metric's mean over
    the sub-command's other samples (``filled``; zero where there are none), or 1, which also is the metric's own value
    (``perfect``, the reference)."""
