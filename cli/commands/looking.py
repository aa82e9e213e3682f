"""Commands that look at what there is and make it ready: list, doctor, warmup."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .. import completion, options
from ..running import runs

app = typer.Typer()

LISTS = ("robots", "terrains", "backends", "suites", "scenarios", "policies", "tasks")
"""What can be listed."""


@app.command("list")
@runs("inspect:list_things")
def list_command(
    what: Annotated[
        str,
        typer.Argument(
            help="robots, terrains, backends, suites, scenarios, policies or tasks.",
            autocompletion=completion.of(*LISTS),
        ),
    ],
) -> None:
    """List what can be named on the command line.

    Examples:
      gaitgauge list suites
      gaitgauge list policies
    """


@app.command()
@runs("doctor:run_doctor")
def doctor(
    policy: Annotated[
        str | None,
        typer.Argument(
            help="A policy to examine, as for play. Default: this machine is examined.",
            metavar="POLICY",
            autocompletion=completion.policies,
        ),
    ] = None,
    contract: Annotated[
        Path | None, typer.Option(help="A contract.toml that says how the policy is to be run.", metavar="PATH")
    ] = None,
    robot: options.Robot = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.5, max=20.0, help="How long each description is played [s]. Default: 2.")
    ] = None,
    threads: options.Threads = None,
    out: Annotated[Path | None, typer.Option(help="Write the contract.toml that fits best.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    trust: options.Trust = False,
) -> None:
    """Say what is wrong: with this machine, or with how a policy is run; exit code 1 where something is.

    Of a policy it plays the description and every likely other one: joint order, scales, signs, history, gains, pose.

    Examples:
      gaitgauge doctor
      gaitgauge doctor policy.onnx
      gaitgauge doctor policy.onnx --contract contract.toml --out mended.toml
    """


@app.command()
@runs("warmup:run_warmup")
def warmup(
    architectures: Annotated[
        list[str] | None,
        typer.Option(
            "--arch", help="GPU architecture, such as sm_90 (H100, H200); repeatable. Default: this machine's GPU."
        ),
    ] = None,
    backends: Annotated[
        list[str] | None,
        typer.Option(
            "--backend",
            help="mujoco-warp or newton; repeatable. Default: mujoco-warp.",
            autocompletion=completion.of("mujoco-warp", "newton"),
        ),
    ] = None,
    robot: Annotated[str, typer.Option(help="Robot name, or a robot.toml.", autocompletion=completion.robots)] = "go2",
    cache: Annotated[
        Path | None, typer.Option(help="Folder of the kernels. Default: Warp's own, or WARP_CACHE_PATH.")
    ] = None,
    threads: options.Threads = None,
) -> None:
    """Compile the GPU kernels of training and evaluating before they are needed, also for a GPU that is not here.

    Examples:
      gaitgauge warmup
      gaitgauge warmup --arch sm_90 --cache kernels
    """
