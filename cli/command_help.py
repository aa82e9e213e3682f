"""The help of all commands: text as it is written, options in groups, examples at the end.

In a command's docstring, what follows ``Examples:`` are command lines that its help ends with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.markup import escape
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

GROUPS: Mapping[str, tuple[str, ...]] = {
    "What is played": (
        "pipeline", "suite", "scenarios", "terrain", "terrains", "level", "levels", "friction", "frictions", "payloads", "seed",
        "seeds", "repeats", "robots", "robot", "command", "seconds", "quick", "factors", "attribution", "margin",
    ),
    "Where it runs": ("backend", "backends", "reference", "device", "threads", "per_gpu", "num_envs", "capture", "fuse", "cluster"),
    "How it is watched": ("viewer", "port", "host", "gamepad"),
    "Beginning and end of a run": ("iterations", "time", "init_from"),
    "Scores while it learns": ("score", "score_every", "score_suite", "score_threads"),
    "What is written": (
        "out", "gif", "video_every", "resume", "json_output", "run_name", "log_root", "logger", "form", "layout", "force",
    ),
}  # fmt: skip
"""Groups of options, by the names of their parameters: a name means the same in every command."""
COMMAND_GROUPS: Mapping[str, tuple[str, ...]] = {
    "Judge": ("evaluate", "compare", "verify", "board"),
    "Study": ("consistency", "validate", "trial", "latent", "sweep"),
    "Learn": ("train",),
    "Use": ("play", "export", "import"),
    "Look": ("list", "doctor", "robot", "warmup"),
}
"""Groups of commands."""
_FEW = 6
"""So many options need no groups."""
_EXAMPLES = "\n\nExamples:\n"


class Program(TyperGroup):
    """All commands, with their help made ready. Typer hands help texts to rich as markup, which would eat ``[m/s]``."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.help = escape(self.help or "")
        for command in self.commands.values():
            _prepare(command)
            command.rich_help_panel = _group_of(command.name or "", COMMAND_GROUPS)  # type: ignore[attr-defined]


def _prepare(command: Any) -> None:
    """Mend the help of a command, or of a group of commands."""
    assert isinstance(command, TyperCommand | TyperGroup)
    text, _, examples = (command.help or "").partition(_EXAMPLES)
    command.help = escape(text)
    if examples:
        command.epilog = "Examples:\n" + escape(examples.rstrip())
    options = [p for p in command.params if isinstance(p, TyperOption) and p.name != "help"]
    for parameter in command.params:
        if isinstance(parameter, TyperOption | TyperArgument) and parameter.help:
            parameter.help = escape(parameter.help)
    if len(options) > _FEW:
        for option in options:
            option.rich_help_panel = _group_of(option.name or "", GROUPS)
    if isinstance(command, TyperGroup):
        for each in command.commands.values():
            _prepare(each)


def _group_of(name: str, groups: Mapping[str, tuple[str, ...]]) -> str | None:
    return next((group for group, names in groups.items() if name in names), None)
