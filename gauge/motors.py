"""Which motor gains a policy is played with, and what is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..policy.contract import PolicyContract, check_robot
from ..robots import Robot, RobotError
from ..robots.base import JointParameters
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


def joint_parameters(suite: Suite, robot: Robot, contract: PolicyContract) -> JointParameters:
    """Joint and motor constants with which a suite plays a policy: those that it names, with the contract's gains if it says so.

    Raises:
        ContractError: the policy is not for this robot.
        RobotError: the robot lacks what the suite names.
    """
    own = suite_parameters(suite, robot)
    if suite.gains == "suite":
        family, joints = family_of(suite, contract), robot.num_joints
        return (
            replace(own, stiffness=(family.stiffness,) * joints, damping=(family.damping,) * joints) if family else own
        )
    stiffness, damping = list(own.stiffness), list(own.damping)
    for policy_joint, robot_joint in enumerate(check_robot(contract, robot)):
        stiffness[robot_joint] = contract.stiffness[policy_joint]
        damping[robot_joint] = contract.damping[policy_joint]
    return replace(own, stiffness=tuple(stiffness), damping=tuple(damping))


_COMMAND_TERMS = ("command", "pose_command")


def family_of(suite: Suite, contract: PolicyContract) -> Family | None:
    """Return the family of a suite that a policy belongs to, by robot and scale of the command; None where it has none."""
    scales = [term.scale * (3 // len(term.scale)) for term in contract.observation if term.name in _COMMAND_TERMS]
    return next((f for f in suite.families if f.robot == contract.robot and f.command_scale in scales), None)


def gains_note(suite: Suite, robot: Robot, contract: PolicyContract) -> str | None:
    """One sentence on gains that are not the ones that a policy was made for, or not the suite's usual ones; None where all agree."""
    usual = suite_parameters(suite, robot)
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
