"""``gaitgauge board``: one leaderboard page made of a folder of score cards."""

from __future__ import annotations

from pathlib import Path

from ..gauge.board import write_board


def run_board(*, folder: Path, out: Path | None) -> None:
    """Write the page and say where it is."""
    print(write_board(folder, out or folder / "board.html"))
