"""Commands that judge: evaluate, compare, verify, board, validate, consistency."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .. import completion, options
from ..errors import UserError, report_errors
from ..running import runs

app = typer.Typer()


@app.command()
@runs("evaluate:run_evaluation")
def evaluate(
    policy: options.Policy,
    pipeline: Annotated[
        str,
        typer.Option(
            help="base: one environment and seed; multi: one level, all frictions and seeds; level: find the highest level; stress: all.",
            autocompletion=completion.of("base", "multi", "level", "stress"),
        ),
    ] = "stress",
    suite: options.Suite = "gaitgauge-1",
    backend: options.Backend = "mujoco",
    device: options.Device = None,
    robot: options.Robot = None,
    terrains: options.Terrains = None,
    level: options.Level = None,
    frictions: options.Frictions = None,
    payloads: options.Payloads = None,
    seeds: options.Seeds = None,
    threads: options.Threads = None,
    cluster: options.Cluster = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder. Default: results/<policy>-<suite>-<pipeline>.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in the output folder.")] = False,
    clip: Annotated[
        bool, typer.Option("--clip/--no-clip", help="Film the robot for the report, where this machine can draw.")
    ] = True,
    json_output: Annotated[bool, typer.Option("--json", help="Print results.json instead of tables.")] = False,
    trust: options.Trust = False,
) -> None:
    """Gauge a policy: terrains, levels, frictions, payloads, noise and latency, down to one score with its interval.

    Examples:
      gaitgauge evaluate pretrained --suite demo
      gaitgauge evaluate latest --terrain stairs_fd --terrain stairs_bd --threads 8
      gaitgauge evaluate walk.onnx --pipeline multi --level 5 --friction 0.6
    """


@app.command()
@runs("compare:run_comparison")
def compare(
    contestants: Annotated[
        list[str],
        typer.Argument(
            help="Two or more of: policies, as for evaluate; results folders; results.json files and score cards.",
            metavar="A B...",
            autocompletion=completion.policies,
        ),
    ],
    pipeline: Annotated[
        str,
        typer.Option(
            help="How policies are evaluated: stress, or multi at one --level.",
            autocompletion=completion.of("stress", "multi"),
        ),
    ] = "stress",
    suite: options.Suite = "gaitgauge-1",
    backend: options.Backend = "mujoco",
    device: options.Device = None,
    robot: options.Robot = None,
    terrains: options.Terrains = None,
    level: options.Level = None,
    frictions: options.Frictions = None,
    payloads: options.Payloads = None,
    seeds: options.Seeds = None,
    threads: options.Threads = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the comparison and its evaluations. Default: results/compare-<names>, and results/."
        ),
    ] = None,
    trust: options.Trust = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print comparison.json instead of tables.")] = False,
) -> None:
    """Say which differences between policies are real. Policies are evaluated first; what has been played is not played again.

    Examples:
      gaitgauge compare pretrained latest
      gaitgauge compare old.gauge.pt new.gauge.pt --pipeline multi --level 3
      gaitgauge compare results/a results/b
    """


@app.command()
@runs("verify:run_verification")
def verify(
    card: Annotated[
        Path, typer.Argument(help="A score card: results.json, a copy of it, or its folder.", metavar="CARD")
    ],
    policy: Annotated[str | None, typer.Option(help="The policy's file, where it is not at the card's path.")] = None,
    suite: Annotated[str | None, typer.Option(help="The card's suite file, where its suite does not ship.")] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu or cuda. Default: what the card's engine is made for.")
    ] = None,
    threads: options.Threads = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="One environment of each terrain, at nominal friction and payload.")
    ] = False,
    fresh: Annotated[
        int | None,
        typer.Option(help="Play with other seeds, made from this number, instead of those that everybody knows."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the replay. Default: results/verify-<card>.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print JSON instead of sentences.")] = False,
    trust: options.Trust = False,
) -> None:
    """Play a score card again and say whether it holds on this machine; exit code 1 where it does not.

    Examples:
      gaitgauge verify results/walk --quick
      gaitgauge verify card.json --policy walk.gauge.pt
      gaitgauge verify card.json --quick --fresh 4711
    """


@app.command()
@report_errors
def board(
    folder: Annotated[Path, typer.Argument(help="Folder of score cards (*.json) or of evaluations.", metavar="FOLDER")],
    out: Annotated[Path | None, typer.Option(help="The page. Default: board.html in the folder.")] = None,
) -> None:
    """Make a leaderboard page of a folder of score cards.

    Examples:
      gaitgauge board cards --out board.html
    """
    from ...studies.cards.board import write_board
    from ..console import Terminal

    if out is not None and out.suffix.lower() != ".html":
        raise UserError(f"--out is '{out}'; give a file that ends in .html")
    Terminal().say(str(write_board(folder, out or folder / "board.html")))


@app.command()
@runs("validate:run_validation")
def validate(
    tables: Annotated[
        list[Path] | None,
        typer.Argument(
            help="The measured table, then one for each simulator (CSV; docs/validate.md).", metavar="REAL SIM..."
        ),
    ] = None,
    example_name: Annotated[
        str | None,
        typer.Option(
            "--example", help="Tables that ship with the project: paper.", autocompletion=completion.of("paper")
        ),
    ] = None,
    ranks_only: Annotated[
        bool, typer.Option("--ranks-only", help="Values are on different scales: compare the order of policies alone.")
    ] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Hold predictions of simulators against measurements of a robot: errors by motion and metric, and ranks of policies.

    Examples:
      gaitgauge validate --example paper
      gaitgauge validate real.csv mujoco.csv newton.csv
    """


@app.command()
@runs("consistency:run_consistency")
def consistency(
    policies: options.Policies,
    backends: Annotated[
        str,
        typer.Option(
            help="Engines, separated by commas; NAME@option=value changes a physics option (mujoco@timestep=0.005).",
            autocompletion=completion.backends,
        ),
    ] = "mujoco,mujoco-warp,newton",
    reference: Annotated[
        str | None,
        typer.Option(
            help="Engine that the others are compared with. Default: the first.", autocompletion=completion.backends
        ),
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu or cuda, for the engines that can use a GPU. Default: a GPU.")
    ] = None,
    suite: options.Suite = "robogauge-1.1",
    robot: options.Robot = None,
    terrains: options.Terrains = None,
    frictions: Annotated[
        list[float] | None,
        typer.Option(
            "--friction", help="Friction coefficient; repeatable. Default: the nominal one; on a GPU the suite's."
        ),
    ] = None,
    levels: Annotated[
        list[int] | None,
        typer.Option("--level", help="Level (1-10) of the terrains that have levels; repeatable. Default: 3."),
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Number of seeds, at least 2. Default: 3; on a GPU 10.")] = None,
    factors: Annotated[
        list[str] | None,
        typer.Option(
            "--factor", help="Factor that the attribution switches; repeatable. Default: all (docs/consistency.md)."
        ),
    ] = None,
    margin: Annotated[
        float,
        typer.Option(min=0.0, help="Difference of quality that does not matter: below it engines are equivalent."),
    ] = 0.02,
    attribution: Annotated[bool, typer.Option(help="Switch one factor at a time and see what it does.")] = True,
    threads: options.Threads = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder. Default: results/<policy>-<suite>-consistency.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the study in the output folder.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print consistency.json instead of tables.")] = False,
    trust: options.Trust = False,
) -> None:
    """Compare physics engines on the same policy and episodes: by how much they disagree, where, and why.

    Examples:
      gaitgauge consistency pretrained --backends mujoco,mujoco-warp --device cpu --seeds 2
      gaitgauge consistency latest --terrain flat --backends mujoco,mujoco@timestep=0.005
    """
