"""Make commands of functions: a parameter that is a request becomes one option for each of the request's choices."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import MISSING, is_dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer
from annotated_types import Ge, Le

from ..files.choices import choice_of, choices
from . import completion
from .console import Terminal
from .errors import report_errors
from .progress import ProgressDisplay

Command = Callable[..., None]


def command(app: typer.Typer, name: str | None = None, *, long: bool = False) -> Callable[[Command], Command]:
    """Register a function as a command of ``app``; its docstring is the help.

    Each parameter with a ``Choice`` is an option or an argument. A parameter that is a dataclass of choices stands for all of
    them, and the function gets the dataclass. Values that may be repeated arrive as tuples.

    Args:
        long: it shows its progress, and that it starts until then.
    """

    def register(function: Command) -> Command:
        hints = get_type_hints(function, include_extras=True)
        options: dict[str, tuple[Any, Any]] = {}
        requests: dict[str, type] = {}
        for parameter in inspect.signature(function).parameters.values():
            hint = hints[parameter.name]
            if isinstance(hint, type) and is_dataclass(hint):
                requests[parameter.name] = hint
                for field, (default, kind) in choices(hint).items():
                    options[field] = (parameter.empty if default is MISSING else default, kind)
            else:
                options[parameter.name] = (parameter.default, hint)
        parameters = [_parameter(option, kind, default) for option, (default, kind) in options.items()]
        repeated = {option for option, (_, kind) in options.items() if _is_repeated(kind)}

        def run(**given: Any) -> None:
            values = {option: tuple(value or ()) if option in repeated else value for option, value in given.items()}
            made = {
                argument: request(**{field: values.pop(field) for field in choices(request)})
                for argument, request in requests.items()
            }
            with ProgressDisplay.of_start(Terminal(stderr=True), function.__name__) if long else nullcontext():
                function(**made, **values)

        functools.update_wrapper(run, function)
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        app.command(name)(report_errors(run))
        return function

    return register


def _parameter(name: str, hint: Any, default: Any) -> inspect.Parameter:
    """Return one value as Typer reads it: its type, the spelling of its option, help, group, limits and completion."""
    choice = choice_of(hint)
    assert choice is not None, f"{name} has no Choice"
    kind, *limits = get_args(hint)
    details: dict[str, Any] = {"help": choice.help, "metavar": choice.metavar, "rich_help_panel": choice.group}
    for limit in limits:
        if isinstance(limit, Ge):
            details["min"] = limit.ge
        elif isinstance(limit, Le):
            details["max"] = limit.le
    if values := choice.values:
        details["autocompletion"] = completion.KINDS[values] if isinstance(values, str) else completion.of(*values)
    argument, flags = choice.argument or default is inspect.Parameter.empty, choice.flags
    if default is False and not flags:
        flags = (f"--{name.replace('_', '-')}",)
    if _is_repeated(hint):
        kind = list[get_args(kind)[0]]  # type: ignore[misc]
        flags = flags or (f"--{name.removesuffix('s')}",)
        if default is not inspect.Parameter.empty:
            kind, default = Union[kind, None], None  # noqa: UP007
    info = typer.Argument(**details) if argument else typer.Option(*flags, **details)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def _is_repeated(hint: Any) -> bool:
    """Return whether a value is a tuple of any length, which the command line takes by repeating the option."""
    kind = get_args(hint)[0]
    return get_origin(kind) is tuple and get_args(kind)[-1] is Ellipsis
