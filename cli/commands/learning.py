"""The commands that learn: train and sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...files import MOST_THREADS
from .. import completion, options
from ..running import runs

app = typer.Typer()


@app.command()
@runs("settings:run_training_or_settings")
def train(
    task: Annotated[
        str,
        typer.Argument(
            help="What to learn, see 'gaitgauge list tasks'.", metavar="TASK", autocompletion=completion.tasks
        ),
    ],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(
            help="Settings of the task, such as environment.push.linear=0.6 or training.network.expert_count=4.",
            metavar="key=value",
        ),
    ] = None,
    backend: Annotated[
        str | None,
        typer.Option(
            help="Physics engine, see 'gaitgauge list backends'. Default: mujoco-warp.",
            autocompletion=completion.backends,
        ),
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu, cuda or cuda:N; the default is what the engine is made for.")
    ] = None,
    num_envs: Annotated[
        int | None, typer.Option(min=1, help="Parallel worlds, for each GPU. Default: the task's.")
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            help="Robot name, or a robot.toml; the task is scaled by its size. Default: the task's.",
            autocompletion=completion.robots,
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of everything random. Default: the task's.")] = None,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Updates of the whole run, resumed ones included. Default: the task's.")
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="Stop after this wall-clock time, building included: seconds, 9m, 2h or 1h30m.")
    ] = None,
    resume: Annotated[
        str | None,
        typer.Option(
            help="Continue: latest, a run directory or a model_*.pt.",
            metavar="latest|PATH",
            autocompletion=completion.checkpoints,
        ),
    ] = None,
    trust: Annotated[
        bool,
        typer.Option(
            "--trust",
            help="Import functions that the settings of a resumed checkpoint name; --init-from runs nothing either way.",
        ),
    ] = False,
    init_from: Annotated[
        str | None,
        typer.Option(
            help="Begin a new run with these networks: a checkpoint or a policy file.",
            metavar="PATH|pretrained",
            autocompletion=completion.policies,
        ),
    ] = None,
    run_name: Annotated[str | None, typer.Option(help="Appended to the date in the run directory's name.")] = None,
    log_root: Annotated[Path, typer.Option(help="Folder of all runs.")] = Path("logs/rsl_rl"),
    capture: Annotated[
        bool | None, typer.Option("--capture/--no-capture", help="CUDA graphs in the environment. Default: on a GPU.")
    ] = None,
    fuse: Annotated[
        bool | None, typer.Option("--fuse/--no-fuse", help="Compile the environment's torch parts. Default: on a GPU.")
    ] = None,
    threads: Annotated[
        int, typer.Option(min=1, max=MOST_THREADS, help="CPU threads of an engine that runs on the CPU.")
    ] = 1,
    logger: Annotated[
        str | None,
        typer.Option(
            help="tensorboard, or wandb or neptune beside it. Default: the task's.",
            metavar="NAME",
            autocompletion=completion.of("tensorboard", "wandb", "neptune"),
        ),
    ] = None,
    video_every: Annotated[
        int | None, typer.Option(min=1, help="Iterations between two videos, made in a side process. Default: none.")
    ] = None,
    list_settings: Annotated[
        bool, typer.Option("--list-settings", help="Print every setting of the task with its default, and end.")
    ] = False,
    score: Annotated[
        bool,
        typer.Option("--score/--no-score", help="Gauge checkpoints in a side process; best.pt is the best of them."),
    ] = True,
    score_every: Annotated[
        int | None, typer.Option(min=1, help="Iterations between two scores. Default: the task's.")
    ] = None,
    score_suite: Annotated[
        str, typer.Option(help="Suite of the scores, or a suite's .toml file.", autocompletion=completion.suites)
    ] = "quick",
    score_threads: Annotated[
        int | None,
        typer.Option(min=1, max=MOST_THREADS, help="CPU threads of the side process. Default: half of the machine."),
    ] = None,
) -> None:
    """Train a policy; Ctrl-C or SIGTERM writes a checkpoint and says how to go on.

    Examples:
      gaitgauge train go2-moe-cts
      gaitgauge train go2-flat --num-envs 2048 --time 1h30m
      gaitgauge train go2-moe-cts --init-from pretrained environment.push.linear=0.6
      gaitgauge train go2-moe-cts --resume latest
    """


@app.command()
@runs("sweep:run_sweep")
def sweep(
    file: Annotated[
        Path, typer.Argument(help="A list of trainings (.toml), such as benchmarks/sweeps/*.toml.", metavar="FILE")
    ],
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: results/sweep-<name>.")] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, max=MOST_THREADS, help="CPU threads of the gauge. Default: half of the cores.")
    ] = None,
    per_gpu: Annotated[
        int,
        typer.Option(min=1, max=16, help="Trainings side by side on each GPU, through NVIDIA's MPS where it is there."),
    ] = 1,
    cluster: options.Cluster = None,
    time: Annotated[str | None, typer.Option(help="Stop after this wall-clock time: seconds, 9m, 2h or 1h30m.")] = None,
    report: Annotated[
        bool, typer.Option("--report", help="Train and gauge nothing: tables and curves of what there is.")
    ] = False,
    keep: Annotated[
        Path | None,
        typer.Option(help="Keep what is trained in this folder too, small: policies, curves, results; no checkpoints."),
    ] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print sweep.json instead of a table.")] = False,
) -> None:
    """Train a list of tasks, settings and seeds on the GPUs there are, gauge each, and compare; goes on where it stopped.

    Examples:
      gaitgauge sweep benchmarks/sweeps/baselines.toml
      gaitgauge sweep trainings.toml --report
      gaitgauge sweep trainings.toml --time 25m --keep finished
    """
