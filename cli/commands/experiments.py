"""Commands of the paper's experiments beside the score: trial, latent."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...studies.latent.request import LatentRequest
from ...studies.trials.request import TrialRequest
from .. import options
from ..running import command

app = typer.Typer()


@command(app)
def trial(
    request: TrialRequest,
    out: Annotated[Path | None, options.output("results/trial-<policies>")] = None,
    json_output: options.Tables = False,
) -> None:
    """Send policies through field trials (pulls, stairs, drops, a sprint …) and count how many robots come through.

    Examples:
      gaitgauge trial pretrained --repeats 20
      gaitgauge trial latest walk.onnx --scenario all
    """
    from ..trial import run_trial

    run_trial(request, out=out, json_output=json_output)


@command(app)
def latent(
    request: LatentRequest,
    out: Annotated[Path | None, options.output("results/latent-<policies>")] = None,
    json_output: options.Tables = False,
) -> None:
    """Look into policies: how well terrains and commands separate in the encoder's latent and in the experts' weights.

    Examples:
      gaitgauge latent pretrained
      gaitgauge latent latest --terrain flat --terrain wave --seconds 3
    """
    from ..latent import run_latent

    run_latent(request, out=out, json_output=json_output)
