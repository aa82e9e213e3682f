"""Make commands of functions: a parameter that is a request becomes one option for each of the request's choices."""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer
from annotated_types import Ge, Le

from ..files.choices import Choice, choice_of, choices, required
from . import completion
from .errors import report_errors

Command = Callable[..., None]


def command(app: typer.Typer, name: str | None = None) -> Callable[[Command], Command]:
    """Register a function as a command of ``app``; its docstring is the help.

    Each parameter with a ``Choice`` is an option or an argument. A parameter that is a dataclass of choices stands for all of
    them, and the function gets the dataclass. Values that may be repeated arrive as tuples.

    Args:
        name: of the command; None for the function's own.
    """

    def register(function: Command) -> Command:
        hints = get_type_hints(function, include_extras=True)
        parameters: dict[str, inspect.Parameter] = {}
        requests: dict[str, type] = {}
        repeated: set[str] = set()
        for parameter in inspect.signature(function).parameters.values():
            hint = hints[parameter.name]
            found = {parameter.name: (parameter.default, hint)}
            if isinstance(hint, type) and is_dataclass(hint):
                requests[parameter.name] = hint
                found = {
                    field: (parameter.empty if required(entry) else entry.default, kind)
                    for field, (entry, kind) in choices(hint).items()
                }
            for option, (default, kind) in found.items():
                parameters[option] = _parameter(option, kind, default)
                if _is_repeated(kind):
                    repeated.add(option)

        def run(**given: Any) -> None:
            values = {option: tuple(value or ()) if option in repeated else value for option, value in given.items()}
            made = {
                argument: request(**{field: values.pop(field) for field in choices(request)})
                for argument, request in requests.items()
            }
            function(**made, **values)

        functools.update_wrapper(run, function)
        run.__annotations__ = {option: parameter.annotation for option, parameter in parameters.items()}
        run.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
        app.command(name)(report_errors(run))
        return function

    return register


def _parameter(name: str, hint: Any, default: Any) -> inspect.Parameter:
    """Return what Typer reads of one value: its type, the spelling of its option, help, group, limits and completion."""
    choice = choice_of(hint)
    assert choice is not None, f"{name} has no Choice"
    kind = get_args(hint)[0]
    details: dict[str, Any] = {
        "help": choice.help,
        "metavar": choice.metavar,
        "rich_help_panel": choice.group,
        "autocompletion": _completer(choice),
    }
    for limit in get_args(hint)[1:]:
        if isinstance(limit, Ge):
            details["min"] = limit.ge
        elif isinstance(limit, Le):
            details["max"] = limit.le
    if _is_repeated(hint):
        kind = list[get_args(kind)[0]]  # type: ignore[misc]
        default = inspect.Parameter.empty if default is inspect.Parameter.empty else None
        kind = kind if default is inspect.Parameter.empty else Union[kind, None]  # noqa: UP007
    if choice.argument:
        info = typer.Argument(**details)
    else:
        info = typer.Option(*choice.flags, **details)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def _is_repeated(hint: Any) -> bool:
    """Return whether a value is a tuple of any length, which the command line takes by repeating the option."""
    kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    if isinstance(kind, types.UnionType):
        return False
    return get_origin(kind) is tuple and get_args(kind)[-1] is Ellipsis


def _completer(choice: Choice) -> completion.Completer | None:
    if not choice.values:
        return None
    return completion.KINDS[choice.values] if isinstance(choice.values, str) else completion.of(*choice.values)
