"""The command line: parses, calls one function of a lower package, prints. Heavy packages are imported inside the commands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from .errors import output_failures, report_errors

app = typer.Typer(
    name="gaitgauge",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(value: bool) -> None:
    if value:
        from ..version import __version__

        print(f"gaitgauge {__version__}")
        raise typer.Exit


@app.callback()
def gaitgauge(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Train legged-robot walking policies on Warp physics and judge them in an engine they never trained in."""


PolicyArgument = Annotated[
    str,
    typer.Argument(
        help="A policy file (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.", metavar="POLICY"
    ),
]

TrustOption = Annotated[
    bool,
    typer.Option("--trust", help="Run the program that a policy file of the project's own format carries inside."),
]


@app.command()
@report_errors
def evaluate(
    policy: PolicyArgument,
    pipeline: Annotated[
        str,
        typer.Option(
            help="base: one environment and seed; multi: one level, all frictions and seeds; level: find the highest level; stress: all."
        ),
    ] = "stress",
    suite: Annotated[
        str, typer.Option(help="Suite name (see 'gaitgauge list suites') or a suite's .toml file.")
    ] = "gaitgauge-1",
    backend: Annotated[str, typer.Option(help="Physics engine, see 'gaitgauge list backends'.")] = "mujoco",
    device: Annotated[str | None, typer.Option(help="cpu or cuda; the default is what the engine is made for.")] = None,
    robot: Annotated[str, typer.Option(help="Robot name, or a robot.toml.")] = "go2",
    terrain: Annotated[
        list[str] | None, typer.Option(help="Terrain; give it several times for several. Default: the suite's.")
    ] = None,
    level: Annotated[
        int | None, typer.Option(help="Play at this level (1-10) instead of searching for the highest.")
    ] = None,
    friction: Annotated[
        list[float] | None, typer.Option(help="Friction coefficient; repeatable. Default: the suite's.")
    ] = None,
    payload: Annotated[
        list[float] | None, typer.Option(help="Mass on the base [kg]; repeatable. Default: the suite's.")
    ] = None,
    seed: Annotated[
        list[int] | None, typer.Option(help="Seed of the quality episodes; repeatable. Default: the suite's.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads; results do not depend on them. Default: all cores.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder. Default: results/<policy>-<suite>-<pipeline>.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in the output folder.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print results.json instead of tables.")] = False,
    trust: TrustOption = False,
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
        trust=trust,
    )


@app.command()
@report_errors
def compare(
    contestants: Annotated[
        list[str],
        typer.Argument(
            help="Two or more of: policies, as for evaluate; results folders; results.json files and score cards.",
            metavar="A B...",
        ),
    ],
    pipeline: Annotated[
        str, typer.Option(help="How policies are evaluated: stress, or multi at one --level.")
    ] = "stress",
    suite: Annotated[
        str, typer.Option(help="Suite name (see 'gaitgauge list suites') or a suite's .toml file.")
    ] = "gaitgauge-1",
    backend: Annotated[str, typer.Option(help="Physics engine, see 'gaitgauge list backends'.")] = "mujoco",
    device: Annotated[str | None, typer.Option(help="cpu or cuda; the default is what the engine is made for.")] = None,
    robot: Annotated[str, typer.Option(help="Robot name, or a robot.toml.")] = "go2",
    terrain: Annotated[list[str] | None, typer.Option(help="Terrain; repeatable. Default: the suite's.")] = None,
    level: Annotated[
        int | None, typer.Option(help="Play at this level (1-10) instead of searching for the highest.")
    ] = None,
    friction: Annotated[
        list[float] | None, typer.Option(help="Friction coefficient; repeatable. Default: the suite's.")
    ] = None,
    payload: Annotated[
        list[float] | None, typer.Option(help="Mass on the base [kg]; repeatable. Default: the suite's.")
    ] = None,
    seed: Annotated[
        list[int] | None, typer.Option(help="Seed of the quality episodes; repeatable. Default: the suite's.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads; results do not depend on them. Default: all cores.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the comparison and its evaluations. Default: results/compare-<names>, and results/."
        ),
    ] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print comparison.json instead of tables.")] = False,
) -> None:
    """Say which differences between policies are real. Policies are evaluated first; what has been played is not played again."""
    from .compare import run_comparison

    run_comparison(
        contestants=contestants,
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
        json_output=json_output,
    )


@app.command()
@report_errors
def verify(
    card: Annotated[
        Path, typer.Argument(help="A score card: results.json, a copy of it, or its folder.", metavar="CARD")
    ],
    policy: Annotated[str | None, typer.Option(help="The policy's file, where it is not at the card's path.")] = None,
    suite: Annotated[str | None, typer.Option(help="The card's suite file, where its suite does not ship.")] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu or cuda. Default: what the card's engine is made for.")
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads. Default: all cores.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="One environment of each terrain, at nominal friction and payload.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the replay. Default: results/verify-<card>.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print JSON instead of sentences.")] = False,
    trust: TrustOption = False,
) -> None:
    """Play a score card again and say whether it holds on this machine; exit code 1 where it does not."""
    from .verify import run_verification

    run_verification(
        card=card,
        policy=policy,
        suite=suite,
        device=device,
        threads=threads,
        quick=quick,
        out=out,
        json_output=json_output,
        trust=trust,
    )


@app.command()
@report_errors
def board(
    folder: Annotated[Path, typer.Argument(help="Folder of score cards (*.json) or of evaluations.", metavar="FOLDER")],
    out: Annotated[Path | None, typer.Option(help="The page. Default: board.html in the folder.")] = None,
) -> None:
    """Make a leaderboard page of a folder of score cards."""
    from .board import run_board

    run_board(folder=folder, out=out)


@app.command()
@report_errors
def validate(
    tables: Annotated[
        list[Path] | None,
        typer.Argument(
            help="The measured table, then one for each simulator (CSV; docs/validate.md).", metavar="REAL SIM..."
        ),
    ] = None,
    example: Annotated[str | None, typer.Option(help="Tables that ship with the project: paper.")] = None,
    ranks_only: Annotated[
        bool, typer.Option("--ranks-only", help="Values are on different scales: compare the order of policies alone.")
    ] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Hold predictions of simulators against measurements of a robot: errors by motion and metric, and ranks of policies."""
    from .validate import run_validation

    run_validation(tables=tables or [], example_name=example, ranks_only=ranks_only, json_output=json_output)


@app.command()
@report_errors
def consistency(
    policies: Annotated[
        list[str],
        typer.Argument(
            help="One or more policy files (own format, TorchScript, ONNX, rsl_rl), or latest, best, pretrained.",
            metavar="POLICY...",
        ),
    ],
    backends: Annotated[
        str,
        typer.Option(
            help="Engines, separated by commas; NAME@option=value changes a physics option (mujoco@timestep=0.005)."
        ),
    ] = "mujoco,mujoco-warp,newton",
    reference: Annotated[
        str | None, typer.Option(help="Engine that the others are compared with. Default: the first.")
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu or cuda, for the engines that can use a GPU. Default: a GPU.")
    ] = None,
    suite: Annotated[
        str, typer.Option(help="Suite name (see 'gaitgauge list suites') or a suite's .toml file.")
    ] = "robogauge-1.1",
    robot: Annotated[str, typer.Option(help="Robot name, or a robot.toml.")] = "go2",
    terrain: Annotated[list[str] | None, typer.Option(help="Terrain; repeatable. Default: the suite's.")] = None,
    friction: Annotated[
        list[float] | None,
        typer.Option(help="Friction coefficient; repeatable. Default: the nominal one; on a GPU the suite's."),
    ] = None,
    level: Annotated[
        list[int] | None, typer.Option(help="Level (1-10) of the terrains that have levels; repeatable. Default: 3.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Number of seeds, at least 2. Default: 3; on a GPU 10.")] = None,
    factor: Annotated[
        list[str] | None,
        typer.Option(help="Factor that the attribution switches; repeatable. Default: all (docs/consistency.md)."),
    ] = None,
    margin: Annotated[
        float,
        typer.Option(min=0.0, help="Difference of quality that does not matter: below it engines are equivalent."),
    ] = 0.02,
    attribution: Annotated[bool, typer.Option(help="Switch one factor at a time and see what it does.")] = True,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads; results do not depend on them. Default: all cores.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder. Default: results/<policy>-<suite>-consistency.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the study in the output folder.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print consistency.json instead of tables.")] = False,
    trust: TrustOption = False,
) -> None:
    """Compare physics engines on the same policy and episodes: by how much they disagree, where, and why."""
    from .consistency import run_consistency

    run_consistency(
        policies=policies,
        backends=backends,
        reference=reference,
        device=device,
        suite=suite,
        robot=robot,
        terrains=tuple(terrain or ()),
        frictions=tuple(friction or ()),
        levels=tuple(level or ()),
        seeds=seeds,
        margin=margin,
        factors=tuple(factor or ()),
        attribution=attribution,
        threads=threads,
        out=out,
        resume=resume,
        json_output=json_output,
        trust=trust,
    )


@app.command()
@report_errors
def train(
    task: Annotated[str, typer.Argument(help="What to learn, see 'gaitgauge list tasks'.", metavar="TASK")],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(
            help="Settings of the task, such as environment.push.linear=0.6 or training.network.expert_count=4.",
            metavar="key=value",
        ),
    ] = None,
    backend: Annotated[
        str | None, typer.Option(help="Physics engine, see 'gaitgauge list backends'. Default: mujoco-warp.")
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu, cuda or cuda:N; the default is what the engine is made for.")
    ] = None,
    num_envs: Annotated[
        int | None, typer.Option(min=1, help="Parallel worlds, for each GPU. Default: the task's.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of everything random. Default: the task's.")] = None,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Updates of the whole run, resumed ones included. Default: the task's.")
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="Stop after this wall-clock time, building included: seconds, 9m, 2h or 1h30m.")
    ] = None,
    resume: Annotated[
        str | None, typer.Option(help="Continue: latest, a run directory or a model_*.pt.", metavar="latest|PATH")
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Import functions that the settings of a resumed checkpoint name.")
    ] = False,
    init_from: Annotated[
        str | None,
        typer.Option(
            help="Begin a new run with these networks: a checkpoint or a policy file.", metavar="PATH|pretrained"
        ),
    ] = None,
    run_name: Annotated[str | None, typer.Option(help="Appended to the date in the run directory's name.")] = None,
    log_root: Annotated[Path, typer.Option(help="Folder of all runs.")] = Path("logs/rsl_rl"),
    capture: Annotated[
        bool | None, typer.Option("--capture/--no-capture", help="CUDA graphs in the environment. Default: on a GPU.")
    ] = None,
    fuse: Annotated[
        bool, typer.Option("--fuse/--no-fuse", help="Compile the environment's torch parts; faster, starts slower.")
    ] = False,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of an engine that runs on the CPU.")] = 1,
    logger: Annotated[
        str | None,
        typer.Option(help="tensorboard, or wandb or neptune beside it. Default: the task's.", metavar="NAME"),
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
    score_suite: Annotated[str, typer.Option(help="Suite of the scores, or a suite's .toml file.")] = "quick",
    score_threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads of the side process. Default: half of the machine.")
    ] = None,
) -> None:
    """Train a policy; Ctrl-C or SIGTERM writes a checkpoint and says how to go on."""
    if list_settings:
        from .settings import print_settings

        print_settings(task, tuple(overrides or ()))
        return
    from .train import run_training

    run_training(
        task=task,
        overrides=tuple(overrides or ()),
        backend=backend,
        device=device,
        num_envs=num_envs,
        seed=seed,
        iterations=iterations,
        time=time,
        resume=resume,
        trust=trust,
        init_from=init_from,
        run_name=run_name,
        log_root=log_root,
        capture=capture,
        fuse=fuse,
        threads=threads,
        logger=logger,
        video_every=video_every,
        score_suite=score_suite if score else None,
        score_every=score_every,
        score_threads=score_threads,
    )


@app.command()
@report_errors
def export(
    policy: Annotated[
        str,
        typer.Argument(
            help="A checkpoint of the project's own, a run directory, or latest, best, pretrained.", metavar="POLICY"
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Output folder. Default: 'exported' in the run directory, or here.")
    ] = None,
    form: Annotated[str, typer.Option("--format", help="torchscript, onnx, deploy or all.")] = "all",
    layout: Annotated[
        str,
        typer.Option(
            help="plain: the files side by side; unitree: the folder of the published C++ controller, 'unitree'."
        ),
    ] = "plain",
    trust: TrustOption = False,
) -> None:
    """Write a policy as TorchScript, ONNX and deploy.yaml, each checked against it."""
    from .export import run_export

    run_export(policy, out=out, form=form, layout=layout, trust=trust)


@app.command()
@report_errors
def play(
    policy: Annotated[
        str, typer.Argument(help="A policy file, a run directory, or latest, best, pretrained.", metavar="POLICY")
    ],
    terrain: Annotated[str, typer.Option(help="Terrain, see 'gaitgauge list terrains'.")] = "flat",
    level: Annotated[int | None, typer.Option(help="Level of the terrain, 1 to 10. Default: 5.")] = None,
    viewer: Annotated[
        str | None,
        typer.Option(help="native: a window; viser: in a browser; video. Default: a window where there is a display."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write a video (.mp4); needs no display.")] = None,
    seconds: Annotated[float | None, typer.Option(help="How long [s]. Default: 10 for a video, else no end.")] = None,
    command: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Forward, sideways [m/s] and turning [rad/s] speed. Default: to the target, or a tour.",
            metavar="VX VY YAW",
        ),
    ] = None,
    friction: Annotated[float, typer.Option(help="Friction coefficient of the ground.")] = 0.6,
    seed: Annotated[int, typer.Option(help="Of the heading at each start.")] = 0,
    backend: Annotated[str, typer.Option(help="Physics engine, see 'gaitgauge list backends'.")] = "mujoco",
    device: Annotated[str | None, typer.Option(help="cpu or cuda; the default is what the engine is made for.")] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the browser's viewer.")] = 8080,
    host: Annotated[
        str, typer.Option(help="Interface of the browser's viewer; 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    gamepad: Annotated[bool, typer.Option("--gamepad", help="Steer the window with a gamepad.")] = False,
    trust: TrustOption = False,
) -> None:
    """Watch a policy walk: in MuJoCo's viewer, in a browser, or in a video file without a display."""
    from .play import run_play

    run_play(
        policy,
        terrain=terrain,
        level=level,
        backend=backend,
        device=device,
        viewer=viewer,
        out=out,
        seconds=seconds,
        command=command,
        friction=friction,
        seed=seed,
        port=port,
        host=host,
        gamepad=gamepad,
        trust=trust,
    )


@app.command("import")
@report_errors
def import_command(
    source: Annotated[
        str, typer.Argument(help="TorchScript, ONNX (with a deploy.yaml beside it) or rsl_rl checkpoint.")
    ],
    destination: Annotated[Path, typer.Argument(help="File to write, by custom NAME.gauge.pt.")],
    force: Annotated[bool, typer.Option("--force", help="Replace the destination if it exists.")] = False,
    trainable: Annotated[
        bool,
        typer.Option("--trainable", help="Keep teacher and critic of a training checkpoint, for train --init-from."),
    ] = False,
    raw: Annotated[
        bool, typer.Option("--raw", help="The same with the weights after the last update, not their average.")
    ] = False,
    trust: TrustOption = False,
    contract: Annotated[
        Path | None, typer.Option(help="A contract.toml that says how a TorchScript or ONNX file is to be run.")
    ] = None,
) -> None:
    """Turn a foreign policy into the project's own file, with its contract."""
    from .inspect import import_file

    import_file(source, destination, force=force, trainable=trainable or raw, raw=raw, trust=trust, contract=contract)


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
    with output_failures():
        app(args=[_kebab(a) for a in sys.argv[1:]])


def _kebab(argument: str) -> str:
    """Accept --num_envs for --num-envs, as users of other training codes type it."""
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return name.replace("_", "-") + equals + value


if __name__ == "__main__":
    main()
