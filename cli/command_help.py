"""Prepare the help of all commands: text as it is written, options in groups, examples at the end.

The command lines below ``Examples:`` in a command's docstring become the end of its help.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.markup import escape
from typer.core import TyperArgument, TyperGroup, TyperOption

COMMAND_GROUPS: Mapping[str, tuple[str, ...]] = {
    "Judge": ("evaluate", "compare", "verify", "board"),
    "Study": ("jury", "consistency", "validate", "trial", "worst", "latent", "sweep"),
    "Real robots": ("replay", "identify", "measured", "preflight"),
    "Learn": ("train",),
    "Use": ("play", "export", "import", "contract"),
    "Look": ("list", "doctor", "robot", "warmup"),
}
"""Commands by their heading in the help."""
_FEW = 6
"""Options of a command up to which it needs no groups."""
_EXAMPLES = "\n\nExamples:\n"


class Program(TyperGroup):
    """Group all commands and prepare their help. Typer hands help texts to rich as markup, which would eat ``[m/s]``."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.help = escape(self.help or "")
        for command in self.commands.values():
            _prepare(command)
            command.rich_help_panel = next((g for g, names in COMMAND_GROUPS.items() if command.name in names), None)  # type: ignore[attr-defined]


def _prepare(command: Any) -> None:
    """Prepare the help of a command, or of a group of commands."""
    text, _, examples = (command.help or "").partition(_EXAMPLES)
    command.help = escape(text)
    if examples:
        command.epilog = "Examples:\n" + escape(examples.rstrip())
    options = [p for p in command.params if isinstance(p, TyperOption) and p.name != "help"]
    for parameter in command.params:
        if isinstance(parameter, TyperOption | TyperArgument) and parameter.help:
            parameter.help = escape(parameter.help)
    for option in options if len(options) <= _FEW else ():
        option.rich_help_panel = None
    if isinstance(command, TyperGroup):
        for each in command.commands.values():
            _prepare(each)
