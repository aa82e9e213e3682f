"""Pages out of ``templates/``. Whatever is put into one is shown as text and never becomes markup."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import jinja2


@cache
def page_template(name: str, **filters: Callable[..., object]) -> jinja2.Template:
    """A template by its file's name, compiled once.

    Args:
        name: file in ``templates/``.
        filters: what the template calls by these names, beside ``fixed``; functions of a module, so that the template is found
            again.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"fixed": fixed} | filters
    return environment.get_template(name)


def fixed(value: float | None, digits: int = 4) -> str:
    """A number with fixed decimals; a dash for what does not exist."""
    return "–" if value is None else f"{value:.{digits}f}".replace("-", "−")
