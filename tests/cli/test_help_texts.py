"""What the help of every command shows, and what the shell completes."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from typing import Any, get_type_hints

import pytest
from gaitgauge.cli.command_help import COMMAND_GROUPS
from gaitgauge.cli.commands import using
from gaitgauge.cli.inspect import LISTS
from gaitgauge.cli.main import app
from typer.main import get_command
from typer.testing import CliRunner


def all_commands(group: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with the words that lead to it."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from all_commands(command, (*words, name))
        else:
            yield (*words, name), command


GROUP = get_command(app)
COMMANDS = dict(all_commands(GROUP))
BOXES = re.compile(r"[\s│╭╮╰╯─]+")


def written(command: Any) -> list[str]:
    """Help texts of a command's parameters, as they stand in the source."""
    function = command.callback.__wrapped__
    hints = get_type_hints(function, include_extras=True)
    infos = [m for hint in hints.values() for m in getattr(hint, "__metadata__", ())]
    return [info.help for info in infos if getattr(info, "help", None)]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_shows_every_text_as_it_is_written(words):
    page = CliRunner().invoke(app, [*words, "-h"], env={"COLUMNS": "400", "TERMINAL_WIDTH": "400"})
    assert page.exit_code == 0, page.output
    shown = BOXES.sub("", page.output)
    missing = [text for text in written(COMMANDS[words]) if BOXES.sub("", text) not in shown]
    assert not missing
    assert "Examples:gaitgauge" in shown


def test_units_are_part_of_what_is_compared():
    assert any("[m/s]" in text for text in written(COMMANDS["play",]))
    assert any("[kg]" in text for text in written(COMMANDS["evaluate",]))


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_examples_can_be_typed(words):
    lines = [line.strip() for line in COMMANDS[words].epilog.splitlines()[1:]]
    assert lines
    for line in lines:
        program, *rest = shlex.split(line)
        assert program == "gaitgauge"
        assert tuple(rest[: len(words)]) == words
        COMMANDS[words].make_context(words[-1], rest[len(words) :])


def test_every_command_stands_in_a_group():
    grouped = [name for names in COMMAND_GROUPS.values() for name in names]
    assert set(GROUP.commands) <= set(grouped)
    assert len(grouped) == len(set(grouped))


def test_every_command_that_takes_a_policy_takes_its_description():
    for words, command in COMMANDS.items():
        if {"policy", "policies"} & {each.name for each in command.params}:
            assert "--contract" in [name for each in command.params for name in each.opts], words


def test_long_helps_are_grouped():
    page = CliRunner().invoke(app, ["train", "-h"]).output
    assert "What is written" in page
    assert "Scores while it learns" in page


def test_what_can_be_listed_is_completed():
    assert tuple(LISTS) == using.LISTS


# ---- completion -----------------------------------------------------------------------------------------------------


def completed(command: str, parameter: str, incomplete: str = "") -> list[str]:
    """What the shell is offered for a parameter."""
    (found,) = (p for p in COMMANDS[command,].params if p.name == parameter)
    context = COMMANDS[command,].make_context(command, [], resilient_parsing=True)
    return [item.value for item in found.shell_complete(context, incomplete)]


@pytest.mark.parametrize(
    ("command", "parameter", "incomplete", "offered"),
    [
        ("evaluate", "suite", "gait", ["gaitgauge-1", "gaitgauge-1-network", "gaitgauge-biped-1"]),
        ("evaluate", "terrains", "stairs", ["stairs_bd", "stairs_fd"]),
        ("evaluate", "backend", "mujoco-", ["mujoco-warp"]),
        ("evaluate", "pipeline", "s", ["stress"]),
        ("evaluate", "robot", "go2", ["go2", "go2w"]),
        ("consistency", "backends", "mujoco,new", ["mujoco,newton"]),
        ("train", "task", "go2-moe-c", ["go2-moe-cts"]),
        ("play", "viewer", "v", ["video", "viser"]),
        ("list", "what", "r", ["robots"]),
    ],
)
def test_values_are_completed(command, parameter, incomplete, offered, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # files are offered too
    assert sorted(completed(command, parameter, incomplete)) == offered


def test_policies_of_runs_and_files_are_completed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "logs/rsl_rl/go2_flat/2026-01-01_00-00-00"
    run.mkdir(parents=True)
    (run / "best.pt").touch()
    (tmp_path / "walk.onnx").touch()
    (tmp_path / "notes.txt").touch()
    everything = completed("play", "policies")
    assert {"latest", "best", "pretrained", "walk.onnx", "logs/"} <= set(everything)
    assert "notes.txt" not in everything
    assert completed("play", "policies", "logs/") == [
        "logs/rsl_rl/go2_flat/2026-01-01_00-00-00/best.pt",
        "logs/rsl_rl/",
    ]
    assert completed("train", "resume", "l")[0] == "latest"
    assert completed("play", "policies", "nowhere/") == []


def test_the_shell_gets_values_without_an_engine():
    program = """
import sys
from gaitgauge.cli.main import main
sys.argv = ["gaitgauge"]
try:
    main()
finally:
    print(sorted({"torch", "mujoco", "warp", "newton"} & set(sys.modules)))
"""
    words = {"_GAITGAUGE_COMPLETE": "complete_bash", "COMP_WORDS": "gaitgauge evaluate --suite qu", "COMP_CWORD": "3"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=os.environ | words, check=False
    )
    assert done.stdout.split() == ["quick", "[]"], done.stderr
