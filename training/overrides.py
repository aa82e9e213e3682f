"""``key=value`` settings on nested frozen dataclasses, converted to the type of the field they change.

A key is a path of field names separated by dots. An element of a tuple is addressed by its ``name``, one without by its number:
``terrain.tiles.stairs_up.share=0.3``. Values: numbers, ``true``/``false``, ``none`` where a field may be None, text, and tuples as
numbers separated by commas.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any, TypeVar, get_args, get_type_hints

from ..files.parsing import from_text, one_line, shown

Options = TypeVar("Options")


class TaskError(ValueError):
    """An unknown task, key or value; the message names it and the allowed ones."""


def apply_overrides(configuration: Options, overrides: Iterable[str]) -> Options:
    """Return a copy of a frozen dataclass, nested as deep as it likes, with settings changed by ``key=value``; later ones win. Raises
    TaskError: no ``=``, unknown key (with the nearest valid ones), or a value that does not fit.
    """
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key.strip():
            raise TaskError(f"{shown(override)} is no setting; write key=value, for example {_example(configuration)}")
        configuration = _set(configuration, key.strip().split("."), value.strip(), key.strip(), configuration)
    return configuration


def override_keys(configuration: Any, prefix: str = "") -> list[str]:
    """Return all keys that a configuration has, depth first."""
    keys: list[str] = []
    for name, value in _children(configuration):
        keys.extend(override_keys(value, f"{prefix}{name}.") if _has_children(value) else [prefix + name])
    return keys


def _children(value: Any) -> list[tuple[str, Any]]:
    if is_dataclass(value):
        return [(f.name, getattr(value, f.name)) for f in fields(value)]
    return [(getattr(element, "name", str(i)), element) for i, element in enumerate(value)]


def _has_children(value: Any) -> bool:
    return is_dataclass(value) or (isinstance(value, tuple) and any(is_dataclass(element) for element in value))


def _set(node: Any, path: list[str], text: str, key: str, root: Any) -> Any:
    name, rest = path[0], path[1:]
    if is_dataclass(node) and not isinstance(node, type):
        known = {f.name for f in fields(node)}
        if name not in known:
            raise _unknown(key, root)
        present = getattr(node, name)
        if rest:
            if not _has_children(present):
                raise _unknown(key, root)
            return _replaced(node, name, _set(present, rest, text, key, root), key)
        if _has_children(present) and not _takes_plain(node, name):
            raise _group(key, present)
        return _replaced(
            node, name, from_text(get_type_hints(type(node), include_extras=True)[name], text, key, TaskError), key
        )
    elements = list(node)
    names = [child for child, _ in _children(node)]
    if name not in names:
        raise _unknown(key, root)
    place = names.index(name)
    if not rest:
        raise _group(key, elements[place])
    elements[place] = _set(elements[place], rest, text, key, root)
    return tuple(elements)


def _replaced(node: Any, name: str, value: Any, key: str) -> Any:
    try:
        return replace(node, **{name: value})
    except (ValueError, TypeError) as error:
        raise TaskError(f"'{key}' cannot be set: {one_line(error)}") from error


def _takes_plain(node: Any, name: str) -> bool:
    """Return True if a field that holds a dataclass may hold a number or text as well."""
    hint = get_type_hints(type(node))[name]
    return any(option in (int, float, str) for option in get_args(hint))


def _group(key: str, value: Any) -> TaskError:
    children = [child for child, _ in _children(value)]
    shown = ", ".join(f"{key}.{child}" for child in children[:4]) + (" …" if len(children) > 4 else "")
    return TaskError(f"'{key}' is a group of {len(children)} settings; set one of them: {shown}")


def _unknown(key: str, root: Any) -> TaskError:
    known, key = override_keys(root), one_line(key, 80)
    ends, last = {k: k.rsplit(".", 1)[-1] for k in known}, key.rsplit(".", 1)[-1]
    near = get_close_matches(key, known, n=3, cutoff=0.5)
    near += [k for k, end in ends.items() if end == last and k not in near]
    similar = [] if near else get_close_matches(last, set(ends.values()), n=3)
    near += [k for end in similar for k in known if k.endswith(end)]
    if near:
        return TaskError(f"unknown setting '{key}'; the nearest are: {', '.join(near[:3])}")
    groups = sorted({k.split(".", 1)[0] for k in known})
    return TaskError(f"unknown setting '{key}'; settings begin with: {', '.join(groups)}")


def _example(configuration: Any) -> str:
    key = override_keys(configuration)[0]
    value = configuration
    for name in key.split("."):
        value = dict(_children(value))[name]
    return f"{key}={value}"
