"""Say which policies go through which field trials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from ...files.choices import PLAYED, Choice, DeviceName
from ..request import PoliciesRequest

ALL = "all"
"""Stands for every scenario that ships with the project."""


@dataclass(frozen=True, kw_only=True)
class TrialRequest(PoliciesRequest):
    """Policies and scenarios."""

    scenarios: Annotated[
        tuple[str, ...],
        Choice(
            "Scenario (see 'gaitgauge list scenarios'), a .toml file, or all; repeatable. Default: all.",
            PLAYED,
            flags=("--scenario",),
            values="scenarios",
        ),
    ] = ()
    repeats: Annotated[
        int | None, Ge(1), Le(10_000), Choice("Robots in each scenario. Default: the scenario's own.", PLAYED)
    ] = None
    device: DeviceName = None
