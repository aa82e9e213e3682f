"""Say what is watched, and how."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from ..files.choices import (
    LARGEST_SEED,
    PLAYED,
    WATCHED,
    WRITTEN,
    Choice,
    DeviceName,
    EngineName,
    RobotName,
    Trust,
)


@dataclass(frozen=True, kw_only=True)
class PlayRequest:
    """Policies, ground, and viewer."""

    policies: Annotated[
        tuple[str, ...],
        Choice(
            "Policy files, run directories, or latest, best, pretrained; up to four, side by side.",
            argument=True,
            metavar="POLICY...",
            values="policies",
        ),
    ]
    terrain: Annotated[str, Choice("Terrain, see 'gaitgauge list terrains'.", PLAYED, values="terrains")] = "flat"
    level: Annotated[int | None, Choice("Level of the terrain, 1 to 10. Default: 5.", PLAYED)] = None
    viewer: Annotated[
        str | None,
        Choice(
            "native: a window; viser: in a browser; video. Default: a window where there is a display.",
            WATCHED,
            values=("native", "viser", "video"),
        ),
    ] = None
    out: Annotated[
        Path | None, Choice("Write a video (.mp4); needs no display.", WRITTEN, flags=("--out", "--video"))
    ] = None
    gif: Annotated[Path | None, Choice("Write a small clip that plays by itself in a page (.gif, .webp).", WRITTEN)] = (
        None
    )
    seconds: Annotated[float | None, Choice("How long [s]. Default: 10 for a video, else no end.", PLAYED)] = None
    command: Annotated[
        tuple[float, float, float] | None,
        Choice(
            "Forward, sideways [m/s] and turning [rad/s] speed. Default: to the target, or a tour.",
            PLAYED,
            metavar="VX VY YAW",
        ),
    ] = None
    friction: Annotated[float, Choice("Friction coefficient of the ground.", PLAYED)] = 0.6
    seed: Annotated[int, Ge(0), Le(LARGEST_SEED), Choice("Seed of the robot's heading at each start.", PLAYED)] = 0
    backend: EngineName = "mujoco"
    device: DeviceName = None
    port: Annotated[int, Ge(1), Le(65535), Choice("Port of the browser's viewer.", WATCHED)] = 8080
    host: Annotated[str, Choice("Interface of the browser's viewer; 0.0.0.0 lets other machines in.", WATCHED)] = (
        "127.0.0.1"
    )
    gamepad: Annotated[bool, Choice("Steer the window with a gamepad.", WATCHED, flags=("--gamepad",))] = False
    trust: Trust = False
    robot: RobotName = None
    suite: Annotated[
        str,
        Choice(
            "Suite whose physics, gains and speeds are played with: a name or a .toml file.", PLAYED, values="suites"
        ),
    ] = "gaitgauge-1"
