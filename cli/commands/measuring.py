"""Commands that read logs of real robots: replay, identify, preflight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...files.choices import WRITTEN, Choice, PolicyName
from ...gauge.request import EvaluationOptions
from ...studies.reality.request import IdentifyRequest, PreflightRequest, ReplayRequest
from ..requests import Tables, output
from ..running import command

app = typer.Typer()

_SETS = "Two or more parameter sets or their files; differences are to the first."
_MEASURED = "Folder of the comparison and its evaluations. Default: results/measured-<policy>, and results/."


@command(app, long=True)
def replay(
    request: ReplayRequest,
    out: Annotated[Path | None, output("results/replay-<log>")] = None,
    json_output: Tables = False,
) -> None:
    """Play a real robot's log again in simulation and measure the differences, by joint, in time and over frequency.

    Examples:
      gaitgauge replay chirp.npz --robot go2
      gaitgauge replay chirp.npz --parameters gauge --parameters identified.toml --fit-delay
    """
    from ..reality import run_replay

    run_replay(request, out=out, json_output=json_output)


@command(app, long=True)
def identify(
    request: IdentifyRequest,
    out: Annotated[Path | None, output("results/identify-<log>")] = None,
    json_output: Tables = False,
) -> None:
    """Identify a robot from logs of it hung up: rotor inertia, friction, gains, delay, offsets, with intervals.

    Examples:
      gaitgauge identify chirp.npz --robot go2
      gaitgauge identify chirp-kd1.npz chirp-kd3.npz --held-out --out identified
    """
    from ..reality import run_identify

    run_identify(request, out=out, json_output=json_output)


@command(app)
def measured(
    policy: PolicyName,
    choices: EvaluationOptions,
    sets: Annotated[tuple[str, ...], Choice(_SETS, None, metavar="SET...", argument=True)] = (),
    out: Annotated[Path | None, Choice(_MEASURED, WRITTEN)] = None,
    json_output: Tables = False,
) -> None:
    """Evaluate a policy under several parameter sets of its robot, side by side: what the measured robot does to the score.

    Examples:
      gaitgauge measured pretrained gauge identified --suite demo
      gaitgauge measured walk.onnx gauge identified.toml network.toml --suite gaitgauge-1-network
    """
    from ..reality import run_measured

    run_measured(policy, choices, sets, out=out, json_output=json_output)


@command(app)
def preflight(
    request: PreflightRequest,
    out: Annotated[Path | None, output("results/preflight-<log>")] = None,
    json_output: Tables = False,
) -> None:
    """Check a robot's own log against a policy before it walks: joints, signs, gains, delay, offsets, frames; exit code 1 if wrong.

    Examples:
      gaitgauge preflight pretrained hung.npz
      gaitgauge preflight walk.onnx run_data.csv --map robot-log.toml --held standing --to 5
    """
    from ..reality import run_preflight

    if not run_preflight(request, out=out, json_output=json_output):
        raise typer.Exit(1)
