"""Which policy file the user means."""

from __future__ import annotations

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
    folder = Path(choice)
    if not folder.is_dir():
        return find_policy(choice)
    best = folder / "best.pt"
    found = best if best.is_file() else latest_checkpoint(folder)
    if found is None:
        raise UserError(
            f"'{choice}' is a folder without a best.pt or model_<iteration>.pt; give a run directory or a policy file"
        )
    return found


def policy_files(policies: Sequence[str]) -> tuple[str, ...]:
    """The policies, run directories replaced by their best checkpoint, else their last."""
    return tuple(str(policy_file(p)) if Path(p).is_dir() else p for p in policies)
