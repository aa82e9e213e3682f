"""Commands that judge: evaluate, compare, verify, board, validate, consistency."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...files.choices import PLACE, PLAYED, WRITTEN, Choice, ThreadCount, Trust
from ...gauge.request import EvaluationOptions, Request
from ...studies.consistency.request import StudyRequest
from .. import options
from ..errors import UserError
from ..running import command

app = typer.Typer()


@command(app)
def evaluate(
    request: Request,
    out: Annotated[Path | None, options.output("results/<policy>-<suite>-<pipeline>")] = None,
    resume: Annotated[bool, options.resume("run")] = False,
    clip: Annotated[bool, Choice("Film the robot for the report, where this machine can draw.")] = True,
    json_output: options.Tables = False,
) -> None:
    """Gauge a policy: terrains, levels, frictions, payloads, noise and latency, down to one score with its interval.

    Examples:
      gaitgauge evaluate pretrained --suite demo
      gaitgauge evaluate latest --terrain stairs_fd --terrain stairs_bd --threads 8
      gaitgauge evaluate walk.onnx --pipeline multi --level 5 --friction 0.6
    """
    from ..evaluate import run_evaluation

    run_evaluation(request, out=out, resume=resume, clip=clip, json_output=json_output)


@command(app)
def compare(
    contestants: Annotated[
        tuple[str, ...],
        Choice(
            "Two or more of: policies, as for evaluate; results folders; results.json files and score cards.",
            argument=True,
            metavar="A B...",
            values="policies",
        ),
    ],
    choices: EvaluationOptions,
    out: Annotated[
        Path | None,
        Choice(
            "Folder of the comparison and its evaluations. Default: results/compare-<names>, and results/.", WRITTEN
        ),
    ] = None,
    json_output: options.Tables = False,
) -> None:
    """Say which differences between policies are real. Policies are evaluated first; what has been played is not played again.

    Examples:
      gaitgauge compare pretrained latest
      gaitgauge compare old.gauge.pt new.gauge.pt --pipeline multi --level 3
      gaitgauge compare results/a results/b
    """
    from ..compare import run_comparison

    run_comparison(contestants, choices, out=out, json_output=json_output)


@command(app)
def verify(
    card: Annotated[
        Path, Choice("A score card: results.json, a copy of it, or its folder.", argument=True, metavar="CARD")
    ],
    policy: Annotated[str | None, Choice("The policy's file, where it is not at the card's path.")] = None,
    suite: Annotated[str | None, Choice("The card's suite file, where its suite does not ship.", PLAYED)] = None,
    device: Annotated[str | None, Choice("cpu or cuda. Default: what the card's engine is made for.", PLACE)] = None,
    threads: ThreadCount = None,
    quick: Annotated[
        bool, Choice("One environment of each terrain, at nominal friction and payload.", PLAYED, flags=("--quick",))
    ] = False,
    fresh: Annotated[
        int | None, Choice("Play with other seeds, made from this number, instead of those that everybody knows.")
    ] = None,
    out: Annotated[Path | None, Choice("Folder of the replay. Default: results/verify-<card>.", WRITTEN)] = None,
    json_output: Annotated[bool, Choice("Print JSON instead of sentences.", WRITTEN, flags=("--json",))] = False,
    trust: Trust = False,
) -> None:
    """Play a score card again and say whether it holds on this machine; exit code 1 where it does not.

    Examples:
      gaitgauge verify results/walk --quick
      gaitgauge verify card.json --policy walk.gauge.pt
      gaitgauge verify card.json --quick --fresh 4711
    """
    from ..verify import run_verification

    run_verification(
        card,
        policy=policy,
        suite=suite,
        device=device,
        threads=threads,
        quick=quick,
        fresh=fresh,
        out=out,
        json_output=json_output,
        trust=trust,
    )


@command(app)
def board(
    folder: Annotated[
        Path, Choice("Folder of score cards (*.json) or of evaluations.", argument=True, metavar="FOLDER")
    ],
    out: Annotated[Path | None, Choice("The page. Default: board.html in the folder.")] = None,
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


@command(app)
def validate(
    tables: Annotated[
        tuple[Path, ...],
        Choice(
            "The measured table, then one for each simulator (CSV; docs/guides/validate.md).",
            argument=True,
            metavar="REAL SIM...",
        ),
    ] = (),
    example_name: Annotated[
        str | None,
        Choice("Tables that ship with the project: paper.", flags=("--example",), values=("paper",)),
    ] = None,
    ranks_only: Annotated[
        bool, Choice("Values are on different scales: compare the order of policies alone.", flags=("--ranks-only",))
    ] = False,
    json_output: options.Tables = False,
) -> None:
    """Hold predictions of simulators against measurements of a robot: errors by motion and metric, and ranks of policies.

    Examples:
      gaitgauge validate --example paper
      gaitgauge validate real.csv mujoco.csv newton.csv
    """
    from ..validate import run_validation

    run_validation(tables, example_name=example_name, ranks_only=ranks_only, json_output=json_output)


@command(app)
def consistency(
    request: StudyRequest,
    backends: Annotated[
        str,
        Choice(
            "Engines, separated by commas; NAME@option=value changes a physics option (mujoco@timestep=0.005).",
            PLACE,
            values="backends",
        ),
    ] = "mujoco,mujoco-warp,newton",
    out: Annotated[Path | None, options.output("results/<policy>-<suite>-consistency")] = None,
    resume: Annotated[bool, options.resume("study")] = False,
    json_output: options.Tables = False,
) -> None:
    """Compare physics engines on the same policy and episodes: by how much they disagree, where, and why.

    Examples:
      gaitgauge consistency pretrained --backends mujoco,mujoco-warp --device cpu --seeds 2
      gaitgauge consistency latest --terrain flat --backends mujoco,mujoco@timestep=0.005
    """
    from ..consistency import run_consistency

    run_consistency(request, backends, out=out, resume=resume, json_output=json_output)
