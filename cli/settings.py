"""Print every setting of a task with its value and its meaning (``gaitgauge train --list-settings``)."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

from rich.text import Text

from ..training.run.request import TrainRequest
from ..training.tasks import find_task, named_robot
from .console import Terminal, shell_command

_WIDTH = 80


def print_settings(request: TrainRequest) -> None:
    """Print the settings of a task as the other options change them, group by group.

    Raises:
        TaskError: no such task, or a key or value that does not fit.
    """
    chosen = find_task(request.task, request.own_overrides(), robot=request.robot)
    console = Terminal()

    def say(text: str, indent: int, style: str = "") -> None:
        for line in textwrap.wrap(text, _WIDTH, initial_indent=" " * indent, subsequent_indent=" " * indent):
            console.say(Text(line, style))

    say(f"{chosen.shown}: {chosen.title}. Change a setting with KEY=VALUE, for example", 0)
    named = request.robot or named_robot(request.own_overrides())
    robot = ["--robot", named] if named else []
    say(shell_command(["train", request.task, *robot, "training.run.iterations=3000"]), 0)
    for root, configuration in (("environment", chosen.environment), ("training", chosen.training)):
        for group, meaning, entries in _groups(root, configuration):
            console.say(Text(f"\n{group}", "bold"))
            say(meaning, 2, "dim")
            for name, value, text in entries:
                console.say(Text.assemble(f"  {name} = ", (value, "cyan")))
                say(text, 6, "dim")


def _groups(path: str, node: Any, meaning: str = "") -> Iterator[tuple[str, str, list[tuple[str, str, str]]]]:
    """Yield a dataclass's own settings (name, value, meaning), then those of the dataclasses inside it."""
    texts = field_texts(node.__class__)
    plain = [(name, _shown(value), texts.get(name, "")) for name, value in _children(node) if not _holds_more(value)]
    if plain:
        yield path, meaning, plain
    for name, value in _children(node):
        if is_dataclass(value):
            yield from _groups(f"{path}.{name}", value, _meaning(value, texts.get(name, "")))
        elif _holds_more(value):
            for i, element in enumerate(value):
                yield from _groups(f"{path}.{name}.{getattr(element, 'name', i)}", element, _meaning(element))


def _children(node: Any) -> list[tuple[str, Any]]:
    return [(f.name, getattr(node, f.name)) for f in fields(node)]


def _holds_more(value: Any) -> bool:
    return is_dataclass(value) or (isinstance(value, tuple) and any(is_dataclass(v) for v in value))


def _shown(value: Any) -> str:
    """Return a value as the command line takes it."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ",".join(_shown(v) for v in value) or "()"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _meaning(node: Any, text: str = "") -> str:
    """Return the first sentence on a group: of the field that holds it, or of its class."""
    words = text or " ".join((inspect.getdoc(node) or "").replace("``", "").split())
    return words.partition(". ")[0].rstrip(".")


@cache
def field_texts(kind: type[Any]) -> dict[str, str]:
    """Return the text under each field of a dataclass, by field name."""
    texts: dict[str, str] = {}
    for base in reversed([k for k in kind.__mro__ if is_dataclass(k)]):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(definition, ast.ClassDef)
        name = ""
        for node in definition.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                name = node.target.id
            elif name and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                texts[name] = " ".join(str(node.value.value).replace("``", "").split())
                name = ""
            else:
                name = ""
    return texts
