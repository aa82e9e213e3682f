"""The ground of a suite, and the masses and distances on it, in the robot's own measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from ..robots import Robot
from ..robots.anatomy.body_plan import body_plan
from ..terrains.base import Terrain
from ..terrains.measured import measured_terrain
from ..terrains.registry import make_terrain
from .metric_rules import GO2_LEG, GO2_MASS


@dataclass(frozen=True, kw_only=True)
class GroundRules:
    """Terrains in the robot's own measure: lengths grow with its leg; payloads, and the target's radius, with mass and leg."""

    rise: Mapping[str, Annotated[float, Field(gt=0.0, le=1.0)]]
    """Heights of each terrain family as a share of those that the published terrains have in this measure."""


def build_terrain(rules: GroundRules | None, robot: Robot, name: str, level: int | None) -> Terrain:
    """Return a terrain for a robot: in its own measure where a suite has such rules, else as published.

    Raises:
        TerrainError: no such terrain, or none of the gauge's own in a suite with such rules.
    """
    if rules is None:
        return make_terrain(name, level)
    rise = rules.rise.get(name.partition("_")[0], 1.0)
    return measured_terrain(name, level or 0, leg=body_plan(robot).leg_length, rise=rise)


def heavier(rules: GroundRules | None, robot: Robot) -> float:
    """Return the factor on a suite's payloads: 1, or the robot's mass over the Go2's."""
    return 1.0 if rules is None else body_plan(robot).mass / GO2_MASS


def longer(rules: GroundRules | None, robot: Robot) -> float:
    """Return the factor on a suite's lengths: 1, or the robot's leg over the Go2's."""
    return 1.0 if rules is None else body_plan(robot).leg_length / GO2_LEG
