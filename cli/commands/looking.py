"""Commands that look at what there is and make it ready: list, doctor, warmup."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from annotated_types import Ge, Le

from ...files.choices import PLAYED, WRITTEN, Choice, RobotName, ThreadCount, Trust
from .. import options
from ..running import command

app = typer.Typer()

LISTS = ("robots", "terrains", "backends", "suites", "scenarios", "policies", "tasks")
"""What can be listed."""


@command(app, "list")
def list_command(
    what: Annotated[
        str,
        Choice("robots, terrains, backends, suites, scenarios, policies or tasks.", argument=True, values=LISTS),
    ],
) -> None:
    """List what can be named on the command line.

    Examples:
      gaitgauge list suites
      gaitgauge list policies
    """
    from ..inspect import list_things

    list_things(what)


@command(app)
def doctor(
    policy: Annotated[
        str | None,
        Choice(
            "A policy to examine, as for play. Default: this machine is examined.",
            argument=True,
            metavar="POLICY",
            values="policies",
        ),
    ] = None,
    contract: options.Contract = None,
    robot: RobotName = None,
    seconds: Annotated[
        float | None, Ge(0.5), Le(20.0), Choice("How long each description is played [s]. Default: 2.", PLAYED)
    ] = None,
    threads: ThreadCount = None,
    out: Annotated[Path | None, Choice("Write the contract.toml that fits best.", WRITTEN)] = None,
    json_output: Annotated[bool, Choice("Print JSON instead of a table.", WRITTEN, flags=("--json",))] = False,
    trust: Trust = False,
) -> None:
    """Say what is wrong: with this machine, or with how a policy is run; exit code 1 where something is.

    Of a policy it plays the description and every likely other one: joint order, scales, signs, history, gains, pose.

    Examples:
      gaitgauge doctor
      gaitgauge doctor policy.onnx
      gaitgauge doctor policy.onnx --contract contract.toml --out mended.toml
    """
    from ..doctor import run_doctor

    run_doctor(
        policy,
        contract=contract,
        robot=robot,
        seconds=seconds,
        threads=threads,
        out=out,
        json_output=json_output,
        trust=trust,
    )


@command(app)
def warmup(
    architectures: Annotated[
        tuple[str, ...],
        Choice(
            "GPU architecture, such as sm_90 (H100, H200); repeatable. Default: this machine's GPU.", flags=("--arch",)
        ),
    ] = (),
    backends: Annotated[
        tuple[str, ...],
        Choice(
            "mujoco-warp or newton; repeatable. Default: mujoco-warp.",
            flags=("--backend",),
            values=("mujoco-warp", "newton"),
        ),
    ] = (),
    robot: Annotated[str, Choice("Robot name, or a robot.toml.", values="robots")] = "go2",
    cache: Annotated[Path | None, Choice("Folder of the kernels. Default: Warp's own, or WARP_CACHE_PATH.")] = None,
    threads: ThreadCount = None,
) -> None:
    """Compile the GPU kernels of training and evaluating before they are needed, also for a GPU that is not here.

    Examples:
      gaitgauge warmup
      gaitgauge warmup --arch sm_90 --cache kernels
    """
    from ..warmup import run_warmup

    run_warmup(architectures, backends, robot=robot, cache=cache, threads=threads)
