"""Turn text into frozen dataclasses: files are read with limits, and every field is checked against its annotation.

Ranges are declared at the field (``Annotated[float, Field(gt=0)]``) and checked here alone, by pydantic. Every error is one
sentence with the file, the path of the field, its value and the allowed values.
"""

from __future__ import annotations

import gzip
import json
import re
import reprlib
import tomllib
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import yaml
from pydantic import ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

Kind = TypeVar("Kind")

LARGEST = 1_000_000
"""Largest size of a file that describes something [bytes]."""
LARGEST_RESULTS = 100_000_000
"""Largest size of a file of results [bytes]."""
_DEEPEST, _MOST = 32, 100_000
"""Deepest nesting of tables and lists, and largest number of entries in all."""
_SHOWN = 80
"""Most characters of a value in a sentence."""

_NAME, _LINE = r"^[A-Za-z0-9_][A-Za-z0-9_.+-]*$", r"^[^\x00-\x1f\x7f]*$"
Name = Annotated[str, StringConstraints(pattern=_NAME, max_length=100)]
"""Text that may become the name of a file or folder."""
Text = Annotated[str, StringConstraints(min_length=1, max_length=1000, pattern=_LINE)]
"""One line for people, or a name inside another file."""
_WORDS = {
    "a valid array": "a list",
    "a valid tuple": "a list",
    "an object": "a table",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid string": "a text",
    "a valid boolean": "true or false",
}
_PATTERNS = {
    _NAME: "it must be letters, digits and _ . + -, and begin with a letter, digit or _",
    _LINE: "it must be one line without control characters",
}
Positive = Annotated[float, Field(gt=0.0, le=1e9)]
NotNegative = Annotated[float, Field(ge=0.0, le=1e9)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Count = Annotated[int, Field(ge=1, lt=2**53)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]


class _Short(reprlib.Repr):
    """A short form of values; Python refuses to write very long integers."""

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() < 2**10 else f"a number of {x.bit_length()} bits"


def shown(value: object) -> str:
    """Return a value as a sentence shows it: shortened, control characters escaped."""
    short = _Short()
    short.maxstring = short.maxother = short.maxlong = _SHOWN
    text = " ".join(short.repr(value).splitlines())
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def one_line(text: object, longest: int = 300) -> str:
    """Return foreign text for a sentence: one line, shortened, control characters escaped."""
    words = " ".join(str(text).split())
    if not words.isprintable():
        words = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in words)
    return words if len(words) <= longest else words[: longest - 1] + "…"


def bare_name(path: object) -> str:
    """Return the name of a policy, a suite or a card without folder and ending: ``pretrained-robogauge-1.1`` of its ``.json``."""
    last = re.split(r"[/\\]", str(path).rstrip("/\\"))[-1]
    return re.sub(r"(\.gauge)?\.(pt|pth|onnx|npz|toml|json(\.gz)?)$", "", last, flags=re.I)


def did_you_mean(word: object, known: Collection[str]) -> str:
    """Return ``; did you mean 'a' or 'b'?`` for words of ``known`` close to ``word``, else an empty string."""
    close = get_close_matches(str(word)[:_SHOWN], list(known), n=3)
    return "; did you mean " + " or ".join(f"'{c}'" for c in close) + "?" if close else ""


# ---- files ----------------------------------------------------------------------------------------------------------


def read_text(path: Path, what: str, error: type[Exception], *, largest: int = LARGEST) -> str:
    """Return the text of a file, ``what`` in the sentence (``suite file``), of at most ``largest`` bytes; ``.gz`` is unpacked.

    Raises:
        error: no such file, too large, not readable, no gzip file or not UTF-8.
    """
    name = one_line(path)
    try:
        if not path.is_file():
            raise error(f"{what} '{name}' {'is not a file' if path.exists() else 'does not exist'}")
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            data = file.read(largest + 1)
    except (gzip.BadGzipFile, EOFError, zlib.error) as problem:
        raise error(f"{what} '{name}' cannot be read: it is damaged, or no gzip file") from problem
    except OSError as problem:
        raise error(f"{what} '{name}' cannot be read: {problem.strerror}") from problem
    if len(data) > largest:
        raise error(f"{what} '{name}' cannot be read: it is larger than {largest / 1e6:g} MB")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(f"{what} '{name}' is not a UTF-8 text file (byte {problem.start})") from problem


def parse_toml(text: str, source: str, error: type[Exception]) -> dict[str, Any]:
    """Return the plain data of TOML text; raise ``error`` where it is no valid TOML or nested too deep."""
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"{source} is not valid TOML: {_reason(problem)}") from problem
    return plain(data, source, error)


def parse_json(text: str | bytes, source: str, error: type[Exception], *, most: int = _MOST) -> Any:
    """Return the plain data of JSON text; raise ``error`` where it is no valid JSON, nested too deep or over ``most`` entries long."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"{source} is not valid JSON: {_reason(problem)}") from problem
    return plain(data, source, error, most=most)


def read_results(path: Path, what: str, error: type[Exception]) -> dict[str, Any]:
    """Read the table of a JSON file that this package wrote; raise ``error`` where it is too large, not readable or no table."""
    text = read_text(path, what, error, largest=LARGEST_RESULTS)
    found = parse_json(text, f"{what} '{one_line(path)}'", error, most=LARGEST_RESULTS // 10)
    if not isinstance(found, dict):
        raise error(f"{what} '{one_line(path)}' is {shown(found)}; it must be a table")
    return found


@contextmanager
def edited(source: str, error: type[Exception], *others: type[Exception]) -> Iterator[None]:
    """Turn failed lookups and arithmetic on a file's content into one sentence: the file was edited or is damaged.

    Args:
        source: the file, the beginning of the sentence.
    """
    caught: tuple[type[Exception], ...] = (LookupError, TypeError, AttributeError, ValueError, ArithmeticError, *others)
    try:
        yield
    except caught as problem:
        if any(kind.__module__.partition(".")[0] == __name__.partition(".")[0] for kind in type(problem).__mro__):
            raise
        lacks = f"it lacks {shown(problem.args[0])}" if isinstance(problem, KeyError) else one_line(problem)
        raise error(f"{source} was edited or is damaged: {lacks}") from problem


def parse_yaml(text: str, source: str, error: type[Exception]) -> Any:
    """Return the plain data of YAML text; raise ``error`` where it is no valid YAML, nested too deep, has merge keys or tags.

    Tagged tuples and slices of Python are read as the lists that follow their tags.
    """
    if _DEEP_YAML.search(text):  # each takes the parser longer than the one before
        raise error(f"{source} is not valid YAML: it is nested too deep")
    try:
        data = yaml.load(text, _Loader)
    except (
        yaml.YAMLError,
        ValueError,
        ArithmeticError,
        LookupError,
        AttributeError,
        TypeError,
        RecursionError,
    ) as problem:
        raise error(f"{source} is not valid YAML: {_reason(problem)}") from problem
    return plain(data, source, error)


_DEEP_YAML = re.compile(r"(?:[\[{]\s*+){64}")


class _Loader(yaml.SafeLoader):
    """A loader without merge keys, which multiply the size of tables at each level and which no policy needs."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "merge keys (<<) are not read", key.start_mark)


def _sequence(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> list[Any]:
    return loader.construct_sequence(node, deep=True)


# Isaac Lab and Unitree's exporter write a tuple and a slice so; they are the list that follows the tag.
for _tag in ("tuple", "object/apply:builtins.slice"):
    _Loader.add_constructor(f"tag:yaml.org,2002:python/{_tag}", _sequence)


def _reason(problem: BaseException) -> str:
    if isinstance(problem, LookupError | AttributeError | TypeError):  # of a YAML tag's constructor
        return "a value does not fit its tag"
    return "it is nested too deep" if isinstance(problem, RecursionError) else one_line(problem)


def plain(data: Any, source: str, error: type[Exception], *, most: int = _MOST) -> Any:
    """Copy plain data (tables, lists, texts, numbers, true, false, null) of bounded depth and size.

    Halves of surrogate pairs, which no text file can hold, become their escape sequence.

    Raises:
        error: the data hold anything else, a key that is no text, or too much.
    """
    left = most

    def copy(value: Any, steps: tuple[str | int, ...]) -> Any:
        nonlocal left
        left -= 1
        if len(steps) > _DEEPEST or left < 0:
            reason = "nested too deep" if len(steps) > _DEEPEST else "too long"
            raise error(f"{source} is {reason} at {_path(steps)[:_SHOWN]}")
        if value is None or isinstance(value, bool | float):
            return value
        if isinstance(value, str):
            return value.encode("utf-8", "backslashreplace").decode()
        if isinstance(value, list | tuple):
            return [copy(v, (*steps, i)) for i, v in enumerate(value)]
        if isinstance(value, int):
            if not -(2**63) <= value < 2**63:
                raise error(f"{source}: {_path(steps)} is {shown(value)}; it must lie between -2^63 and 2^63")
            return value
        if isinstance(value, Mapping):
            for key in value:
                if not isinstance(key, str):
                    raise error(f"{source}: {_path(steps) or 'a table'} has the key {shown(key)}; keys must be texts")
            return {copy(k, steps): copy(v, (*steps, k)) for k, v in value.items()}
        raise error(f"{source}: {_path(steps)} is {shown(value)}; it must be a text, a number, a list or a table")

    return copy(data, ())


def _path(steps: Iterable[str | int]) -> str:
    """Return the path of a value: ``tables[2].key``."""
    path = ""
    for step in steps:
        if isinstance(step, int):
            path += f"[{step}]"
        else:
            path += ("." if path else "") + one_line(step, _SHOWN)
    return path


# ---- dataclasses ----------------------------------------------------------------------------------------------------


def build(
    kind: type[Kind],
    data: object,
    source: str,
    error: type[Exception],
    *,
    false_is_none: bool = False,
    extra: Literal["forbid", "ignore"] = "forbid",
) -> Kind:
    """Build a (nested) frozen dataclass from plain data.

    Args:
        kind: the dataclass; its annotations are the rules.
        source: origin of the data, the beginning of every sentence.
        false_is_none: ``false`` stands for None where a field may be None, and sentences say so: TOML has no null.
        extra: refuse or ignore entries that no field names.

    Raises:
        error: an unknown or missing field, a value of another type or out of range, or a refusal of ``__post_init__``.
    """
    data = plain(data, source, error)
    text = json.dumps([_none_for_false(kind, data) if false_is_none else data])
    try:
        checker: TypeAdapter[tuple[Kind]] = _adapter(kind, extra)  # type: ignore[arg-type]
        return checker.validate_json(text)[0]
    except ValidationError as problem:
        raise _error(problem, kind, source, error, "false" if false_is_none else "") from problem


def read_toml(path: Path, kind: type[Kind], what: str, error: type[Exception], *, source: str = "") -> Kind:
    """Read a TOML file into a dataclass: ``what`` as for ``read_text``, ``source`` as for ``build``, by default its name."""
    data = parse_toml(read_text(path, what, error), source or path.name, error)
    return build(kind, data, source or path.name, error)


def take(kind: type[Kind], data: object, source: str, error: type[Exception]) -> Kind:
    """Build a dataclass from a table's entries that bear its fields' names, and so for the tables in it; raise ``error`` as ``build``."""
    if not isinstance(data, Mapping):
        raise error(f"{source} is {shown(data)}; it must be a table")
    own = {f.name: data[f.name] for f in fields(kind) if f.name in data}  # type: ignore[arg-type]
    return build(kind, own, source, error, extra="ignore")


def check_fields(instance: Any, source: str, error: type[Exception]) -> None:
    """Check the fields of a frozen dataclass in its ``__post_init__``; numbers become floats and lists tuples, as annotated.

    Raises:
        error: a value of another type or out of range.
    """
    kind: Any = type(instance)
    for name, checker in _field_adapters(kind).items():
        try:
            object.__setattr__(instance, name, checker.validate_python({name: getattr(instance, name)})[name])
        except ValidationError as problem:
            raise _error(problem, kind, source, error) from problem


def from_text(hint: Any, text: str, key: str, error: type[Exception]) -> Any:
    """Convert a setting of the command line to the annotated type; ``none`` stands for None, commas separate a tuple's entries.

    Raises:
        error: the text does not fit; the sentence names the key.
    """
    hint = _without_ranges(hint)
    options = get_args(hint)
    if _may_be_none(hint) and text.lower() in ("none", "null"):
        return None
    try:
        if get_origin(hint) is tuple:
            parts = [part.strip() for part in text.strip("()[] ").split(",") if part.strip()]
            kinds = options[:1] * len(parts) if options[-1] is Ellipsis else options
            if len(kinds) != len(parts):
                raise error(f"'{key}' is {shown(text)}; it must be {len(kinds)} values separated by commas")
            return tuple(from_text(k, part, key, error) for k, part in zip(kinds, parts, strict=True))
        return _text_adapter(hint).validate_strings(text)
    except ValidationError as problem:
        rule = _rule(problem.errors(include_url=False)[-1]) + (", or none" if _may_be_none(hint) else "")
        raise error(f"'{key}' is {shown(text)}; {rule}") from problem


@cache
def _adapter(kind: Any, extra: Literal["forbid", "ignore"]) -> TypeAdapter[Any]:
    # The tuple carries the configuration, because dataclasses of the standard library cannot.
    return TypeAdapter(tuple[kind], config=ConfigDict(extra=extra, allow_inf_nan=False, strict=True))


@cache
def _field_adapters(kind: Any) -> dict[str, TypeAdapter[Any]]:
    config = ConfigDict(extra="forbid", allow_inf_nan=False)
    hints: dict[str, Any] = get_type_hints(kind, include_extras=True)
    # The table carries the configuration and the field's name, which the path of an error needs.
    tables: dict[str, Any] = {name: GenericAlias(dict, (str, hint)) for name, hint in hints.items()}
    return {name: TypeAdapter(table, config=config) for name, table in tables.items()}


def _none_for_false(hint: Any, data: Any) -> Any:
    """Replace ``false`` by None in plain data, where a field may be None."""
    if isinstance(data, dict):
        return {key: _none_for_false(_hint_at(hint, [key]), value) for key, value in data.items()}
    if isinstance(data, list):
        return [_none_for_false(_hint_at(hint, [i]), value) for i, value in enumerate(data)]
    return None if data is False and _may_be_none(hint) else data


def _error(problem: ValidationError, kind: Any, source: str, error: type[Exception], none: str = "") -> Exception:
    """Return an error of the requested class; an error that a dataclass raised itself stays."""
    own = problem.errors(include_url=False)[0].get("ctx", {}).get("error")
    if isinstance(own, error) and str(own).startswith(source):
        return own
    return error(f"{source}: {_sentence(problem, kind, none)}")


@cache
def _text_adapter(hint: Any) -> TypeAdapter[Any]:
    return TypeAdapter(hint, config=None if is_dataclass(hint) else ConfigDict(allow_inf_nan=False))


_MEMBER = re.compile(r"(float|int|str|bool|constrained-\w+|(tuple|dict|function|nullable)[-\w]*\[.*)$")
"""Pydantic's names for the members of a union in a path."""


def _sentence(problem: ValidationError, kind: Any, none: str) -> str:
    """Describe the first of the errors, a misspelt field before the missing one; ``none`` is the spelling of None, if allowed."""
    errors = problem.errors(include_url=False)
    order = ("unexpected_keyword_argument", "missing")
    first = min(errors, key=lambda e: order.index(e["type"]) if e["type"] in order else len(order))
    steps: tuple[int | str, ...] = first["loc"][first["loc"][0] == 0 :]  # without the place in the adapter's tuple
    path = _path(step for step in steps if isinstance(step, int) or not _MEMBER.match(step))
    if first["type"] == "missing" and isinstance(first["loc"][-1], int):
        return f"{path.rpartition('[')[0]} is {shown(first['input'])}; more entries are needed"
    if first["type"] == "missing":
        lacking = [str(e["loc"][-1]) for e in errors if e["type"] == "missing" and e["loc"][:-1] == first["loc"][:-1]]
        return f"{path.rpartition('.')[0] or 'it'} lacks {', '.join(lacking)}"
    if first["type"] == "unexpected_keyword_argument":
        table = _without_none(_hint_at(kind, steps[:-1]))
        known = list(_hints(table)) if is_dataclass(table) else []
        hint = did_you_mean(first["loc"][-1], known) or f"; choose from {', '.join(known)}"
        return f"unknown field '{path}'{hint}"
    if first["type"] == "value_error":
        return f"{path} {first['ctx']['error']}".strip()
    more = f", or {none}" if none and _may_be_none(_hint_at(kind, steps)) else ""
    return f"{path or 'it'} is {shown(first['input'])}; {_rule(first)}{more}"


def _rule(error: Mapping[str, Any]) -> str:
    """Return pydantic's words as the end of a sentence."""
    if error["type"] == "string_pattern_mismatch":
        return _PATTERNS[error["ctx"]["pattern"]]
    words = re.sub(r"^(Input|String|Tuple|Dictionary) should", "it must", str(error["msg"]))
    for theirs, ours in _WORDS.items():
        words = words.replace(theirs, ours)
    words = words.replace(" after validation, not", ", not")
    return words.partition(", unable to parse")[0]


def _without_ranges(hint: Any) -> Any:
    """Return the tuple below ``Annotated``, else the hint; ranges of tuples and unions are inside them."""
    inner = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    return inner if get_origin(inner) is tuple else hint


_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)


def _hint_at(hint: Any, steps: Iterable[int | str]) -> Any:
    """Return the annotation at a path; None for an unknown field."""
    for step in steps:
        hint = _without_none(hint)
        if is_dataclass(hint):
            hint = _hints(hint).get(str(step))
        elif get_args(hint):
            hint = get_args(hint)[-1 if isinstance(step, str) else 0]
    return hint


def _may_be_none(hint: Any) -> bool:
    return type(None) in get_args(hint)


def _without_none(hint: Any) -> Any:
    """Return the dataclass of an optional dataclass; any other annotation as it is."""
    return next((k for k in get_args(hint) if is_dataclass(k)), hint) if _may_be_none(hint) else hint
