"""Run work on several policies: lock the folder, say how to go on, name what was left out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import typer

from ..files.writing import LOCK, lock_folder, make_folder
from ..studies.naming import found_policies, free_folder, joined_names
from ..studies.policies import lost_policy
from ..studies.turns import Turn
from .console import Terminal, print_json, shell_command
from .errors import UserError
from .policies import policy_files
from .progress import ProgressDisplay


@contextmanager
def resumable(console: Terminal, title: str, folder: Path | None = None, *more: str) -> Iterator[ProgressDisplay]:
    """Show progress of work that keeps finished episodes: Ctrl-C says how to go on and ends with exit code 130.

    Args:
        folder: of finished episodes, where there is a single one.
        more: arguments that the command needs to go on.
    """
    try:
        with ProgressDisplay(console, title) as display:
            yield display
    except KeyboardInterrupt:
        where = "" if folder is None else f" in {folder}"
        console.say(f"stopped; every finished episode is kept{where}. Go on with:\n  {shell_command(None, *more)}")
        raise typer.Exit(130) from None


@contextmanager
def own_folder(folder: Path) -> Iterator[None]:
    """Lock a folder for this process, and create it where it is missing; an error removes a folder that was created.

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


def show_turn(display: ProgressDisplay, turn: Turn) -> None:
    """Show how far a study of several turns is."""
    text = f"{turn.number} of {turn.count}: {turn.what}"
    text += ", estimating time" * (turn.seconds_left is None)
    display.update(turn.share, text, left=turn.seconds_left)


def study_in(
    folder: Path,
    name: str,
    title: str,
    study: Callable[..., Mapping[str, Any]],
    show: Callable[[Terminal, Mapping[str, Any]], None],
    request: Any,
    *,
    data: str,
    json_output: bool,
    check: Callable[[], None] = lambda: None,
) -> Mapping[str, Any]:
    """Make a study in a folder of its own, print it and its files; return its results.

    Args:
        name: its page is ``<name>.html``.
        check: called in the locked folder before anything is played.
    """
    # the folder first: an error in it is shown before anything is played
    with own_folder(folder), ProgressDisplay(Terminal(stderr=True), title) as display:
        check()
        command = ["gaitgauge", *sys.argv[1:]]
        results = study(request, folder, command=command, watch=partial(show_turn, display))
    show_results(results, show, folder / data, folder / f"{name}.html", json_output=json_output)
    return results


def show_results(
    results: Mapping[str, Any],
    show: Callable[[Terminal, Mapping[str, Any]], None],
    data: Path,
    page: Path,
    *,
    json_output: bool,
) -> None:
    """Print results as JSON; else show them, and where their file and page are."""
    if json_output:
        print_json(results)
        return
    console = Terminal()
    show(console, results)
    console.say(f"results  {data}\npage     {page}")


def make_study(
    name: str,
    data: str,
    title: str,
    study: Callable[..., Mapping[str, Any]],
    show: Callable[[Terminal, Mapping[str, Any]], None],
    request: Any,
    *,
    out: Path | None,
    json_output: bool,
) -> None:
    """Make a study policy by policy, print it and its files; exit code 1 where something was left out.

    Args:
        name: of the study: its page is ``<name>.html``, its folder by default ``results/<name>-<policies>``.
    """
    files = found_policies(policy_files(request.policies))
    usual = Path("results") / f"{name}-{joined_names(request.policies)}"
    folder = out or free_folder(usual, lambda path: lost_policy(path / data, files) is None)
    request = replace(request, policies=policy_files(request.policies))

    def check() -> None:
        if lost := lost_policy(folder / data, files):
            raise UserError(f"'{folder}' holds policy {lost}, which would be lost; give another folder with --out")

    results = study_in(folder, name, title, study, show, request, data=data, json_output=json_output, check=check)
    errors = Terminal(stderr=True)
    for refused in results["refused"]:
        errors.say(f"{refused['what']} was left out: {refused['reason']}")
    if results["refused"]:
        raise typer.Exit(1)
