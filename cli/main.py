"""The command line: parses, calls one function of a lower room, prints. Heavy packages are imported inside the commands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from .errors import report_errors

app = typer.Typer(
    name="gaitgauge",
    help="Train legged-robot walking policies on Warp physics and judge them in an engine they never trained in.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

PolicyArgument = Annotated[
    str, typer.Argument(help="A policy file (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.", metavar="POLICY")
]


@app.command()
@report_errors
def evaluate(
    policy: PolicyArgument,
    pipeline: Annotated[
        str, typer.Option(help="base: one environment, one seed; multi: one level, all frictions and seeds; level: search the highest level; stress: everything.")
    ] = "stress",
    suite: Annotated[str, typer.Option(help="Suite name (see 'gaitgauge list suites') or a suite's .toml file.")] = "gaitgauge-1",
    backend: Annotated[str, typer.Option(help="Physics engine, see 'gaitgauge list backends'.")] = "mujoco",
    device: Annotated[str | None, typer.Option(help="cpu or cuda; the default is what the engine is made for.")] = None,
    robot: Annotated[str, typer.Option(help="Robot name, or a robot.toml.")] = "go2",
    terrain: Annotated[list[str] | None, typer.Option(help="Terrain; give it several times for several. Default: the suite's.")] = None,
    level: Annotated[int | None, typer.Option(help="Play at this level (1-10) instead of searching for the highest.")] = None,
    friction: Annotated[list[float] | None, typer.Option(help="Friction coefficient; repeatable. Default: the suite's.")] = None,
    payload: Annotated[list[float] | None, typer.Option(help="Mass on the base [kg]; repeatable. Default: the suite's.")] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Seed of the quality episodes; repeatable. Default: the suite's.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads; results do not depend on them. Default: all cores.")] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: results/<policy>-<suite>-<pipeline>.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in the output folder.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print results.json instead of tables.")] = False,
) -> None:
    """Gauge a policy: terrains, levels, frictions, payloads, noise and latency, down to one score with its interval."""
    from .evaluate import run_evaluation

    run_evaluation(
        policy=policy,
        pipeline=pipeline,
        suite=suite,
        backend=backend,
        device=device,
        robot=robot,
        terrains=tuple(terrain or ()),
        level=level,
        frictions=tuple(friction or ()),
        payloads=tuple(payload or ()),
        seeds=tuple(seed or ()),
        threads=threads,
        out=out,
        resume=resume,
        json_output=json_output,
    )


@app.command("import")
@report_errors
def import_command(
    source: Annotated[str, typer.Argument(help="TorchScript, ONNX (with a deploy.yaml beside it) or rsl_rl checkpoint.")],
    destination: Annotated[Path, typer.Argument(help="File to write, by custom NAME.gauge.pt.")],
    force: Annotated[bool, typer.Option("--force", help="Replace the destination if it exists.")] = False,
) -> None:
    """Turn a foreign policy into the project's own file, with its contract."""
    from .inspect import import_file

    import_file(source, destination, force=force)


@app.command("list")
@report_errors
def list_command(
    what: Annotated[str, typer.Argument(help="robots, terrains, backends, suites, policies or tasks.")],
) -> None:
    """List what can be named on the command line."""
    from .inspect import list_things

    list_things(what)


@app.command()
@report_errors
def doctor() -> None:
    """Check packages, engines, GPU and rendering of this machine, and say what to do about each problem."""
    from .doctor import examine

    if not examine():
        raise typer.Exit(1)


def main() -> None:
    """Entry point of the ``gaitgauge`` command."""
    app(args=[_kebab(a) for a in sys.argv[1:]])


def _kebab(argument: str) -> str:
    """Accept --num_envs for --num-envs, as users of other training codes type it."""
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return name.replace("_", "-") + equals + value
