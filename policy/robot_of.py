"""Chooses the robot that a policy runs on: the one that is asked for, else the one that the policy remembers."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cache
from typing import Any

from ..robots import Robot, RobotError, load_robot, robot_names
from ..robots.identity import changed, recall
from .contract import PolicyContract, check_robot

REMEMBERED = "robot"
"""Entry of a contract's provenance that holds ``robots.identity.RobotIdentity``."""


def robot_for(contract: PolicyContract, asked: str | None = None) -> Robot:
    """Return the robot to run a policy on; a notice says where it differs from the robot that the policy remembers.

    Args:
        asked: name of a robot, or the path of its ``robot.toml``; None for the policy's own.

    Raises:
        RobotError: it cannot be found or is wrong.
        ContractError: the policy is for another robot.
    """
    remembered = contract.provenance.get(REMEMBERED)
    notice = None
    if asked is not None:
        robot = load_robot(asked)
        digest = remembered.get("digest") if isinstance(remembered, Mapping) else None
        if isinstance(digest, str) and contract.robot == robot.name:
            notice = changed(robot, digest, f"robot '{robot.name}'")
    elif remembered is not None:
        robot, notice = recall(remembered)
    elif contract.robot in robot_names():
        robot = load_robot(contract.robot)
    else:
        raise RobotError(
            f"the policy is for the robot '{contract.robot}', which is not installed and which it does not carry; give "
            "its robot.toml with --robot ('gaitgauge robot new MODEL.xml' writes one)"
        )
    check_robot(contract, robot)
    if notice:
        _say(notice)
    return robot


def without_copy(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return a contract's provenance for results: it names the robot without its files."""
    found = dict(provenance)
    if isinstance(remembered := found.get(REMEMBERED), Mapping):
        found[REMEMBERED] = {k: v for k, v in remembered.items() if k not in ("description", "files")}
    return found


@cache  # once
def _say(sentence: str) -> None:
    logging.getLogger(__name__).warning("%s", sentence)
