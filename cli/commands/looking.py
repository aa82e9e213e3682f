"""Commands that look at what there is: list, doctor."""

from __future__ import annotations

from typing import Annotated

import typer

from .. import completion
from ..errors import report_errors

app = typer.Typer()

LISTS = ("robots", "terrains", "backends", "suites", "scenarios", "policies", "tasks")
"""What can be listed."""


@app.command("list")
@report_errors
def list_command(
    what: Annotated[
        str,
        typer.Argument(
            help="robots, terrains, backends, suites, scenarios, policies or tasks.",
            autocompletion=completion.of(*LISTS),
        ),
    ],
) -> None:
    """List what can be named on the command line.

    Examples:
      gaitgauge list suites
      gaitgauge list policies
    """
    from ..inspect import list_things

    list_things(what)


@app.command()
@report_errors
def doctor() -> None:
    """Check packages, engines, GPU and rendering of this machine, and say what to do about each problem.

    Examples:
      gaitgauge doctor
    """
    from ..doctor import examine

    if not examine():
        raise typer.Exit(1)
