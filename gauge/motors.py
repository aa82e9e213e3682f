"""Which motor gains a policy is played with, and what is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from ..files.parsing import one_line
from ..files.provenance import digest
from ..files.writing import json_text
from ..policy.contract import PolicyContract, check_robot
from ..robots import Robot, RobotError
from ..robots.base import JointParameters
from ..robots.sets import find_set
from .suite import Family, Suite


def suite_parameters(suite: Suite, robot: Robot) -> JointParameters:
    """Return the joint and motor constants that a suite names; raise ``RobotError`` where the robot lacks them."""
    found = robot.parameters.get(suite.parameters)
    if found is None:
        raise RobotError(
            f"suite '{suite.name}' needs the joint parameters '{suite.parameters}', which robot '{robot.name}' lacks; "
            f"it has {', '.join(sorted(robot.parameters))} (robot.toml)"
        )
    return found


def with_parameters(suite: Suite, robot: Robot, asked: str | None) -> Robot:
    """Return the robot with another parameter set in place of the one that a suite names; ``asked`` as for ``find_set``, or None.

    Raises:
        RobotError: no such set, or a wrong one.
    """
    if asked is None:
        return robot
    return replace(robot, parameters={**robot.parameters, suite.parameters: find_set(robot, asked)[1]})


def parameters_digest(constants: JointParameters) -> str:
    """Return the SHA-256, hexadecimal, of a set and of its network's file; ``RobotError``: the file cannot be read."""
    files = [] if constants.network is None else [Path(constants.network)]
    try:
        return digest(files, json_text({k: v for k, v in asdict(constants).items() if k != "network"}))
    except OSError as error:
        raise RobotError(f"'{one_line(error.filename)}' cannot be read: {error.strerror}") from error


def joint_parameters(suite: Suite, robot: Robot, contract: PolicyContract) -> JointParameters:
    """Joint and motor constants with which a suite plays a policy: those that it names, with the contract's gains if it says so.

    Of a measured robot the gains are those that act where these are sent.

    Raises:
        ContractError: the policy is not for this robot.
        RobotError: the robot lacks what the suite names.
    """
    own = suite_parameters(suite, robot)
    if suite.gains == "suite":
        family, joints = family_of(suite, contract), robot.num_joints
        if family is None:
            return own.commanded(own.stiffness, own.damping)
        return own.commanded((family.stiffness,) * joints, (family.damping,) * joints)
    stiffness, damping = list(own.stiffness), list(own.damping)
    for policy_joint, robot_joint in enumerate(check_robot(contract, robot)):
        stiffness[robot_joint] = contract.stiffness[policy_joint]
        damping[robot_joint] = contract.damping[policy_joint]
    for joint in contract.held:
        if joint.name in robot.joint_names:
            place = robot.joint_names.index(joint.name)
            stiffness[place], damping[place] = joint.stiffness, joint.damping
    return own.commanded(stiffness, damping)


_COMMAND_TERMS = ("command", "pose_command")


def family_of(suite: Suite, contract: PolicyContract) -> Family | None:
    """Return the family of a suite that a policy belongs to, by robot and scale of the command; None where it has none."""
    scales = [term.scale * (3 // len(term.scale)) for term in contract.observation if term.name in _COMMAND_TERMS]
    return next((f for f in suite.families if f.robot == contract.robot and f.command_scale in scales), None)


def gains_note(suite: Suite, robot: Robot, contract: PolicyContract) -> str | None:
    """One sentence on gains that are not the ones that a policy was made for, or not the suite's usual ones; None where all agree."""
    usual = suite_parameters(suite, robot)
    if usual.measured is not None:
        return f"{'motors by network' if usual.motor == 'network' else 'measured motors'}: {usual.measured}"
    made_for = joint_parameters(replace(suite, gains="contract"), robot, contract)
    own, others = _gains(made_for), _gains(usual)
    if suite.gains == "suite" and (family := family_of(suite, contract)):
        played = _gains(joint_parameters(suite, robot, contract))
        other = "" if played == own else f"; this one was made for {own}"
        return f"played with {played}, as {suite.name} plays the family {family.name}{other}"
    if (made_for.stiffness, made_for.damping) == (usual.stiffness, usual.damping):
        return None
    if suite.gains == "contract":
        return f"played with {own}, as the policy's contract says; {robot.name} usually has {others}"
    return f"played with {others}, as {suite.name} plays every policy; this one was made for {own}"


def _gains(parameters: JointParameters) -> str:
    return f"kp {_few(parameters.stiffness)} N·m/rad and kd {_few(parameters.damping)} N·m·s/rad"


def _few(values: Sequence[float]) -> str:
    """``20``, or ``20 to 40`` where joints differ."""
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
