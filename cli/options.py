"""Arguments and options that several commands share. What differs from command to command stands in the command."""

from __future__ import annotations

from typing import Annotated

import typer

from ..files import MOST_THREADS
from . import completion

PolicyArgument = Annotated[
    str,
    typer.Argument(
        help="A policy file (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.",
        metavar="POLICY",
        autocompletion=completion.policies,
    ),
]
PoliciesArgument = Annotated[
    list[str],
    typer.Argument(
        help="One or more policy files (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.",
        metavar="POLICY...",
        autocompletion=completion.policies,
    ),
]
LARGEST_SEED = 2**63 - 2**32
"""Commands count on from a seed."""

TrustOption = Annotated[
    bool,
    typer.Option("--trust", help="Run the program that a policy file of the project's own format carries inside."),
]
SuiteOption = Annotated[
    str,
    typer.Option(
        help="Suite name (see 'gaitgauge list suites') or a suite's .toml file.", autocompletion=completion.suites
    ),
]
BackendOption = Annotated[
    str, typer.Option(help="Physics engine, see 'gaitgauge list backends'.", autocompletion=completion.backends)
]
DeviceOption = Annotated[
    str | None,
    typer.Option(
        help="cpu or cuda; the default is what the engine is made for.", autocompletion=completion.of("cpu", "cuda")
    ),
]
RobotOption = Annotated[
    str | None,
    typer.Option(
        help="Robot name, or a robot.toml. Default: the robot that the policy is for.", autocompletion=completion.robots
    ),
]
TerrainsOption = Annotated[
    list[str] | None,
    typer.Option("--terrain", help="Terrain; repeatable. Default: the suite's.", autocompletion=completion.terrains),
]
LevelOption = Annotated[
    int | None, typer.Option(help="Play at this level (1-10) instead of searching for the highest.")
]
FrictionsOption = Annotated[
    list[float] | None, typer.Option("--friction", help="Friction coefficient; repeatable. Default: the suite's.")
]
PayloadsOption = Annotated[
    list[float] | None, typer.Option("--payload", help="Mass on the base [kg]; repeatable. Default: the suite's.")
]
SeedsOption = Annotated[
    list[int] | None, typer.Option("--seed", help="Seed of the quality episodes; repeatable. Default: the suite's.")
]
FirstSeedOption = Annotated[
    int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the first robot; the others' follow it.")
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(min=1, max=MOST_THREADS, help="CPU threads; results do not depend on them. Default: all cores."),
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        help="Ray cluster whose CPUs play, all that are free or as many as --threads: auto, HOST:PORT or ray://HOST:PORT. "
        "Results do not depend on it.",
        metavar="ADDRESS",
    ),
]
