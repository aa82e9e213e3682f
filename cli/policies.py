"""Which policy file the user means."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ..policy.finding import find_policy, latest_checkpoint
from .errors import UserError


def policy_file(choice: str) -> Path:
    """The file of a policy, of a name such as ``latest``, or of a run directory: its best checkpoint, else its last.

    Raises:
        PolicyError: there is no such policy.
        UserError: the run directory holds no checkpoint.
    """
    if not os.path.isdir(choice):
        return find_policy(choice)
    found = _checkpoint(Path(choice))
    if found is None:
        raise UserError(
            f"'{choice}' is a folder without a best.pt or model_<iteration>.pt; give a run directory or a policy file"
        )
    return found


def policy_files(policies: Sequence[str]) -> tuple[str, ...]:
    """The policies, run directories replaced by their checkpoint; a folder without one stays, to be refused by itself."""
    return tuple(str(_checkpoint(Path(p)) or p) if os.path.isdir(p) else p for p in policies)


def _checkpoint(folder: Path) -> Path | None:
    """A run directory's best checkpoint, else its last, None if there is none."""
    best = folder / "best.pt"
    return best if best.is_file() else latest_checkpoint(folder)
