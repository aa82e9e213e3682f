"""Write a comparison as files: ``comparison.json``, ``.csv``, ``.tex`` (a booktabs table) and ``.html`` (one page, loads nothing)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import jinja2

from ...files.parsing import edited, one_line, read_results
from ...files.writing import csv_text, write_files
from ...gauge.metrics import metric_label
from ...gauge.report.charts import terrain_label
from ...gauge.report.pages import page_template
from .. import interval_charts
from ..naming import free_folder
from .comparison import KINDS, Comparison, ComparisonError, Difference, format_p

_TEX = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}", "\\": r"\textbackslash{}"}
_TEX |= {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", "–": "--"}
_SAME_RUNS = ("file_sha256", "coverage", "seeds")
"""Fields of a policy in which the same comparison made again is alike."""
_LONGEST = 100_000
"""Characters of a line of LaTeX: a line's end would end a comment, too."""


def write_comparison(folder: Path, found: Comparison, *, overwrite: bool = True) -> dict[str, Path]:
    """Write all files of a comparison, each whole or not at all; their paths by kind (``json``, ``csv``, ``tex``, ``html``).

    Args:
        overwrite: write over a comparison of other results in the folder; False for ``<folder>-2`` … in its place.

    Raises:
        ComparisonError: they cannot be written, or the results hold what no evaluation writes.
    """
    with edited("one of the results", ComparisonError, jinja2.TemplateError):
        contents = {
            "json": json.dumps(found.plain(), indent=1, allow_nan=False) + "\n",
            "csv": as_csv(found),
            "tex": as_latex(found),
            "html": as_page(found),
        }
    if not overwrite:
        folder = free_folder(folder, partial(_is_free, found))
    write_files(folder, {f"comparison.{kind}": text for kind, text in contents.items()}, ComparisonError)
    return {kind: folder / f"comparison.{kind}" for kind in contents}


def _is_free(found: Comparison, folder: Path) -> bool:
    """Return whether a folder holds no comparison, or one of the same episodes of the same policies."""
    file = folder / "comparison.json"
    if not file.is_file():
        return True
    try:
        there = read_results(file, "comparison", ComparisonError)
        before = [there["suite"], *({k: p[k] for k in _SAME_RUNS} for p in there["policies"])]
    except (ComparisonError, KeyError, TypeError):
        return False  # not what this function wrote
    mine = json.loads(json.dumps(found.plain()))
    return bool(before == [mine["suite"], *({k: p[k] for k in _SAME_RUNS} for p in mine["policies"])])


def as_csv(found: Comparison) -> str:
    """Return one row for each difference."""
    names = ("kind", "name", "first", "second", "first_value", "second_value", "difference", "low", "high")
    rows: list[Sequence[object]] = [(*names, "p_value", "corrected_p_value", "real")]
    for d in found.differences:
        low, high = d.interval or ("", "")
        ends = ["" if v is None else v for v in (d.p_value, d.corrected)]
        rows.append((d.kind, d.name, d.first, d.second, *d.values, d.difference, low, high, *ends, d.real))
    return csv_text(rows)


def as_latex(found: Comparison) -> str:
    """Return a ``tabular`` for each pair, for the package booktabs; real differences in bold type."""
    tables = []
    for first, second in _pairs(found):
        head = rf" & & {_tex(first)} & {_tex(second)} & difference & 95\,\% interval & corrected $p$ \\"
        lines = [r"\begin{tabular}{llrrrcr}", r"\toprule", head]
        for group in _by_kind(found, first, second).values():
            lines.append(r"\midrule")
            for at, d in enumerate(group):
                difference = f"{d.difference:+.4f}"
                low_high = "--" if d.interval is None else f"[{d.interval[0]:+.4f}, {d.interval[1]:+.4f}]"
                shown = rf"\textbf{{{difference}}}" if d.real else difference
                cells = ["" if at else d.kind, _tex(label(d)), *(f"{v:.4f}" for v in d.values), shown, low_high]
                lines.append(" & ".join([*cells, _tex(_odds(d.corrected))]) + r" \\")
        tables.append("\n".join([*lines, r"\bottomrule", r"\end{tabular}"]))
    head = one_line(f"{found.suite}; {' '.join(found.sentences)}", _LONGEST)
    return "\n\n".join([f"% {head}", *tables]) + "\n"


def as_page(found: Comparison) -> str:
    """Return the page, as HTML text. Names are shown as text and never becomes markup."""
    pairs = []
    for first, second in _pairs(found):
        kinds = []
        for kind, group in _by_kind(found, first, second).items():
            known = [{"value": d.difference, "interval": d.interval} if d.interval else None for d in group]
            scale = interval_charts.common_scale(known, signed=True)
            strips = [None if k is None else interval_charts.strip(k, scale) for k in known]
            rows = list(zip(group, strips, strict=True))
            kinds.append({"kind": kind, "scale": interval_charts.strip_scale(scale), "rows": rows})
        pairs.append({"first": first, "second": second, "kinds": kinds})
    template = page_template(__file__, "comparison.html.j2", signed=_signed, odds=_odds, label=label)
    return template.render(
        suite=found.suite,
        policies=found.policies,
        sentences=found.sentences,
        paired=found.paired,
        pairs=pairs,
        details=sum(d.kind != "score" for d in found.differences),
    )


def _signed(value: float) -> str:
    return f"{value:+.4f}".replace("-", "−")


def _odds(p: float | None) -> str:
    return format_p(p).removeprefix("= ")


def label(found: Difference) -> str:
    """Return the subject of a difference, for readers."""
    words: dict[str, Callable[[str], str]] = {
        "terrain": terrain_label,
        "metric": metric_label,
        "metric as measured": metric_label,
        "payload": "{} kg".format,
    }
    return words.get(found.kind, lambda name: name.replace("_", " "))(found.name)


def _pairs(found: Comparison) -> Sequence[tuple[str, str]]:
    return list(dict.fromkeys((d.first, d.second) for d in found.differences))


def _by_kind(found: Comparison, first: str, second: str) -> Mapping[str, list[Difference]]:
    mine = [d for d in found.differences if (d.first, d.second) == (first, second)]
    groups: dict[str, list[Difference]] = {k: [d for d in mine if d.kind == k] for k in KINDS}
    return {k: group for k, group in groups.items() if group}


def _tex(text: str) -> str:
    return "".join(_TEX.get(c, c) for c in one_line(text, _LONGEST))
