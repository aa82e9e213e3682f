"""Makes a task that was written for one robot a task for another: lengths, masses, torques and speeds in its settings are
scaled by what the two robots' models and descriptions say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..robots import Robot, load_robot
from ..robots.body_plan import body_plan
from .configuration import RunConfiguration
from .environment_configuration import CommandStage, EnvironmentConfiguration, Range

Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Ratios:
    """A robot's sizes over those of the robot that a task was written for."""

    length: float
    """Of stretched legs."""
    height: float
    """Of the base above the ground in the standing pose."""
    mass: float
    speed: Triple
    """Of the largest forward, lateral and yaw commands."""

    @property
    def torque(self) -> float:
        """Of what a leg must carry: weight times length."""
        return self.mass * self.length


def ratios(robot: Robot, reference: Robot) -> Ratios:
    """Compare two robots.

    Raises:
        RobotError: a foot does not hang on the base by joints of ``joint_names``.
    """
    mine, its = body_plan(robot), body_plan(reference)
    forward, lateral, yaw = (
        a / b if b > 0.0 else 1.0 for a, b in zip(robot.command_limits, reference.command_limits, strict=True)
    )
    return Ratios(
        length=mine.leg_length / its.leg_length,
        height=mine.standing_height / its.standing_height,
        mass=mine.mass / its.mass,
        speed=(forward, lateral, yaw),
    )


def scaled_environment(environment: EnvironmentConfiguration, source: str) -> EnvironmentConfiguration:
    """An environment's settings for another robot.

    Scaled are the height of the base and the areas below it with the leg; masses that are added; penalties on torque and
    power with what the robot must carry; contact forces that teacher and critic see; and commands with the robot's own
    limits. The parameter set is the robot's default one where it has none of the name that the task asks for.

    Args:
        environment: settings for ``environment.robot``.
        source: the other robot's name, or the path of its description.

    Raises:
        RobotError: one of the robots cannot be found, or is wrong.
    """
    robot, reference = load_robot(source), load_robot(environment.robot)
    by = ratios(robot, reference)
    rewards, randomization, commands = environment.rewards, environment.randomization, environment.commands
    parameters = environment.joints.parameters
    return replace(
        environment,
        robot=source,
        joints=replace(
            environment.joints,
            parameters=parameters if parameters in robot.parameters else robot.default_parameters,
        ),
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
            base_height_target=rewards.base_height_target * by.height,
            trunk_area=_scaled(rewards.trunk_area, by.length),
            sigma_linear_range=_scaled(rewards.sigma_linear_range, by.speed[0]),
            sigma_yaw_range=_scaled(rewards.sigma_yaw_range, by.speed[2]),
        ),
        reset=replace(environment.reset, footprint=_scaled(environment.reset.footprint, by.length)),
        randomization=replace(
            randomization,
            base_mass=_scaled(randomization.base_mass, by.mass),
            base_com=_scaled(randomization.base_com, by.length),
        ),
        commands=replace(commands, stages=tuple(_stage(stage, by.speed) for stage in commands.stages)),
        terrain=replace(
            environment.terrain,
            tiles=tuple(
                replace(tile, command_limits=_limits(tile.command_limits, by.speed))
                for tile in environment.terrain.tiles
            ),
        ),
    )


def renamed_run(run: RunConfiguration, robot: str, reference: str) -> RunConfiguration:
    """A run whose experiment is named for another robot than the task's."""
    name = run.experiment
    named = name.replace(reference, robot, 1) if name.startswith(reference) else f"{robot}_{name}"
    return replace(run, experiment=named)


def _scaled(pair: Range, factor: float) -> Range:
    return pair[0] * factor, pair[1] * factor


def _limits(limits: Triple, factor: Triple) -> Triple:
    return limits[0] * factor[0], limits[1] * factor[1], limits[2] * factor[2]


def _stage(stage: CommandStage, speed: Triple) -> CommandStage:
    forward, lateral, yaw = speed
    return replace(
        stage,
        forward=_scaled(stage.forward, forward),
        lateral=_scaled(stage.lateral, lateral),
        yaw=_scaled(stage.yaw, yaw),
    )
