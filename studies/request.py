"""Say what every study of several policies is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ..files.choices import PLACE, Choice, ContractName, FirstSeed, PolicyNames, RobotName, ThreadCount, Trust

_ENGINE = Choice("Physics engine, see 'gaitgauge list backends'.", PLACE, "backends", flags=("--backend", "--engine"))


@dataclass(frozen=True, kw_only=True)
class PoliciesRequest:
    """Policies, and how they are played."""

    policies: PolicyNames
    seed: FirstSeed = 0
    backend: Annotated[str, _ENGINE] = "mujoco"
    robot: RobotName = None
    contract: ContractName = None
    threads: ThreadCount = None
    trust: Trust = False
