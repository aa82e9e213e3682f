"""Describe the options of commands that no other package describes; options that several commands share come first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from ..files import MOST_THREADS
from ..files.choices import (
    LARGEST_SEED,
    PLACE,
    PLAYED,
    SPAN,
    WATCHED,
    WRITTEN,
    Choice,
    ClusterAddress,
    ContractName,
    DeviceName,
    EngineName,
    ParameterSet,
    PolicyName,
    RobotName,
    ThreadCount,
    Trust,
)

Tables = Annotated[bool, Choice("Print JSON instead of tables.", WRITTEN, flags=("--json",))]


def output(default: str) -> Choice:
    """Return the choice of an output folder."""
    return Choice(f"Output folder. Default: {default}.", WRITTEN)


def resume(what: str) -> Choice:
    """Return the choice to go on with what an output folder holds."""
    return Choice(f"Go on with the {what} in the output folder.", WRITTEN)


VIEWERS = ("native", "viser", "video")
_VIEWER = "native: a window; viser: in a browser; video. Default: a window where there is a display."
_COMMAND = "Forward, sideways [m/s] and turning [rad/s] speed. Default: to the target, or a tour."
_SUITE = Choice("Suite of the physics, gains and speeds: a name or a .toml file.", PLAYED, "suites")
_WATCHED = "Policy files, run directories, or latest, best, pretrained; up to four, side by side."


@dataclass(frozen=True, kw_only=True)
class PlayRequest:
    """Hold the options of ``play``."""

    policies: Annotated[tuple[str, ...], Choice(_WATCHED, None, "policies", "POLICY...")]
    terrain: Annotated[str, Choice("Terrain, see 'gaitgauge list terrains'.", PLAYED, "terrains")] = "flat"
    level: Annotated[int | None, Choice("Level of the terrain, 1 to 10. Default: 5.", PLAYED)] = None
    viewer: Annotated[str | None, Choice(_VIEWER, WATCHED, VIEWERS)] = None
    out: Annotated[
        Path | None, Choice("Write a video (.mp4); needs no display.", WRITTEN, flags=("--out", "--video"))
    ] = None
    gif: Annotated[Path | None, Choice("Write a clip that plays by itself in a page (.gif, .webp).", WRITTEN)] = None
    seconds: Annotated[float | None, Choice("How long [s]. Default: 10 for a video, else no end.", PLAYED)] = None
    command: Annotated[tuple[float, float, float] | None, Choice(_COMMAND, PLAYED, metavar="VX VY YAW")] = None
    friction: Annotated[float, Choice("Friction coefficient of the ground.", PLAYED)] = 0.6
    seed: Annotated[int, Ge(0), Le(LARGEST_SEED), Choice("Seed of the robot's heading at each start.", PLAYED)] = 0
    backend: EngineName = "mujoco"
    device: DeviceName = None
    port: Annotated[int, Ge(1), Le(65535), Choice("Port of the browser's viewer.", WATCHED)] = 8080
    host: Annotated[str, Choice("Interface of the page; 0.0.0.0 lets other machines in.", WATCHED)] = "127.0.0.1"
    gamepad: Annotated[bool, Choice("Steer the window with a gamepad.", WATCHED)] = False
    trust: Trust = False
    robot: RobotName = None
    contract: ContractName = None
    parameters: ParameterSet = None
    suite: Annotated[str, _SUITE] = "gaitgauge-1"


_EXAMINED = "A policy to examine, as for play. Default: this machine is examined."
_EACH = "How long each description is played [s]. Default: 2."


@dataclass(frozen=True, kw_only=True)
class DoctorRequest:
    """Hold the options of ``doctor``."""

    policy: Annotated[str | None, Choice(_EXAMINED, None, "policies", "POLICY", argument=True)] = None
    contract: ContractName = None
    robot: RobotName = None
    seconds: Annotated[float | None, Ge(0.5), Le(20.0), Choice(_EACH, PLAYED)] = None
    threads: ThreadCount = None
    out: Annotated[Path | None, Choice("Write the contract.toml that fits best.", WRITTEN)] = None
    json_output: Annotated[bool, Choice("Print JSON instead of a table.", WRITTEN, flags=("--json",))] = False
    trust: Trust = False


_EXPORTED = "A checkpoint of the project's own, a run directory, or latest, best, pretrained."
LAYOUTS = ("plain", "unitree")
_LAYOUT = "plain: the files side by side; unitree: the folder of the published C++ controller, 'unitree'."
_FORMATS = ("torchscript", "onnx", "deploy", "all")


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """Hold the options of ``export``."""

    policy: Annotated[str, Choice(_EXPORTED, None, "policies", "POLICY")]
    out: Annotated[Path | None, Choice("Output folder. Default: 'exported' in the run directory, or here.")] = None
    form: Annotated[str, Choice("torchscript, onnx, deploy or all.", None, _FORMATS, flags=("--format",))] = "all"
    layout: Annotated[str, Choice(_LAYOUT, None, LAYOUTS)] = "plain"
    trust: Trust = False
    robot: RobotName = None
    contract: ContractName = None


@dataclass(frozen=True, kw_only=True)
class ShowRequest:
    """Hold the options of ``contract show``."""

    policy: PolicyName
    contract: ContractName = None
    robot: RobotName = None
    trust: Trust = False
    json_output: Annotated[bool, Choice("Print JSON instead of a table.", WRITTEN, flags=("--json",))] = False


_TRAINABLE = "Keep teacher and critic of a training checkpoint, for train --init-from."
_SOURCE = "TorchScript, ONNX (with a deploy.yaml beside it) or rsl_rl checkpoint."


@dataclass(frozen=True, kw_only=True)
class ImportRequest:
    """Hold the options of ``import``."""

    source: Annotated[str, Choice(_SOURCE, None, "policies")]
    destination: Annotated[Path, Choice("File to write, by custom NAME.gauge.pt.")]
    force: Annotated[bool, Choice("Replace the destination if it exists.")] = False
    trainable: Annotated[bool, Choice(_TRAINABLE)] = False
    raw: Annotated[bool, Choice("The same with the weights after the last update, not their average.")] = False
    trust: Trust = False
    contract: ContractName = None
    robot: Annotated[str | None, Choice("Robot name, or a robot.toml. Default: go2.", None, "robots")] = None


_QUICK = "One environment of each terrain, at nominal friction and payload."
_FRESH = "Play with other seeds, made from this number, instead of those that everybody knows."


@dataclass(frozen=True, kw_only=True)
class VerifyRequest:
    """Hold the options of ``verify``."""

    card: Annotated[Path, Choice("A score card: results.json, a copy of it, or its folder.", metavar="CARD")]
    policy: Annotated[str | None, Choice("The policy's file, where it is not at the card's path.")] = None
    suite: Annotated[str | None, Choice("The card's suite file, where its suite does not ship.", PLAYED)] = None
    contract: ContractName = None
    device: Annotated[str | None, Choice("cpu or cuda. Default: what the card's engine is made for.", PLACE)] = None
    threads: ThreadCount = None
    quick: Annotated[bool, Choice(_QUICK, PLAYED)] = False
    fresh: Annotated[int | None, Choice(_FRESH)] = None
    out: Annotated[Path | None, Choice("Folder of the replay. Default: results/verify-<card>.", WRITTEN)] = None
    json_output: Annotated[bool, Choice("Print JSON instead of sentences.", WRITTEN, flags=("--json",))] = False
    trust: Trust = False


_THREADS = "CPU threads of the gauge. Default: half of the cores."
_PER_GPU = "Trainings side by side on each GPU, through NVIDIA's MPS where it is there."
_KEEP = "Keep what is trained in this folder too, small: policies, curves, results; no checkpoints."


@dataclass(frozen=True, kw_only=True)
class SweepRequest:
    """Hold the options of ``sweep``."""

    file: Annotated[Path, Choice("A list of trainings (.toml), such as benchmarks/sweeps/*.toml.", metavar="FILE")]
    out: Annotated[Path | None, output("results/sweep-<name>")] = None
    threads: Annotated[int | None, Ge(1), Le(MOST_THREADS), Choice(_THREADS, PLACE)] = None
    per_gpu: Annotated[int, Ge(1), Le(16), Choice(_PER_GPU, PLACE)] = 1
    cluster: ClusterAddress = None
    time: Annotated[str | None, Choice("Stop after this wall-clock time: seconds, 9m, 2h or 1h30m.", SPAN)] = None
    report: Annotated[bool, Choice("Train and gauge nothing: tables and curves of what there is.")] = False
    keep: Annotated[Path | None, Choice(_KEEP)] = None
    json_output: Annotated[bool, Choice("Print sweep.json instead of a table.", WRITTEN, flags=("--json",))] = False
