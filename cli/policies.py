"""Find and load the policy that the user means."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ..policy.finding import find_policy, latest_checkpoint
from ..policy.loading import load_policy
from ..policy.native import FilePolicy
from ..policy.robot_of import robot_for
from ..robots import Robot, load_robot
from .errors import UserError


def open_policy(
    choice: str, robot: str | None, *, trust: bool, contract_file: Path | str | None = None
) -> tuple[FilePolicy, Robot]:
    """Load a policy, and the robot that it runs on: the one asked for, else its contract's.

    Raises:
        PolicyError, ContractError, RobotError, UserError: one sentence on what is wrong.
    """
    asked = None if robot is None else load_robot(robot)
    policy = load_policy(policy_file(choice), asked, trust=trust, contract_file=contract_file)
    return policy, robot_for(policy.contract, robot)


def policy_file(choice: str) -> Path:
    """Return the file of a policy, of a name such as ``latest``, or of a run directory: its best checkpoint, else its last.

    Raises:
        PolicyError: there is no such policy.
        UserError: the run directory holds no checkpoint.
    """
    if not os.path.isdir(choice):
        return find_policy(choice)
    if (found := _checkpoint(Path(choice))) is None:
        raise UserError(
            f"'{choice}' is a folder without a best.pt or model_<iteration>.pt; give a run directory or a policy file"
        )
    return found


def policy_files(policies: Sequence[str]) -> tuple[str, ...]:
    """Replace run directories by their checkpoint; a folder without one stays, to be refused by itself."""
    return tuple(str(_checkpoint(Path(p)) or p) if os.path.isdir(p) else p for p in policies)


def _checkpoint(folder: Path) -> Path | None:
    """Return a run directory's best checkpoint, else its last, None if there is none."""
    best = folder / "best.pt"
    return best if best.is_file() else latest_checkpoint(folder)
