"""Say which logs are replayed, identified or held against a policy, and how."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from ...files.choices import PLACE, PLAYED, Choice, ContractName, DeviceName, PolicyName, ThreadCount, Trust

_LOGS = "Logs of a robot (.npz, .csv, .mcap; docs/reference/logs.md)."
_ROBOT = "Robot name, or a robot.toml. Default: the robot that the log is of."
_MAP = "TOML file that says what a log does not: joints, signs, gains, topics (docs/reference/logs.md)."
_SETS = "Parameter set of the robot, or FILE.toml of 'gaitgauge identify'; repeatable. Default: the robot's own."
_DELAY = "Fit one delay for each log to sets that have one; the nominal set keeps its own."

Logs = Annotated[tuple[Path, ...], Choice(_LOGS, None, metavar="LOG...")]
LogRobot = Annotated[str | None, Choice(_ROBOT, PLAYED, "robots", flags=("--robot",))]


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """How logs are read."""

    robot: LogRobot = None
    mapping: Annotated[Path | None, Choice(_MAP, PLAYED, metavar="FILE", flags=("--map",))] = None
    held: Annotated[
        str | None, Choice("How the robot was held; before the log's own word.", PLAYED, ("hung", "standing"))
    ] = None
    begin: Annotated[float, Ge(0.0), Choice("Time at which to begin [s].", PLAYED, flags=("--from",))] = 0.0
    end: Annotated[float | None, Ge(0.0), Choice("Time at which to end [s].", PLAYED, flags=("--to",))] = None


@dataclass(frozen=True, kw_only=True)
class ReplayRequest(LogOptions):
    """Logs, and what plays them again."""

    logs: Logs
    parameters: Annotated[tuple[str, ...], Choice(_SETS, PLAYED, flags=("--parameters",))] = ()
    fit_delay: Annotated[bool, Choice(_DELAY, PLAYED)] = False
    backends: Annotated[
        tuple[str, ...], Choice("Engine; repeatable. Default: mujoco.", PLACE, "backends", flags=("--backend",))
    ] = ()
    device: DeviceName = None
    threads: ThreadCount = None


@dataclass(frozen=True, kw_only=True)
class IdentifyRequest(LogOptions):
    """Logs, and what is identified of them."""

    logs: Logs
    name: Annotated[str, Choice("Name of the parameter set that is written.", PLAYED)] = "identified"
    base: Annotated[
        str | None, Choice("Parameter set to start from. Default: the robot's own.", PLAYED, flags=("--parameters",))
    ] = None
    held_out: Annotated[bool, Choice("Also fit without each log in turn and judge the fit on it.", PLAYED)] = False
    draws: Annotated[int, Ge(20), Le(10_000), Choice("Draws of the bootstrap behind the intervals.", PLAYED)] = 200
    seed: Annotated[int, Ge(0), Choice("Seed of the bootstrap.", PLAYED)] = 0
    threads: ThreadCount = None


@dataclass(frozen=True, kw_only=True)
class PreflightRequest(LogOptions):
    """A policy, and a log of the robot that is to run it."""

    policy: PolicyName
    log: Annotated[Path, Choice("Log of the robot, hung up or standing.", metavar="LOG")]
    contract: ContractName = None
    trust: Trust = False
