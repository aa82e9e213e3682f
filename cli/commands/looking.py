"""Commands that look at what there is: list, doctor."""

from __future__ import annotations

from typing import Annotated

import typer

from ..errors import report_errors

app = typer.Typer()


@app.command("list")
@report_errors
def list_command(
    what: Annotated[str, typer.Argument(help="robots, terrains, backends, suites, scenarios, policies or tasks.")],
) -> None:
    """List what can be named on the command line."""
    from ..inspect import list_things

    list_things(what)


@app.command()
@report_errors
def doctor() -> None:
    """Check packages, engines, GPU and rendering of this machine, and say what to do about each problem."""
    from ..doctor import examine

    if not examine():
        raise typer.Exit(1)
