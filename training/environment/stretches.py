"""Stretches of a run: settings of the environment that change at a fraction of the run, where it is built anew."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from ...files.parsing import shown
from ...policy.comparing import difference
from ...policy.contract import PolicyContract
from ...robots.base import Robot
from ...terrains.training_tiles import TILE_KINDS
from ..configuration import ConfigurationError
from ..overrides import TaskError, apply_overrides
from .configuration import EnvironmentConfiguration, ScheduleConfiguration, Stretch

CHANGEABLE = ("commands", "physics", "push", "randomization", "reset", "rewards", "termination", "terrain")
"""Groups of ``environment`` with settings that a stretch may change; the others belong to the networks or to the whole run."""


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Root of the settings' names."""

    environment: EnvironmentConfiguration


def stretch_at(schedule: ScheduleConfiguration, step: int) -> int:
    """Return how many stretches have begun after a number of environment steps of the run."""
    begins = [stretch.begin for stretch in schedule.stretches if stretch.begin < 1.0]
    return sum(step >= round(begin * schedule.horizon_steps) for begin in begins)


def settings_in(configuration: EnvironmentConfiguration, stretch: int) -> EnvironmentConfiguration:
    """Return the settings after a number of stretches have begun; what they say of ground that the task does not have is left out.

    Raises:
        TaskError: an unknown key, or a value that does not fit.
        ConfigurationError: the stretches are not in order, or one changes what belongs to the whole run.
    """
    stretches = configuration.schedule.stretches
    begins = [each.begin for each in stretches]
    if begins != sorted(begins):
        raise ConfigurationError(
            f"environment.schedule.stretches begin at {begins} of the run; they must follow in order"
        )
    absent = TILE_KINDS.keys() - {tile.name for tile in configuration.terrain.tiles}
    settings = [
        setting
        for each in stretches[:stretch]
        for setting in each.settings.split()
        if setting.removeprefix("environment.terrain.tiles.").split(".")[0] not in absent
    ]
    for setting in settings:
        if setting.split(".")[0] != "environment" or setting.split(".")[1:2] not in [[name] for name in CHANGEABLE]:
            raise ConfigurationError(
                f"a stretch of environment.schedule changes {shown(setting)}; it may change environment.… settings of "
                f"{', '.join(CHANGEABLE)}"
            )
    return apply_overrides(_Settings(environment=configuration), settings).environment


def check_stretches(configuration: EnvironmentConfiguration, robot: Robot, contract: PolicyContract) -> None:
    """Refuse settings of any stretch that make no sense, and those that do not fit ``contract``, the policy of the whole run. Raises
    ConfigurationError, TaskError: one sentence.
    """
    from .policy_interface import joint_parameters, training_contract  # loads torch, which a refusal must not wait for
    from .step_reader import soft_speed_limits

    for number in range(len(configuration.schedule.stretches) + 1):
        settings = settings_in(configuration, number)
        slow, fast = settings.randomization.motor_speed
        if (slow, fast) != (1.0, 1.0) and not settings.physics.torque_speed_limit:
            raise ConfigurationError(
                f"environment.randomization.motor_speed is {slow:g} to {fast:g} while environment.physics.torque_speed_limit is "
                "off, without which it does nothing; turn the limit on, or leave motor_speed at 1,1"
            )
        if number == 0:
            continue
        name = shown(configuration.schedule.stretches[number - 1].name)
        if settings.terrain.levels != configuration.terrain.levels:
            raise ConfigurationError(
                f"stretch {name} of environment.schedule has {settings.terrain.levels} levels of terrain, the run begins with "
                f"{configuration.terrain.levels}; give environment.terrain.levels for the whole run"
            )
        parameters = joint_parameters(robot, settings)
        soft_speed_limits(settings.rewards, robot, parameters)
        its = training_contract(robot, parameters, settings)
        if lines := difference(its, contract):
            raise ConfigurationError(
                f"stretch {name} of environment.schedule makes another policy contract ({lines.splitlines()[0]}); give that "
                "setting for the whole run"
            )


def first_alone(configuration: EnvironmentConfiguration) -> list[str]:
    """Return overrides that leave the stretches out, for measurements of a few iterations."""
    return [f"environment.schedule.stretches.{each.name}.begin=1" for each in configuration.schedule.stretches]


def without(configuration: EnvironmentConfiguration, keys: set[str]) -> EnvironmentConfiguration:
    """Return the configuration with stretches that leave some settings as they are, by key: those that a command gives hold throughout."""
    schedule = configuration.schedule
    if not keys or not schedule.stretches:
        return configuration
    kept = tuple(replace(each, settings=" ".join(_kept(each, keys))) for each in schedule.stretches)
    return replace(configuration, schedule=replace(schedule, stretches=kept))


def _kept(stretch: Stretch, keys: set[str]) -> list[str]:
    """Return the settings of a stretch but for some, by key."""
    return [setting for setting in stretch.settings.split() if setting.split("=", 1)[0] not in keys]


def with_own(configuration: EnvironmentConfiguration, given: Iterable[str]) -> EnvironmentConfiguration:
    """Return the configuration with settings of single stretches, each ``STRETCH:key=value``, in place of the stretch's own. Raises
    TaskError: no such stretch, or no setting.
    """
    stretches = {each.name: each for each in configuration.schedule.stretches}
    for setting in given:
        name, _, own = map(str.strip, setting.partition(":"))
        if name not in stretches:
            known = f"its stretches are: {', '.join(stretches)}" if stretches else "the task has no stretches"
            raise TaskError(f"{shown(setting)} is for stretch {shown(name)}; {known}")
        if "=" not in own:
            raise TaskError(f"{shown(setting)} is no setting of a stretch; write {name}:environment.…=value")
        kept = _kept(stretches[name], {own.split("=", 1)[0].strip()})
        stretches[name] = replace(stretches[name], settings=" ".join((*kept, "".join(own.split()))))
    return replace(configuration, schedule=replace(configuration.schedule, stretches=tuple(stretches.values())))
