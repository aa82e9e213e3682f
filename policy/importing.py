"""Turns any policy that can be loaded into the project's own file, which then needs no sidecar."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..robots import load_robot
from ..robots.identity import identify
from .loading import load_policy
from .native import FilePolicy, save_policy
from .robot_of import REMEMBERED


def import_policy(
    source: str | Path,
    destination: str | Path,
    robot: str | None = None,
    *,
    trust: bool = False,
    contract_file: Path | str | None = None,
) -> FilePolicy:
    """Write a policy and its contract into one file of the project's own format; its actions stay the same.

    Networks that the project knows are stored as weights; a TorchScript or ONNX file is carried inside unchanged, and run from
    there only where it is trusted.

    Args:
        destination: the file to write; an existing file is replaced only once the source has been loaded.
        trust: as in ``load_policy``; the imported file, if it carries a program, needs it in turn.

    Returns:
        The policy, with the contract that was stored.

    Raises:
        PolicyError: the source cannot be loaded, or the destination cannot be written.
        ContractError: the policy is for another robot.
    """
    asked = None if robot is None else load_robot(robot)
    policy = load_policy(source, asked, trust=trust, contract_file=contract_file)
    provenance = {**policy.contract.provenance, "imported_from": Path(policy.path).name}
    if asked is not None and robot is not None:
        provenance[REMEMBERED] = identify(asked, robot)
    policy.contract = replace(policy.contract, provenance=provenance)
    save_policy(destination, policy.contract, policy.stored)
    return policy
