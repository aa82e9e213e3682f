"""Commands for robots of one's own: robot new, robot check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .. import completion
from ..errors import report_errors
from ..running import runs

app = typer.Typer()
robot = typer.Typer(no_args_is_help=True, help="Describe a robot of your own, and check it.")
app.add_typer(robot, name="robot")


@robot.command()
@runs("robot:new_robot")
def new(
    model: Annotated[Path, typer.Argument(help="MuJoCo model of the robot alone.", metavar="MODEL.xml")],
    out: Annotated[Path | None, typer.Option(help="Folder of the robot.toml. Default: the model's.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the robot. Default: the model's.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a robot.toml that is there.")] = False,
) -> None:
    """Write a first robot.toml from a MuJoCo model, and say what was guessed.

    Examples:
      gaitgauge robot new mine/mine.xml
    """


@robot.command()
@report_errors
def check(
    robot: Annotated[
        str,
        typer.Argument(
            help="A robot.toml, its folder, or a robot's name.", metavar="PATH", autocompletion=completion.robots
        ),
    ],
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the standing pose (.png). Default: NAME-standing.png.")
    ] = None,
    no_picture: Annotated[bool, typer.Option("--no-picture", help="Draw nothing.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print JSON instead of sentences.")] = False,
) -> None:
    """Check a robot's description and model, and let it stand; exit code 1 where something is wrong.

    Examples:
      gaitgauge robot check mine/robot.toml
      gaitgauge robot check go2 --no-picture
    """
    from ..robot import check_robot_files

    if not check_robot_files(robot, picture=picture, draw=not no_picture, json_output=json_output):
        raise typer.Exit(1)
