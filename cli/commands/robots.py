"""Commands for robots of one's own: robot new, robot check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...files.choices import Choice
from ..running import command

app = typer.Typer()
robot = typer.Typer(no_args_is_help=True, help="Describe a robot of your own, and check it.")
app.add_typer(robot, name="robot")


@command(robot)
def new(
    model: Annotated[Path, Choice("MuJoCo model of the robot alone.", argument=True, metavar="MODEL.xml")],
    out: Annotated[Path | None, Choice("Folder of the robot.toml. Default: the model's.")] = None,
    name: Annotated[str | None, Choice("Name of the robot. Default: the model's.")] = None,
    force: Annotated[bool, Choice("Replace a robot.toml that is there.", flags=("--force",))] = False,
) -> None:
    """Write a first robot.toml from a MuJoCo model, and say what was guessed.

    Examples:
      gaitgauge robot new mine/mine.xml
    """
    from ..robot import new_robot

    new_robot(model, out=out, name=name, force=force)


@command(robot)
def check(
    robot: Annotated[
        str,
        Choice("A robot.toml, its folder, or a robot's name.", argument=True, metavar="PATH", values="robots"),
    ],
    picture: Annotated[Path | None, Choice("Picture of the standing pose (.png). Default: NAME-standing.png.")] = None,
    no_picture: Annotated[bool, Choice("Draw nothing.", flags=("--no-picture",))] = False,
    json_output: Annotated[bool, Choice("Print JSON instead of sentences.", flags=("--json",))] = False,
) -> None:
    """Check a robot's description and model, and let it stand; exit code 1 where something is wrong.

    Examples:
      gaitgauge robot check mine/robot.toml
      gaitgauge robot check go2 --no-picture
    """
    from ..robot import check_robot_files

    if not check_robot_files(robot, picture=picture, draw=not no_picture, json_output=json_output):
        raise typer.Exit(1)
