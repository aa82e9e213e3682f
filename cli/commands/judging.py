"""Commands that judge and study: evaluate, compare, verify, board, validate, jury, consistency, trial, worst, latent."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...files.choices import PLACE, WRITTEN, Choice
from ...gauge.request import EvaluationOptions, Request
from ...studies.consistency.request import StudyRequest
from ...studies.jury.request import JuryRequest
from ...studies.latent.request import LatentRequest
from ...studies.trials.request import TrialRequest
from ...studies.worst.request import WorstRequest
from ..errors import UserError
from ..requests import Tables, VerifyRequest, output, resume
from ..running import command

app = typer.Typer()

_CONTESTANTS = "Two or more of: policies, as for evaluate; results folders; results.json files and score cards."
_ENGINES = (
    "Engines, separated by commas; NAME@option=value changes a physics option (mujoco@timestep=0.005). Default: two."
)
_JURY = "Engines, separated by commas. Default: one of each family that is installed, and MuJoCo with feet that turn freely."
_OTHERS = "Engines in which failures are played again, separated by commas. Default: MuJoCo with feet that turn freely, and Drake."
_COMPARED = "Folder of the comparison and its evaluations. Default: results/compare-<names>, and results/."
_TABLES = "The measured table, then one for each simulator (CSV; docs/guides/validate.md)."
_EXAMPLE = Choice("Tables that ship with the project: paper.", values=("paper",), flags=("--example",))
_SCALES = "Values are on different scales: compare the order of policies alone."


@command(app, long=True)
def evaluate(
    request: Request,
    out: Annotated[Path | None, output("results/<policy>-<suite>-<pipeline>")] = None,
    resume: Annotated[bool, resume("run")] = False,
    clip: Annotated[bool, Choice("Film the robot for the report, where this machine can draw.")] = True,
    json_output: Tables = False,
) -> None:
    """Gauge a policy: terrains, levels, frictions, payloads, noise and latency, down to one score with its interval.

    Examples:
      gaitgauge evaluate pretrained --suite demo
      gaitgauge evaluate latest --terrain stairs_fd --terrain stairs_bd --threads 8
      gaitgauge evaluate walk.onnx --pipeline multi --level 5 --friction 0.6
    """
    from ..evaluate import run_evaluation

    run_evaluation(request, out=out, resume=resume, clip=clip, json_output=json_output)


@command(app, long=True)
def compare(
    contestants: Annotated[tuple[str, ...], Choice(_CONTESTANTS, None, "policies", "A B...")],
    choices: EvaluationOptions,
    out: Annotated[Path | None, Choice(_COMPARED, WRITTEN)] = None,
    json_output: Tables = False,
) -> None:
    """Say which differences between policies are real. Policies are evaluated first; what has been played is not played again.

    Examples:
      gaitgauge compare pretrained latest
      gaitgauge compare old.gauge.pt new.gauge.pt --pipeline multi --level 3
      gaitgauge compare results/a results/b
    """
    from ..compare import run_comparison

    run_comparison(contestants, choices, out=out, json_output=json_output)


@command(app, long=True)
def verify(request: VerifyRequest) -> None:
    """Play a score card again and say whether it holds on this machine; exit code 1 where it does not.

    Examples:
      gaitgauge verify results/walk --quick
      gaitgauge verify card.json --policy walk.gauge.pt
      gaitgauge verify card.json --quick --fresh 4711
    """
    from ..verify import run_verification

    run_verification(request)


@command(app)
def board(
    folder: Annotated[Path, Choice("Folder of score cards (*.json) or of evaluations.", metavar="FOLDER")],
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
    tables: Annotated[tuple[Path, ...], Choice(_TABLES, metavar="REAL SIM...", argument=True)] = (),
    example_name: Annotated[str | None, _EXAMPLE] = None,
    ranks_only: Annotated[bool, Choice(_SCALES)] = False,
    json_output: Tables = False,
) -> None:
    """Hold predictions of simulators against measurements of a robot: errors by motion and metric, and ranks of policies.

    Examples:
      gaitgauge validate --example paper
      gaitgauge validate real.csv mujoco.csv newton.csv
    """
    from ..validate import run_validation

    run_validation(tables, example_name=example_name, ranks_only=ranks_only, json_output=json_output)


@command(app, long=True)
def jury(
    request: JuryRequest,
    engines: Annotated[str | None, Choice(_JURY, PLACE, "backends")] = None,
    out: Annotated[Path | None, output("results/<policies>-jury-<part>")] = None,
    resume: Annotated[bool, resume("jury")] = False,
    json_output: Tables = False,
) -> None:
    """Let engines of several families judge policies on the same episodes: scores, consensus, and who has learned its judge.

    Examples:
      gaitgauge jury pretrained
      gaitgauge jury latest walk.onnx --engines mujoco,mujoco@foot_condim=3
    """
    from ..jury import run_jury

    run_jury(request, engines, out=out, resume=resume, json_output=json_output)


@command(app, long=True)
def consistency(
    request: StudyRequest,
    backends: Annotated[str | None, Choice(_ENGINES, PLACE, "backends")] = None,
    out: Annotated[Path | None, output("results/<policy>-<suite>-consistency")] = None,
    resume: Annotated[bool, resume("study")] = False,
    json_output: Tables = False,
) -> None:
    """Compare physics engines on the same policy and episodes: by how much they disagree, where, and why.

    Examples:
      gaitgauge consistency pretrained
      gaitgauge consistency latest --backends mujoco,mujoco-warp,newton --suite gaitgauge-1 --attribution
    """
    from ..consistency import run_consistency

    run_consistency(request, backends, out=out, resume=resume, json_output=json_output)


@command(app, long=True)
def trial(
    request: TrialRequest,
    out: Annotated[Path | None, output("results/trial-<policies>")] = None,
    json_output: Tables = False,
) -> None:
    """Send policies through field trials (pulls, stairs, drops, a sprint …) and count how many robots come through.

    Examples:
      gaitgauge trial pretrained --repeats 20
      gaitgauge trial latest walk.onnx --scenario all
    """
    from ..trial import run_trial

    run_trial(request, out=out, json_output=json_output)


@command(app, long=True)
def worst(
    request: WorstRequest,
    others: Annotated[str | None, Choice(_OTHERS, PLACE, "backends")] = None,
    films: Annotated[bool, Choice("Film the failures of the gallery, where this machine can draw.", WRITTEN)] = True,
    out: Annotated[Path | None, output("results/worst-<policy>")] = None,
    resume: Annotated[bool, resume("search")] = False,
    json_output: Tables = False,
) -> None:
    """Search for what makes a policy fall: pushes, slips, loads, steps … within stated ranges, with a bound on its probability.

    Examples:
      gaitgauge worst pretrained
      gaitgauge worst walk.onnx --minutes 60 --threads 32 --others mujoco@foot_condim=3,newton
    """
    from ..worst import run_worst

    run_worst(request, others, films=films, out=out, resume=resume, json_output=json_output)


@command(app, long=True)
def latent(
    request: LatentRequest,
    out: Annotated[Path | None, output("results/latent-<policies>")] = None,
    json_output: Tables = False,
) -> None:
    """Look into policies: how well terrains and commands separate in the encoder's latent and in the experts' weights.

    Examples:
      gaitgauge latent pretrained
      gaitgauge latent latest --terrain flat --terrain wave --seconds 3
    """
    from ..latent import run_latent

    run_latent(request, out=out, json_output=json_output)
