"""Assemble the command line. Heavy packages are imported inside the commands."""

from __future__ import annotations

import atexit
import gc
import io
import os
import sys
from typing import Annotated

import typer

from .command_help import Program
from .commands import judging, learning, measuring, using
from .errors import check_folder, output_failures

app = typer.Typer(
    name="gaitgauge",
    cls=Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (judging, measuring, learning, using):
    app.add_typer(group.app)


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


def main() -> None:
    """Run the ``gaitgauge`` command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # where the terminal lacks a letter
    with output_failures():
        check_folder()
        try:
            app(args=[_kebab(a) for a in sys.argv[1:]])
        except SystemExit as end:
            _leave_gpu(end.code)
            gc.freeze()  # Python's end would search all of PyTorch for garbage, twice, in silence
            raise


def _leave_gpu(code: int | str | None) -> None:
    """End the process at once if its command failed with a GPU in use: the interpreter would give tens of gigabytes back array by array, or
    wait for the lost process of a run.
    """
    torch = sys.modules.get("torch")
    if not isinstance(code, int) or not code or torch is None or not torch.cuda.is_initialized():
        return
    atexit._run_exitfuncs()  # removes temporary folders
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _kebab(argument: str) -> str:
    """Accept --num_envs for --num-envs, as users of other training codes type it."""
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return name.replace("_", "-") + equals + value


if __name__ == "__main__":
    main()
