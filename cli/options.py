"""Options that several commands share beside their requests."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ..files.choices import WRITTEN, Choice

Tables = Annotated[bool, Choice("Print JSON instead of tables.", WRITTEN, flags=("--json",))]
Contract = Annotated[Path | None, Choice("A contract.toml that describes how the policy is to be run.", metavar="PATH")]


def output(default: str) -> Choice:
    """Return the choice of an output folder."""
    return Choice(f"Output folder. Default: {default}.", WRITTEN)


def resume(what: str) -> Choice:
    """Return the choice to go on with what an output folder holds."""
    return Choice(f"Go on with the {what} in the output folder.", WRITTEN, flags=("--resume",))
