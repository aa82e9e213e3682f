"""Run work on several policies: lock the folder, say how to go on, name what was left out."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import typer

from ..files.parsing import one_line, read_results
from ..files.writing import LOCK, lock_folder, make_folder
from ..studies.naming import found_policies, free_folder, joined_names
from ..studies.policies import lost_policy
from ..studies.turns import Turn
from .console import Terminal, print_json, shell_command, without_options
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


def study_folder(name: str, data: str, *, out: Path | None, of: str, policies: Sequence[str] = ()) -> Path:
    """Return ``out``, or the first of ``results/<name>-<of>``, ``…-2`` … in which no other results would be lost."""
    return out or free_folder(Path("results") / f"{name}-{of}", lambda path: _lost(path / data, policies) is None)


def keep_others(file: Path, policies: Sequence[str] = ()) -> None:
    """Refuse to write over results of other policies or of another command line. Raises UserError."""
    if lost := _lost(file, policies):
        raise UserError(f"'{file.parent}' holds {lost}, which would be lost; give another folder with --out")


def _lost(file: Path, policies: Sequence[str] = ()) -> str | None:
    """Return what of other policies or of another command line a study's results hold; None for nothing."""
    if policies and (lost := lost_policy(file, policies)):
        return f"policy {lost}"
    try:
        command = read_results(file, "results", UserError)["provenance"]["command"] if file.is_file() else ""
        same = not command or _asked(shlex.split(command)[1:]) == _asked(sys.argv[1:])
    except (UserError, KeyError, TypeError, ValueError):
        return None  # not what a study wrote
    return None if same else f"the results of '{one_line(command, 200)}'"


def _asked(arguments: Sequence[str]) -> list[str]:
    """Return arguments without those that change no result."""
    return [word for word in without_options(arguments, "--out", "--threads") if word != "--json"]


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
    policies: Sequence[str] = (),
) -> Mapping[str, Any]:
    """Make a study in a folder of its own, print it and its files; return its results.

    Args:
        name: its page is ``<name>.html``.
        policies: files of the policies that are studied.

    Raises:
        UserError: the folder holds other results.
    """
    # the folder first: an error in it is shown before anything is played
    with own_folder(folder), ProgressDisplay(Terminal(stderr=True), title) as display:
        keep_others(folder / data, policies)
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
    folder = study_folder(name, data, out=out, of=joined_names(request.policies), policies=files)
    request = replace(request, policies=policy_files(request.policies))
    results = study_in(folder, name, title, study, show, request, data=data, json_output=json_output, policies=files)
    errors = Terminal(stderr=True)
    for refused in results["refused"]:
        errors.say(f"{refused['what']} was left out: {refused['reason']}")
    if results["refused"]:
        raise typer.Exit(1)
