"""Several policies at once: each by a label, and a sentence on each that cannot be had, so that the others go on."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..files.parsing import one_line, read_results
from ..policy.base import PolicyError
from ..policy.contract import ContractError
from ..policy.finding import find_policy
from ..policy.loading import load_policy, own_contract
from ..policy.native import FilePolicy
from ..policy.robot_of import robot_for, without_copy
from ..robots import Robot, RobotError, load_robot
from .naming import distinct_names

Refused = dict[str, str]
"""``what`` was asked for and cannot be done while the rest was, as the user named it, and the ``reason``, one sentence."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Loaded:
    """A policy and its body."""

    policy: FilePolicy
    robot: Robot


def load_policies(
    names: Sequence[str], robot: str | None = None, *, trust: bool = False, contract_file: str | None = None
) -> tuple[dict[str, Loaded], list[Refused]]:
    """Policies by label, see ``distinct_names``, and those that could not be loaded.

    Args:
        names: what ``gaitgauge evaluate`` takes; one that is named twice is loaded once.
        robot: name of the robot that they have to fit, or its ``robot.toml``; None for each one's own.

    Raises:
        RobotError: the robot that was asked for cannot be had.
    """
    asked = None if robot is None else load_robot(robot)
    found: dict[str, Loaded] = {}
    refused: list[Refused] = []
    names = list(dict.fromkeys(names))
    for name, label in zip(names, distinct_names(names), strict=True):
        try:
            policy = load_policy(name, asked, trust=trust, contract_file=own_contract(name, contract_file))
            loaded = Loaded(policy=policy, robot=robot_for(policy.contract, robot))
        except (PolicyError, ContractError, RobotError) as error:
            refused.append({"what": name, "reason": str(error)})
        else:
            found[label] = loaded
    return found, refused


def file_digest(name: str) -> str:
    """SHA-256 of a policy's file, hexadecimal, as ``sha256sum`` prints it."""
    with find_policy(name).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def lost_policy(file: Path, names: Sequence[str]) -> str | None:
    """A policy that a study's results hold and that is not among ``names``, by path or by content; None for none.

    Args:
        file: results with what ``describe`` says of each policy; there may be none.
    """
    if not file.is_file():
        return None
    digests = set()
    for name in names:
        with suppress(PolicyError, OSError):  # what is wrong with it is said when it is loaded
            digests.add(file_digest(name))
    try:
        for entry in read_results(file, "results", PolicyError)["policies"]:
            if entry["path"] not in names and entry["file_sha256"] not in digests:
                return f"'{one_line(entry['label'], 80)}' ({one_line(entry['path'])})"
    except (PolicyError, KeyError, TypeError):
        pass  # not what a study wrote
    return None


def describe(label: str, loaded: Loaded) -> dict[str, Any]:
    """Return the statements of a result on a policy, as plain data."""
    policy = loaded.policy
    return {
        "label": label,
        "path": policy.path,
        "file_sha256": policy.file_sha256,
        "robot": loaded.robot.name,
        "contract_hash": policy.contract.hash,
        "command_limits": list(policy.contract.command_limits),
        "provenance": without_copy(policy.contract.provenance),
    }
