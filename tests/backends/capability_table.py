"""The table of capabilities in ``docs/reference/backends.md``, made from what the engines declare.

python tests/backends/capability_table.py
"""

from __future__ import annotations

from pathlib import Path

from gaitgauge.backends.base import CAPABILITY_NAMES, Support
from gaitgauge.backends.drake.limits import LIMITS as DRAKE
from gaitgauge.backends.physx.limits import LIMITS as PHYSX
from gaitgauge.backends.registry import find_backend
from gaitgauge.backends.sequential.limits import declare

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "backends.md"

BEGIN, END = "<!-- capabilities: begin -->", "<!-- capabilities: end -->"
"""The table's place in the document."""
EXTRAS = {"drake": DRAKE, "physx": PHYSX}
"""Limits of engines that extras install, which need not be there."""
ENGINES = ("mujoco", "mujoco-warp", "newton", "newton:steel", *EXTRAS)
"""Columns: every engine of the project, with each solver."""
_MARKS = {Support.EXACT: "yes", Support.APPROXIMATE: "about", Support.NONE: "no"}


def capability_table() -> str:
    """A Markdown table with a row for each capability and a column for each engine, its notes numbered below.

    Raises:
        BackendError: an engine's package is not installed.
    """
    declared = {name: find_backend(name, "cpu").capabilities() for name in ENGINES if name not in EXTRAS}
    declared |= {name: declare(limits) for name, limits in EXTRAS.items()}
    notes: list[str] = []
    lines = ["| | " + " | ".join(f"`{name}`" for name in ENGINES) + " |", "| --- " * (len(ENGINES) + 1) + "|"]
    for capability in CAPABILITY_NAMES:
        cells = []
        for name in ENGINES:
            entry = declared[name][capability]
            cell = _MARKS[entry.support]
            if entry.note:
                if entry.note not in notes:
                    notes.append(entry.note)
                cell += f" <sup>{notes.index(entry.note) + 1}</sup>"
            cells.append(cell)
        lines.append(f"| `{capability}` | " + " | ".join(cells) + " |")
    lines.append("")
    lines += [f"{i + 1}. {note}" for i, note in enumerate(notes)]
    return "\n".join(lines)


def update_document(path: Path) -> bool:
    """Write the present table into a document, between its two marks.

    Returns:
        Whether the document changed.

    Raises:
        ValueError: the document lacks the marks.
    """
    text = path.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{path} has no place for the table; add the lines '{BEGIN}' and '{END}'")
    new = f"{before}{BEGIN}\n\n{capability_table()}\n\n{END}{after}"
    if new != text:
        path.write_text(new, encoding="utf-8")
    return new != text


if __name__ == "__main__":
    update_document(DOCUMENT)
