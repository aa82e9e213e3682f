"""Commands for one policy: export, play, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .. import completion, options
from ..running import runs

app = typer.Typer()


@app.command()
@runs("export:run_export")
def export(
    policy: Annotated[
        str,
        typer.Argument(
            help="A checkpoint of the project's own, a run directory, or latest, best, pretrained.",
            metavar="POLICY",
            autocompletion=completion.policies,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Output folder. Default: 'exported' in the run directory, or here.")
    ] = None,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            help="torchscript, onnx, deploy or all.",
            autocompletion=completion.of("torchscript", "onnx", "deploy", "all"),
        ),
    ] = "all",
    layout: Annotated[
        str,
        typer.Option(
            help="plain: the files side by side; unitree: the folder of the published C++ controller, 'unitree'.",
            autocompletion=completion.of("plain", "unitree"),
        ),
    ] = "plain",
    trust: options.Trust = False,
    robot: options.Robot = None,
) -> None:
    """Write a policy as TorchScript, ONNX and deploy.yaml, each checked against it.

    Examples:
      gaitgauge export latest --out exported
      gaitgauge export pretrained --layout unitree --out unitree
    """


@app.command()
@runs("play:run_play")
def play(
    policies: Annotated[
        list[str],
        typer.Argument(
            help="Policy files, run directories, or latest, best, pretrained; up to four, side by side.",
            metavar="POLICY...",
            autocompletion=completion.policies,
        ),
    ],
    terrain: Annotated[
        str, typer.Option(help="Terrain, see 'gaitgauge list terrains'.", autocompletion=completion.terrains)
    ] = "flat",
    level: Annotated[int | None, typer.Option(help="Level of the terrain, 1 to 10. Default: 5.")] = None,
    viewer: Annotated[
        str | None,
        typer.Option(
            help="native: a window; viser: in a browser; video. Default: a window where there is a display.",
            autocompletion=completion.of("native", "viser", "video"),
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "--video", help="Write a video (.mp4); needs no display.")
    ] = None,
    gif: Annotated[
        Path | None, typer.Option(help="Write a small clip that plays by itself in a page (.gif, .webp).")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="How long [s]. Default: 10 for a video, else no end.")] = None,
    command: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Forward, sideways [m/s] and turning [rad/s] speed. Default: to the target, or a tour.",
            metavar="VX VY YAW",
        ),
    ] = None,
    friction: Annotated[float, typer.Option(help="Friction coefficient of the ground.")] = 0.6,
    seed: Annotated[
        int, typer.Option(min=0, max=options.LARGEST_SEED, help="Seed of the robot's heading at each start.")
    ] = 0,
    backend: options.Backend = "mujoco",
    device: options.Device = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the browser's viewer.")] = 8080,
    host: Annotated[
        str, typer.Option(help="Interface of the browser's viewer; 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    gamepad: Annotated[bool, typer.Option("--gamepad", help="Steer the window with a gamepad.")] = False,
    trust: options.Trust = False,
    robot: options.Robot = None,
    suite: Annotated[
        str,
        typer.Option(
            help="Suite whose physics, gains and speeds are played with: a name or a .toml file.",
            autocompletion=completion.suites,
        ),
    ] = "gaitgauge-1",
) -> None:
    """Watch policies walk: in MuJoCo's viewer, in a browser, or in a video file without a display.

    Examples:
      gaitgauge play pretrained --terrain stairs_fd --level 6
      gaitgauge play latest --viewer viser --command 1 0 0
      gaitgauge play old.gauge.pt new.gauge.pt --out walk.mp4
    """


@app.command("import")
@runs("inspect:import_file")
def import_command(
    source: Annotated[
        str,
        typer.Argument(
            help="TorchScript, ONNX (with a deploy.yaml beside it) or rsl_rl checkpoint.",
            autocompletion=completion.policies,
        ),
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
    trust: options.Trust = False,
    contract: Annotated[
        Path | None,
        typer.Option(
            help="A contract.toml that says how a TorchScript or ONNX file is to be run, in place of what the file says."
        ),
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Robot name, or a robot.toml. Default: go2.", autocompletion=completion.robots)
    ] = None,
) -> None:
    """Turn a foreign policy into the project's own file, with its contract.

    Examples:
      gaitgauge import policy.onnx walk.gauge.pt
      gaitgauge import policy.pt walk.gauge.pt --contract contract.toml
    """
