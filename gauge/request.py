"""Say what is to be evaluated, and how. The command line and the Python API are made of these fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ..files.choices import (
    PLAYED,
    Choice,
    ClusterAddress,
    ContractName,
    DeviceName,
    EngineName,
    ParameterSet,
    PolicyName,
    RobotName,
    SuiteName,
    TerrainNames,
    ThreadCount,
    Trust,
)


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """Options of an evaluation. Empty tuples and None stand for the suite's own choice."""

    pipeline: Annotated[
        str,
        Choice(
            "base: one environment and seed; multi: one level, all frictions and seeds; level: find the highest level; stress: all.",
            PLAYED,
            values=("base", "multi", "level", "stress"),
        ),
    ] = "stress"
    suite: SuiteName = "gaitgauge-1"
    backend: EngineName = "mujoco"
    device: DeviceName = None
    robot: RobotName = None
    contract: ContractName = None
    parameters: ParameterSet = None
    terrains: TerrainNames = ()
    level: Annotated[int | None, Choice("Play at this level (1-10) instead of searching for the highest.", PLAYED)] = (
        None
    )
    frictions: Annotated[
        tuple[float, ...], Choice("Friction coefficient; repeatable. Default: the suite's.", PLAYED)
    ] = ()
    payloads: Annotated[
        tuple[float, ...], Choice("Mass on the base [kg]; repeatable. Default: the suite's.", PLAYED)
    ] = ()
    seeds: Annotated[
        tuple[int, ...], Choice("Seed of the quality episodes; repeatable. Default: the suite's.", PLAYED)
    ] = ()
    threads: ThreadCount = None
    trust: Trust = False


@dataclass(frozen=True, kw_only=True)
class Request(EvaluationOptions):
    """One evaluation."""

    policy: PolicyName
    cluster: ClusterAddress = None
