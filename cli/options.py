"""Arguments and options that several commands share, by the name of the parameter. What differs stands in the command."""

from __future__ import annotations

from typing import Annotated

import typer

from ..files import MOST_THREADS
from . import completion

Policy = Annotated[
    str,
    typer.Argument(
        help="A policy file (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.",
        metavar="POLICY",
        autocompletion=completion.policies,
    ),
]
Policies = Annotated[
    list[str],
    typer.Argument(
        help="One or more policy files (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.",
        metavar="POLICY...",
        autocompletion=completion.policies,
    ),
]
LARGEST_SEED = 2**63 - 2**32
"""Commands count on from a seed."""

Trust = Annotated[
    bool,
    typer.Option("--trust", help="Run the program that a policy file of the project's own format carries inside."),
]
Suite = Annotated[
    str,
    typer.Option(
        help="Suite name (see 'gaitgauge list suites') or a suite's .toml file.", autocompletion=completion.suites
    ),
]
Backend = Annotated[
    str, typer.Option(help="Physics engine, see 'gaitgauge list backends'.", autocompletion=completion.backends)
]
Device = Annotated[
    str | None,
    typer.Option(
        help="cpu or cuda; the default is what the engine is made for.", autocompletion=completion.of("cpu", "cuda")
    ),
]
Robot = Annotated[
    str | None,
    typer.Option(
        help="Robot name, or a robot.toml. Default: the robot that the policy is for.", autocompletion=completion.robots
    ),
]
Terrains = Annotated[
    list[str] | None,
    typer.Option("--terrain", help="Terrain; repeatable. Default: the suite's.", autocompletion=completion.terrains),
]
Level = Annotated[int | None, typer.Option(help="Play at this level (1-10) instead of searching for the highest.")]
Frictions = Annotated[
    list[float] | None, typer.Option("--friction", help="Friction coefficient; repeatable. Default: the suite's.")
]
Payloads = Annotated[
    list[float] | None, typer.Option("--payload", help="Mass on the base [kg]; repeatable. Default: the suite's.")
]
Seeds = Annotated[
    list[int] | None, typer.Option("--seed", help="Seed of the quality episodes; repeatable. Default: the suite's.")
]
FirstSeed = Annotated[
    int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the first robot; the others' follow it.")
]
Threads = Annotated[
    int | None,
    typer.Option(min=1, max=MOST_THREADS, help="CPU threads; results do not depend on them. Default: all cores."),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        help="Ray cluster whose CPUs play, all that are free or as many as --threads: auto, HOST:PORT or ray://HOST:PORT. "
        "Results do not depend on it.",
        metavar="ADDRESS",
    ),
]
