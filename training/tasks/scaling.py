"""Scale a task from one robot to another: lengths, masses, torques and speeds in its settings are scaled by the two robots' models and
descriptions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ...policy.contract import standard_contract
from ...robots import Robot, load_robot
from ...robots.anatomy.body_plan import body_plan
from ..configuration import Ramp, Range, TrainingConfiguration
from ..environment.configuration import CommandStage, EnvironmentConfiguration
from ..environment.reward_configuration import FOOT_TERMS
from ..environment.stretches import without

Triple = tuple[float, float, float]
_OF_MOTOR_SPEEDS = {"environment.randomization.motor_speed", "environment.rewards.joint_speed_limits"}
"""Settings of stretches that a robot has no use for if its description does not say how fast its motors turn."""


@dataclass(frozen=True, kw_only=True)
class Ratios:
    """A robot's sizes over those of the robot that a task was written for."""

    length: float
    """Ratio of the stretched legs' lengths."""
    height: float
    """Ratio of the base's heights above the ground on stretched legs."""
    stance: tuple[float, float]
    """Ratios of length and width of the rectangle between the feet in the standing pose."""
    mass: float
    action: float
    """Ratio of the angles by which an output of 1 of the network moves a joint's target, means over all joints."""
    speed: Triple
    """Ratios of the largest forward, lateral and yaw commands."""

    @property
    def torque(self) -> float:
        """Return the ratio of the legs' loads: weight times length."""
        return self.mass * self.length


def ratios(robot: Robot, reference: Robot) -> Ratios:
    """Compare two robots. Raises RobotError: a foot does not hang on the base by joints of ``joint_names``."""
    mine, its = body_plan(robot), body_plan(reference)
    forward, lateral, yaw = (
        a / b if b > 0.0 else 1.0 for a, b in zip(robot.command_limits, reference.command_limits, strict=True)
    )
    return Ratios(
        length=mine.leg_length / its.leg_length,
        height=mine.stretched_height / its.stretched_height,
        # feet side by side make a rectangle without length
        stance=(_over(mine.stance[0], its.stance[0]), _over(mine.stance[1], its.stance[1])),
        mass=mine.mass / its.mass,
        action=_action_scale(robot) / _action_scale(reference),
        speed=(forward, lateral, yaw),
    )


def scaled(
    environment: EnvironmentConfiguration, training: TrainingConfiguration, source: str
) -> tuple[EnvironmentConfiguration, TrainingConfiguration]:
    """Return a task's settings for another robot, which explores by the same angles, in an experiment that is named for it.

    Scaled are the height of the base with the legs' reach; the place to start on with the stance; steps with legs and stance; masses
    that are added; penalties on torque and power with the robot's load; penalties on actions with the angle that an action is; contact
    forces that teacher and critic see; and commands with the robot's own limits. Terrain is not: every robot meets the ground that the
    gauge has. The parameter set is the robot's default one where it has none of the name that the task asks for. Stretches leave out
    what goes by the speeds of the motors where it does not have them.

    Args:
        environment: settings for ``environment.robot``.
        training: settings for the same robot.
        source: the other robot's name, or the path of its description.

    Raises:
        RobotError: one of the robots cannot be found, or is wrong.
    """
    robot, reference = load_robot(source), load_robot(environment.robot)
    by, network, name = ratios(robot, reference), training.network, training.run.experiment
    own = name.startswith(reference.name)
    named = name.replace(reference.name, robot.name, 1) if own else f"{robot.name}_{name}"
    learning = replace(
        training,
        network=replace(network, initial_std=network.initial_std / by.action),
        run=replace(training.run, experiment=named),
    )
    return _scaled_environment(environment, robot, source, by), learning


def _over(mine: float, its: float) -> float:
    return mine / its if its > 0.01 else 1.0


def _with_steps(environment: EnvironmentConfiguration, by: Ratios) -> EnvironmentConfiguration:
    """Return the settings with steps of the robot's size, where the task rewards steps: a longer leg swings more slowly."""
    rewards, gait, time = environment.rewards, environment.gait, by.length**0.5
    if not any(getattr(rewards, name) for name in FOOT_TERMS):
        return environment
    return replace(
        environment,
        rewards=replace(
            rewards,
            least_apart=rewards.least_apart * by.stance[1],
            longest_step=rewards.longest_step * time,
            clock_sigma=rewards.clock_sigma * by.length**2,
            foot_contact_force=rewards.foot_contact_force * by.mass,
        ),
        gait=replace(gait, period=gait.period and gait.period * time, swing_height=gait.swing_height * by.length),
    )


def _scaled_environment(
    environment: EnvironmentConfiguration, robot: Robot, source: str, by: Ratios
) -> EnvironmentConfiguration:
    environment = _with_steps(environment, by)
    parameters, (length, width) = environment.joints.parameters, environment.reset.footprint
    if parameters not in robot.parameters:
        parameters = robot.default_parameters
    if robot.parameters[parameters].no_load_speed is None:
        environment = without(environment, _OF_MOTOR_SPEEDS)
    rewards, randomization, commands = environment.rewards, environment.randomization, environment.commands
    return replace(
        environment,
        robot=source,
        joints=replace(environment.joints, parameters=parameters),
        observations=replace(
            environment.observations,
            foot_force_scale=environment.observations.foot_force_scale / by.mass,
            height_offset=environment.observations.height_offset * by.height,
        ),
        rewards=replace(
            rewards,
            joint_power=rewards.joint_power / by.mass,
            torque=rewards.torque / by.torque**2,
            torque_change=rewards.torque_change / by.torque**2,
            action_rate=rewards.action_rate * by.action**2,
            action_smoothness=rewards.action_smoothness * by.action**2,
            base_height=_ramp(rewards.base_height, by.height**-2),
            base_height_target=rewards.base_height_target * by.height,
            trunk_area=_scaled(rewards.trunk_area, by.length),
            sigma_linear_range=_scaled(rewards.sigma_linear_range, by.speed[0]),
            sigma_yaw_range=_scaled(rewards.sigma_yaw_range, by.speed[2]),
        ),
        termination=replace(
            environment.termination, low=environment.termination.low and environment.termination.low * by.height
        ),
        reset=replace(environment.reset, footprint=(length * by.stance[0], width * by.stance[1])),
        randomization=replace(
            randomization,
            base_mass=_scaled(randomization.base_mass, by.mass),
            base_com=_scaled(randomization.base_com, by.length),
        ),
        commands=replace(commands, stages=tuple(_stage(stage, by.speed) for stage in commands.stages)),
        terrain=replace(
            environment.terrain,
            tiles=tuple(
                replace(tile, command_limits=_limits(tile.command_limits, by.speed, robot))
                for tile in environment.terrain.tiles
            ),
        ),
    )


def _scaled(pair: Range, factor: float) -> Range:
    return pair[0] * factor, pair[1] * factor


def _ramp(ramp: Ramp, factor: float) -> Ramp:
    return replace(ramp, start=ramp.start * factor, end=ramp.end * factor)


def _action_scale(robot: Robot) -> float:
    scales = standard_contract(robot).action_scale
    return sum(scales) / len(scales)


def _limits(limits: Triple, factor: Triple, robot: Robot) -> Triple:
    """Return a terrain's limits: faster for a faster robot, but for a slower one only as slow as it is."""
    forward, lateral, yaw = (
        max(limit * by, min(limit, own)) for limit, by, own in zip(limits, factor, robot.command_limits, strict=True)
    )
    return forward, lateral, yaw


def _stage(stage: CommandStage, speed: Triple) -> CommandStage:
    forward, lateral, yaw = map(_scaled, (stage.forward, stage.lateral, stage.yaw), speed)
    return replace(stage, forward=forward, lateral=lateral, yaw=yaw)
