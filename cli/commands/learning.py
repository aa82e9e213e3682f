"""Commands that learn: train and sweep."""

from __future__ import annotations

from typing import Annotated

import typer

from ...files.choices import SPAN, Choice
from ...training.run.request import TrainRequest
from ..requests import SweepRequest
from ..running import command

app = typer.Typer()

_TIME = "Stop after this wall-clock time, building included: seconds, 9m, 2h or 1h30m."


@command(app)
def train(
    request: TrainRequest,
    time: Annotated[str | None, Choice(_TIME, SPAN)] = None,
    list_settings: Annotated[bool, Choice("Print every setting of the task with its default, and end.")] = False,
) -> None:
    """Train a policy; Ctrl-C or SIGTERM writes a checkpoint and says how to go on.

    Examples:
      gaitgauge train go2-moe-cts
      gaitgauge train rough --robot go1 --num-envs 2048 --time 1h30m
      gaitgauge train go2-moe-cts --init-from pretrained environment.push.linear=0.6
      gaitgauge train go2-moe-cts --resume latest
    """
    if list_settings:
        from ..settings import print_settings

        print_settings(request)
    else:
        from ..train import run_training

        run_training(request, time)


@command(app, long=True)
def sweep(request: SweepRequest) -> None:
    """Train a list of tasks, settings and seeds on the GPUs there are, gauge each, and compare; goes on where it stopped.

    Examples:
      gaitgauge sweep benchmarks/sweeps/baselines.toml
      gaitgauge sweep trainings.toml --report
      gaitgauge sweep trainings.toml --time 25m --keep finished
    """
    from ..sweep import run_sweep

    run_sweep(request)
