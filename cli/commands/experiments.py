"""Commands of the paper's experiments beside the score: trial, latent."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .. import completion, options
from ..running import runs

app = typer.Typer()

EngineOption = Annotated[
    str,
    typer.Option(
        "--backend",
        "--engine",
        help="Physics engine, see 'gaitgauge list backends'.",
        autocompletion=completion.backends,
    ),
]


@app.command()
@runs("trial:run_trial")
def trial(
    policies: options.Policies,
    scenarios: Annotated[
        list[str] | None,
        typer.Option(
            "--scenario",
            help="Scenario (see 'gaitgauge list scenarios'), a .toml file, or all; repeatable. Default: all.",
            autocompletion=completion.scenarios,
        ),
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Robots in each scenario. Default: the scenario's own.")
    ] = None,
    seed: options.FirstSeed = 0,
    backend: EngineOption = "mujoco",
    device: options.Device = None,
    robot: options.Robot = None,
    threads: options.Threads = None,
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: results/trial-<policies>.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print trials.json instead of a table.")] = False,
    trust: options.Trust = False,
) -> None:
    """Send policies through field trials (pulls, stairs, drops, a sprint …) and count how many robots come through.

    Examples:
      gaitgauge trial pretrained --repeats 20
      gaitgauge trial latest walk.onnx --scenario all
    """


@app.command()
@runs("latent:run_latent")
def latent(
    policies: options.Policies,
    terrains: Annotated[
        list[str] | None,
        typer.Option(
            "--terrain", help="Terrain; repeatable. Default: the gauge's seven.", autocompletion=completion.terrains
        ),
    ] = None,
    level: Annotated[int, typer.Option(min=1, help="Level of the terrains that have levels.")] = 5,
    friction: Annotated[float, typer.Option(help="Friction coefficient of the ground.")] = 0.8,
    suite: options.Suite = "gaitgauge-1",
    seconds: Annotated[float, typer.Option(min=0.2, max=60.0, help="How long every robot walks [s].")] = 5.0,
    robots: Annotated[
        int,
        typer.Option(min=2, max=1000, help="Robots for each terrain and command; the probe is tried on each in turn."),
    ] = 4,
    seed: options.FirstSeed = 0,
    backend: EngineOption = "mujoco",
    robot: options.Robot = None,
    threads: options.Threads = None,
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: results/latent-<policies>.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print latent.json instead of tables.")] = False,
    trust: options.Trust = False,
) -> None:
    """Look into policies: how well terrains and commands separate in the encoder's latent and in the experts' weights.

    Examples:
      gaitgauge latent pretrained
      gaitgauge latent latest --terrain flat --terrain wave --seconds 3
    """
