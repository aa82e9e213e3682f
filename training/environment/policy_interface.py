"""The robot as a training's policy meets it: the joints that it drives, their constants, and the contract."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ...files.parsing import shown
from ...policy.contract import History, ObservationTerm, PolicyContract, standard_contract
from ...policy.observation_table import HEIGHT_SCAN
from ...policy.robot_of import REMEMBERED
from ...robots.anatomy.roles import anatomy
from ...robots.base import JointParameters, Robot
from ...robots.identity import identify
from ...robots.loading import RobotError
from ...robots.sets import find_set
from ..configuration import ConfigurationError
from .commands import largest_commands
from .configuration import EnvironmentConfiguration
from .domain_randomization import outside
from .feet import check_clocks
from .own_terms import policy_observations

_log = logging.getLogger(__name__)


def driven_robot(robot: Robot, configuration: EnvironmentConfiguration) -> Robot:
    """Return the robot with the driven joints that ``joints.driven`` asks for. Raises ConfigurationError: a role that no joint has."""
    names = joints_of(robot, configuration.joints.driven, "driven")
    return replace(robot, driven_joints=names) if names else robot


def joints_of(robot: Robot, roles: Sequence[str], setting: str) -> tuple[str, ...]:
    """Return the names of a robot's joints of some roles, which ``joints.<setting>`` asks for. Raises ConfigurationError: a role that no
    joint has.
    """
    if not roles:
        return ()
    build = anatomy(robot)
    for role in roles:
        if not build.joints(role):
            raise ConfigurationError(
                f"environment.joints.{setting} has {shown(role)}, a role of no joint of robot '{robot.name}'; its joints are: "
                f"{', '.join(dict.fromkeys(build.roles))}"
            )
    chosen = {i for role in roles for i in build.joints(role)}
    return tuple(name for i, name in enumerate(robot.joint_names) if i in chosen)


def joint_parameters(robot: Robot, configuration: EnvironmentConfiguration) -> JointParameters:
    """Return the joint constants of the training physics. Raises ConfigurationError: the robot has no such parameter set."""
    settings = configuration.joints
    try:
        found = find_set(robot, settings.parameters)[1]
    except RobotError as error:
        raise ConfigurationError(f"environment.joints.parameters is '{settings.parameters}', but {error}") from error
    for sentence in outside(configuration.randomization, found, robot.joint_names):
        _log.warning("%s", sentence)
    changed: dict[str, Any] = {
        name: (value,) * robot.num_joints
        for name in ("armature", "joint_damping", "friction_loss")
        if (value := getattr(settings, name)) is not None
    }
    return replace(found, **changed)


def largest_told(configuration: EnvironmentConfiguration) -> tuple[float, float, float]:
    """Return the largest forward, lateral [m/s] and yaw [rad/s] command of a training."""
    tiles = [tile.command_limits for tile in configuration.terrain.tiles if tile.share > 0]
    return largest_commands(configuration.commands, tiles)


def training_contract(
    robot: Robot, parameters: JointParameters, configuration: EnvironmentConfiguration
) -> PolicyContract:
    """Return the interface of a policy trained here: one frame of observation, the driven joints of the robot as it is described, the
    gains, the control period and the largest commands of the training.

    Raises:
        ConfigurationError: an observation of one's own is not there, or breaks a rule; a driven role that no joint has.
    """
    provenance = {REMEMBERED: identify(robot, configuration.robot)}
    robot = driven_robot(robot, configuration)
    standard = standard_contract(
        robot, history=History(start=configuration.observations.history_start), provenance=provenance
    )
    gait = configuration.gait
    check_clocks(gait, robot)
    clock = (
        (ObservationTerm(name="gait_phase", scale=(1.0,), period=gait.period, offsets=gait.offsets, at_rest="half"),)
        if gait.period
        else ()
    )
    driven = [robot.joint_names.index(name) for name in standard.joint_names]
    seen = configuration.observations
    more = tuple(ObservationTerm(name=each.name, scale=each.scale) for each in policy_observations(seen))
    scan: dict[str, Any] = {"size": (seen.scan_length, seen.scan_width), "spacing": seen.scan_spacing}
    scan |= {"reference": (seen.height_offset,), "clip": 1.0}
    more = tuple(replace(term, **scan) if term.name == HEIGHT_SCAN else term for term in more)
    return replace(
        standard,
        observation=standard.observation + clock + more,
        command_limits=largest_told(configuration),
        stiffness=tuple(parameters.stiffness[i] for i in driven),
        damping=tuple(parameters.damping[i] for i in driven),
        control_period=configuration.physics.control_period,
        held=robot.held if configuration.joints.driven else (),
    )
