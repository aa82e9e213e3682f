"""Render pages from templates. Every value is shown as text and never becomes markup."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from ...files.parsing import edited, read_results, shown
from ...files.writing import write_atomically
from ..store import StoreError


@cache
def page_template(module: str, name: str, **filters: Callable[..., object]) -> jinja2.Template:
    """Return a template, compiled once.

    Args:
        module: ``__file__`` of the caller; its folder ``templates/`` is searched first, then the one beside this module, which
            holds the style sheet and the charts of all pages.
        name: file in one of these folders.
        filters: functions of a module that the template calls by these names, beside ``fixed`` and ``labelled``.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([Path(file).parent / "templates" for file in (module, __file__)]),
        autoescape=True,
        finalize=_visible,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"fixed": fixed, "labelled": labelled} | filters
    return environment.get_template(name)


_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def _visible(value: object) -> object:
    """Return a value of a page with control characters of a text, such as those that a terminal obeys, as their escape sequences."""
    if not isinstance(value, str) or not _CONTROL.search(value):
        return value
    return type(value)(_CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), value))


def page_of(
    source: Path, name: str, render: Callable[[dict[str, Any]], str], *, command: str, schema: int | None = None
) -> Path:
    """Write the page of a finished run beside the file that it shows, all or nothing.

    Args:
        source: what the run found, JSON.
        command: of ``gaitgauge`` that writes ``source``, for who lacks it.
        schema: of results that ``render`` takes, None where it looks itself.

    Raises:
        StoreError: the folder holds no such file, or a damaged one, or one of another version.
    """
    folder = source.parent
    if not source.exists():
        raise StoreError(f"{folder} holds no {source.name}; run gaitgauge {command} with --out {folder} first")
    try:
        results = read_results(source, "results", StoreError)
        if schema is not None and (stated := results.get("schema")) != schema:
            raise StoreError(f"{source} has schema {shown(stated)}, this version reads {schema}")
        with edited(str(source), StoreError, jinja2.TemplateError):
            text = render(results)
    except StoreError as error:
        raise StoreError(f"{error}; run gaitgauge {command} again with --resume") from error
    write_atomically(folder / name, text, StoreError)
    return folder / name


def fixed(value: float | None, digits: int = 4) -> str:
    """A number with fixed decimals; a dash for what does not exist."""
    return "–" if value is None else f"{value:.{digits}f}".replace("-", "−")


_STACKED = re.compile(r'(<table class="[^"]*\bstack\b[^"]*">\s*<thead>)(.*?)(</thead>.*?</table>)', re.DOTALL)
_ROW, _HEAD, _TAG = (
    re.compile(r"<tr\b.*?</tr>", re.DOTALL),
    re.compile(r"<th\b[^>]*>(.*?)</th>", re.DOTALL),
    re.compile(r"<[^>]*>"),
)
_CELL = re.compile(r"<td\b([^>]*)>")


def labelled(page: str) -> Markup:
    """Return markup in which the cells of tables of class ``stack`` carry their column's head, which narrow screens show in each row.

    The first cell of a row is its name, charts need no label, and a cell may have a label of its own.
    """
    return Markup(_STACKED.sub(_with_labels, page))


def _with_labels(table: re.Match[str]) -> str:
    heads = [" ".join(_TAG.sub("", head).split()) for head in _HEAD.findall(table[2])]

    def row(found: re.Match[str]) -> str:
        column = itertools.count()

        def cell(found: re.Match[str]) -> str:
            i = next(column)
            name = heads[i] if 0 < i < len(heads) and "data-label" not in found[1] and "strip" not in found[1] else ""
            return f'<td data-label="{name}"{found[1]}>' if name else found[0]

        return _CELL.sub(cell, found[0])

    return table[1] + table[2] + _ROW.sub(row, table[3])
