"""What the commands that look at several policies have in common: folders, how to go on, what was left out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import typer

from ..files.writing import LOCK, lock_folder, make_folder
from ..studies.policies import lost_policy
from .console import Terminal, print_json, shell_command
from .errors import UserError
from .progress import ProgressDisplay


@contextmanager
def resumable(console: Terminal, title: str, folder: Path | None = None, *more: str) -> Iterator[ProgressDisplay]:
    """A display around work that keeps what has finished: Ctrl-C says how to go on and ends with exit code 130.

    Args:
        folder: where finished episodes are kept, where there is one such folder.
        more: arguments that the command needs to go on.
    """
    try:
        with ProgressDisplay(console, title) as display:
            yield display
    except KeyboardInterrupt:
        where = "" if folder is None else f" in {folder}"
        again = shell_command(None, *more)
        console.say(f"stopped; every finished episode is kept{where}. Go on with:\n  {again}")
        raise typer.Exit(130) from None


@contextmanager
def _own_folder(folder: Path) -> Iterator[None]:
    """A folder for this process alone, created where it is not there; an error leaves none that it created.

    Raises:
        UserError: it is a file, cannot be written to, or another process has it.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"'{folder}' is a file; give another folder with --out")
    there = folder.exists()
    make_folder(folder, UserError)
    lock = lock_folder(folder, UserError)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            (folder / LOCK).unlink()
            if not there:
                folder.rmdir()
        raise
    finally:
        lock.release()


def make_study(
    study: Callable[..., Mapping[str, Any]],
    request: Any,
    folder: Path,
    *,
    title: str,
    show: Callable[[Terminal, Mapping[str, Any]], None],
    files: tuple[str, str],
    json_output: bool,
) -> None:
    """Make a study policy by policy, print it and where its two ``files`` are; exit code 1 where something was left out."""
    errors = Terminal(stderr=True)
    # the folder first: what is wrong with it is said before anything is played
    with _own_folder(folder), ProgressDisplay(errors, title) as display:
        if lost := lost_policy(folder / files[0], request.policies):
            raise UserError(f"'{folder}' holds policy {lost}, which would be lost; give another folder with --out")
        results = study(
            request,
            folder,
            command=["gaitgauge", *sys.argv[1:]],
            watch=lambda turn, turns, name: display.update((turn - 1) / turns, f"{turn} of {turns}: {name}"),
        )
    if json_output:
        print_json(results)
    else:
        console = Terminal()
        show(console, results)
        console.say(f"results  {folder / files[0]}\npage     {folder / files[1]}")
    for refused in results["refused"]:
        errors.say(f"{refused['what']} was left out: {refused['reason']}")
    if results["refused"]:
        raise typer.Exit(1)
