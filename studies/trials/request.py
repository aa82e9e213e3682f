"""Say which policies go through which field trials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from ...files.choices import PLAYED, Choice, DeviceName
from ..request import PoliciesRequest

ALL = "all"
"""Stands for every scenario that ships with the project."""
_SCENARIOS = "Scenario (see 'gaitgauge list scenarios'), a .toml file, or all; repeatable. Default: all."
_REPEATS = "Robots in each scenario. Default: the scenario's own."


@dataclass(frozen=True, kw_only=True)
class TrialRequest(PoliciesRequest):
    """Policies and scenarios."""

    scenarios: Annotated[tuple[str, ...], Choice(_SCENARIOS, PLAYED, "scenarios")] = ()
    repeats: Annotated[int | None, Ge(1), Le(10_000), Choice(_REPEATS, PLAYED)] = None
    device: DeviceName = None
