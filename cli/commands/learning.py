"""The commands that learn: train and sweep."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from annotated_types import Ge, Le

from ...files import MOST_THREADS
from ...files.choices import PLACE, SCORES, SPAN, WRITTEN, Choice, ClusterAddress
from ...training.run.request import QUICK_SUITE, TrainRequest
from ..running import command

app = typer.Typer()


@command(app)
def train(
    request: TrainRequest,
    time: Annotated[
        str | None,
        Choice("Stop after this wall-clock time, building included: seconds, 9m, 2h or 1h30m.", SPAN),
    ] = None,
    list_settings: Annotated[
        bool, Choice("Print every setting of the task with its default, and end.", flags=("--list-settings",))
    ] = False,
    score: Annotated[bool, Choice("Gauge checkpoints in a side process; best.pt is the best of them.", SCORES)] = True,
    score_suite: Annotated[
        str, Choice("Suite of the scores, or a suite's .toml file.", SCORES, values="suites")
    ] = QUICK_SUITE,
) -> None:
    """Train a policy; Ctrl-C or SIGTERM writes a checkpoint and says how to go on.

    Examples:
      gaitgauge train go2-moe-cts
      gaitgauge train go2-flat --num-envs 2048 --time 1h30m
      gaitgauge train go2-moe-cts --init-from pretrained environment.push.linear=0.6
      gaitgauge train go2-moe-cts --resume latest
    """
    if list_settings:
        from ..settings import print_settings_of

        print_settings_of(request)
    else:
        from ..train import run_training

        run_training(replace(request, score_suite=score_suite if score else None), time)


@command(app)
def sweep(
    file: Annotated[
        Path,
        Choice("A list of trainings (.toml), such as benchmarks/sweeps/*.toml.", argument=True, metavar="FILE"),
    ],
    out: Annotated[Path | None, Choice("Output folder. Default: results/sweep-<name>.", WRITTEN)] = None,
    threads: Annotated[
        int | None, Ge(1), Le(MOST_THREADS), Choice("CPU threads of the gauge. Default: half of the cores.", PLACE)
    ] = None,
    per_gpu: Annotated[
        int,
        Ge(1),
        Le(16),
        Choice("Trainings side by side on each GPU, through NVIDIA's MPS where it is there.", PLACE),
    ] = 1,
    cluster: ClusterAddress = None,
    time: Annotated[str | None, Choice("Stop after this wall-clock time: seconds, 9m, 2h or 1h30m.", SPAN)] = None,
    report: Annotated[
        bool, Choice("Train and gauge nothing: tables and curves of what there is.", flags=("--report",))
    ] = False,
    keep: Annotated[
        Path | None,
        Choice("Keep what is trained in this folder too, small: policies, curves, results; no checkpoints."),
    ] = None,
    json_output: Annotated[bool, Choice("Print sweep.json instead of a table.", WRITTEN, flags=("--json",))] = False,
) -> None:
    """Train a list of tasks, settings and seeds on the GPUs there are, gauge each, and compare; goes on where it stopped.

    Examples:
      gaitgauge sweep benchmarks/sweeps/baselines.toml
      gaitgauge sweep trainings.toml --report
      gaitgauge sweep trainings.toml --time 25m --keep finished
    """
    from ..sweep import run_sweep

    run_sweep(
        file,
        out=out,
        threads=threads,
        per_gpu=per_gpu,
        cluster=cluster,
        time=time,
        report=report,
        keep=keep,
        json_output=json_output,
    )
