"""Commands of the paper's experiments beside the score: trial."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import report_errors
from ..options import DeviceOption, RobotOption, ThreadsOption, TrustOption

app = typer.Typer()

PoliciesArgument = Annotated[
    list[str],
    typer.Argument(
        help="One or more policy files (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.",
        metavar="POLICY...",
    ),
]
EngineOption = Annotated[
    str, typer.Option("--backend", "--engine", help="Physics engine, see 'gaitgauge list backends'.")
]


@app.command()
@report_errors
def trial(
    policies: PoliciesArgument,
    scenario: Annotated[
        list[str] | None,
        typer.Option(help="Scenario (see 'gaitgauge list scenarios'), a .toml file, or all; repeatable. Default: all."),
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Robots in each scenario. Default: the scenario's own.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first robot; the others' follow it.")] = 0,
    backend: EngineOption = "mujoco",
    device: DeviceOption = None,
    robot: RobotOption = "go2",
    threads: ThreadsOption = None,
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: results/trial-<policies>.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print trials.json instead of a table.")] = False,
    trust: TrustOption = False,
) -> None:
    """Send policies through field trials (pulls, stairs, drops, a sprint …) and count how many robots come through."""
    from ..trial import run_trial

    run_trial(
        policies=policies,
        scenarios=tuple(scenario or ()),
        repeats=repeats,
        seed=seed,
        backend=backend,
        device=device,
        robot=robot,
        threads=threads,
        out=out,
        json_output=json_output,
        trust=trust,
    )
