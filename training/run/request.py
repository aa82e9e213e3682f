"""Describe a training. The command line and the Python API are made of these fields."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from ...files import MOST_THREADS
from ...files.choices import PLACE, PLAYED, SCORES, SPAN, WRITTEN, Choice

LOG_ROOT = Path("logs/rsl_rl")
"""Root of the training runs: ``<LOG_ROOT>/<experiment>/<run>/``."""
_OPTIONS = {
    "environment.num_envs": "num_envs",
    "training.run.iterations": "iterations",
    "training.run.run_name": "run_name",
    "training.run.gauge_interval": "score_every",
    "training.run.video_interval": "video_every",
    "training.run.logger": "logger",
}
"""Settings that have an option of their own; ``seed`` sets two, and either may be given beside it."""


@dataclass(frozen=True, kw_only=True)
class TrainRequest:
    """A training. None stands for the resumed run's choice, or else for the task's."""

    task: Annotated[str, Choice("What to learn, see 'gaitgauge list tasks'.", None, "tasks", "TASK")]
    overrides: Annotated[
        tuple[str, ...],
        Choice(
            "Settings of the task, such as environment.push.linear=0.6 or training.network.expert_count=4.",
            argument=True,
            metavar="key=value",
        ),
    ] = ()
    backend: Annotated[
        str | None,
        Choice("Physics engine, see 'gaitgauge list backends'. Default: the task's.", PLACE, values="backends"),
    ] = None
    device: Annotated[str | None, Choice("cpu, cuda or cuda:N; the default is what the engine is made for.", PLACE)] = (
        None
    )
    gpus: Annotated[
        int | None, Ge(1), Choice("GPUs that train this policy together. Default: all, or one with cuda:N.", PLACE)
    ] = None
    num_envs: Annotated[int | None, Ge(1), Choice("Parallel worlds, for each GPU. Default: the task's.", PLACE)] = None
    robot: Annotated[
        str | None,
        Choice(
            "Robot name, or a robot.toml; the task is scaled by its size. Default: the task's.", PLAYED, values="robots"
        ),
    ] = None
    seed: Annotated[int | None, Choice("Seed of everything random. Default: the task's.", PLAYED)] = None
    iterations: Annotated[
        int | None, Ge(1), Choice("Updates of the whole run, resumed ones included. Default: the task's.", SPAN)
    ] = None
    seconds: Annotated[float, Ge(0.0)] | None = None
    """Wall-clock limit [s], building included."""
    fit: Annotated[
        bool,
        Choice(
            "With --time: shorten the run, schedules included, to the iterations that fit, once its speed is known.",
            SPAN,
        ),
    ] = False
    resume: Annotated[
        str | None,
        Choice(
            "Continue: latest, a run directory or a model_*.pt.", WRITTEN, metavar="latest|PATH", values="checkpoints"
        ),
    ] = None
    trust: Annotated[
        bool,
        Choice("Import functions that the settings of a resumed checkpoint name; --init-from runs nothing either way."),
    ] = False
    init_from: Annotated[
        str | None,
        Choice(
            "Begin a new run with these networks: a checkpoint or a policy file.",
            SPAN,
            metavar="PATH|pretrained",
            values="policies",
        ),
    ] = None
    run_name: Annotated[str | None, Choice("Appended to the date in the run directory's name.", WRITTEN)] = None
    log_root: Annotated[Path, Choice("Folder of all runs.", WRITTEN)] = LOG_ROOT
    capture: Annotated[
        bool | None,
        Choice("CUDA graphs in the environment. Default: on a GPU.", PLACE, flags=("--capture/--no-capture",)),
    ] = None
    fuse: Annotated[
        bool | None,
        Choice("Compile the environment's torch parts. Default: on a GPU.", PLACE, flags=("--fuse/--no-fuse",)),
    ] = None
    threads: Annotated[
        int | None,
        Ge(1),
        Le(MOST_THREADS),
        Choice("CPU threads of an engine that runs on the CPU. Default: all cores.", PLACE),
    ] = None
    logger: Annotated[
        str | None,
        Choice(
            "tensorboard, or wandb or neptune beside it. Default: the task's.",
            WRITTEN,
            metavar="NAME",
            values=("tensorboard", "wandb", "neptune"),
        ),
    ] = None
    video_every: Annotated[
        int | None, Ge(1), Choice("Iterations between two videos, made in a side process. Default: none.", WRITTEN)
    ] = None
    film: Annotated[
        bool,
        Choice(
            "At the end, film the policy on level ground, and on stairs if the task has some, and write a page.",
            WRITTEN,
        ),
    ] = True
    score_every: Annotated[int | None, Ge(1), Choice("Iterations between two scores. Default: the task's.", SCORES)] = (
        None
    )
    score: Annotated[bool, Choice("Gauge checkpoints in a side process; best.pt is the best of them.", SCORES)] = True
    score_suite: Annotated[
        str | None, Choice("Suite of the scores, or a suite's .toml file. Default: the task's.", SCORES, "suites")
    ] = None
    score_threads: Annotated[
        int | None,
        Ge(1),
        Le(MOST_THREADS),
        Choice("CPU threads of the side process. Default: half of the machine.", SCORES),
    ] = None

    def own_overrides(self) -> list[str]:
        """Return options and settings as overrides."""
        options = {"environment.seed": "seed", "training.run.seed": "seed"} | _OPTIONS
        given = [f"{key}={getattr(self, name)}" for key, name in options.items() if getattr(self, name) is not None]
        return given + list(self.overrides)

    def __post_init__(self) -> None:
        """Check the types and ranges of all fields, and that no option and setting contradict each other."""
        from ...files.parsing import check_fields, one_line
        from ..configuration import ConfigurationError

        check_fields(self, "what is to be trained", ConfigurationError)
        for override in self.overrides:
            key, _, value = map(str.strip, override.partition("="))
            chosen = getattr(self, _OPTIONS[key]) if key in _OPTIONS else None
            if chosen is not None and value != str(chosen):
                option = f"--{_OPTIONS[key].replace('_', '-')} {one_line(chosen)}"
                raise ConfigurationError(
                    f"{option} and {one_line(override)} contradict each other; leave one of them out"
                )
