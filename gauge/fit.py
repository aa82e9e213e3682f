"""Check that a policy and a robot suit a suite before anything is played."""

from __future__ import annotations

import math

from ..policy.contract import PolicyContract
from ..robots import Robot
from ..robots.motor_network import load_motor_network
from .motors import suite_parameters
from .suite import Suite, SuiteError


def check_fit(suite: Suite, robot: Robot, contract: PolicyContract, *, longest: float = math.inf) -> None:
    """Check that a suite's physics suits a robot and a policy.

    Args:
        longest: control period that can be looked at [s].

    Raises:
        RobotError: the robot lacks the suite's joint parameters.
        SuiteError: the policy was made for another control period, or for one above ``longest``.
        BackendError: the motors are a network that cannot be called in the suite's physics steps.
        MotorNetworkError: the network's file cannot be used.
    """
    network = suite_parameters(suite, robot).network
    if network is not None:
        from ..backends.network_motors import steps_between_calls

        steps_between_calls(load_motor_network(network), suite.physics.timestep, suite.physics.control_period)
    if abs(contract.control_period - suite.physics.control_period) > 1e-9:
        raise SuiteError(
            f"the policy was made for a control period of {contract.control_period:g} s, suite '{suite.name}' runs "
            f"{suite.physics.control_period:g} s; use a policy of that period"
        )
    if contract.control_period > longest:
        raise SuiteError(
            f"the policy's control period is {contract.control_period:g} s, and what is noted here every {longest:g} s needs one of at "
            "most that; use a policy of a shorter period"
        )
