"""Suits a suite to a policy: commands within what the policy was made for, and its control period; and counts commands beyond."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Literal

from ..policy.contract import PolicyContract
from ..robots import Robot
from ..robots.anatomy.body_plan import body_plan
from .commands import Command
from .ground_rules import longer
from .metric_rules import GO2_LEG, GO2_MASS
from .suite import Commands, Suite, SuiteError

Axis = Literal["forward", "lateral", "yaw"]
AXES: tuple[Axis, ...] = ("forward", "lateral", "yaw")
WORDS: Mapping[Axis, tuple[str, str]] = {
    "forward": ("forward", "m/s"),
    "lateral": ("sideways", "m/s"),
    "yaw": ("turning", "rad/s"),
}


def suited(suite: Suite, contract: PolicyContract) -> Suite:
    """Return the suite as a policy is played on it; its digest stays that of the suite.

    ``commands.beyond`` says what becomes of commands beyond the policy's limits. A policy of another control period is played at
    its own, where that is a multiple of the physics step.

    Raises:
        SuiteError: the suite goes by the policy's own limits, and one of them is zero.
    """
    found, limits = suite, contract.command_limits
    if suite.commands.beyond != "published":
        if 0.0 in limits:
            name, _ = WORDS[AXES[limits.index(0.0)]]
            raise SuiteError(
                f"the policy's command limit is 0 for {name}, and suite '{suite.name}' measures by the policy's own limits "
                f'(commands.beyond = "{suite.commands.beyond}"); use a suite that plays its published commands'
            )
        found = replace(found, commands=_within(suite.commands, limits))
    substeps = max(round(contract.control_period / suite.physics.timestep), 1)
    multiple = abs(substeps * suite.physics.timestep - contract.control_period) < 1e-9
    if multiple and substeps != suite.physics.substeps:
        found = replace(
            found,
            physics=replace(suite.physics, substeps=substeps),
            metrics=replace(suite.metrics, interval=max(suite.metrics.interval, substeps)),
            noise=replace(suite.noise, latency=min(suite.noise.latency, substeps)),
        )
    return suite if found == suite else replace(found, written=suite)


def measured(suite: Suite, robot: Robot) -> Suite:
    """Return the suite with the target's radius in a robot's own measure, where the suite says so; its digest stays that of the suite."""
    if suite.ground is None:
        return suite
    radius = suite.commands.target_radius * longer(suite.ground, robot)
    return replace(
        suite,
        commands=replace(suite.commands, target_radius=radius),
        written=suite if suite.written is None else suite.written,
    )


def other_measure(suite: Suite, robot: Robot) -> str | None:
    """Return what a suite of fixed measure does to a robot far larger or smaller than a Go2, None where it does nothing."""
    plan = body_plan(robot)
    times = plan.mass * plan.leg_length / (GO2_MASS * GO2_LEG)
    if suite.metrics.measure == "robot" or 0.5 <= times <= 2.0:
        return None
    return (
        f"{suite.name} judges torque and power as a Go2's, and weight times leg length of '{robot.name}' is {times:.2g} times a Go2's: "
        "dof_power and torque_smoothness say little here; gaitgauge-1 judges them in the robot's own measure"
    )


def _within(commands: Commands, limits: Command) -> Commands:
    def fitted(values: Command) -> Command:
        if commands.beyond == "scale":
            forward, lateral, yaw = (share * most for share, most in zip(values, limits, strict=True))
        else:
            forward, lateral, yaw = (min(value, most) for value, most in zip(values, limits, strict=True))
        return forward, lateral, yaw

    speeds = {family: fitted((speed, 0.0, 0.0))[0] for family, speed in commands.target_speed.items()}
    return replace(commands, flat=fitted(commands.flat), levelled=fitted(commands.levelled), target_speed=speeds)


def changes(suite: Suite) -> list[str]:
    """Return what was changed of a suite for a policy and takes its name away, in words; empty where it is the suite's own."""
    if suite.written is None:
        return []
    found, written = [], suite.written.commands
    if suite.commands.beyond == "clip" and (suite.commands.flat, suite.commands.levelled) != (
        written.flat,
        written.levelled,
    ):
        parts = [
            f"{WORDS[axis][0]} {now:g} of {then:g} {WORDS[axis][1]}"
            for axis, now, then in zip(AXES, suite.commands.flat, written.flat, strict=True)
            if now != then
        ]
        found.append(f"commands clipped to the policy's limits ({', '.join(parts) or 'on levelled terrains'})")
    if suite.physics.control_period != suite.written.physics.control_period:
        found.append(
            f"control period {suite.physics.control_period:g} s of the policy, not {suite.written.physics.control_period:g} s"
        )
    return found


def shares_beyond(suite: Suite, families: Collection[str], limits: Command) -> dict[Axis, float]:
    """Return for each axis the share of a suite's commands on it that are larger than a policy's limit; axes without one are left out.

    Counted are control steps of the goals with commands of their own, on these terrain families.
    """
    import torch

    from .goals import TARGET, Schedule

    schedule = Schedule(suite, torch.device("cpu"), torch.float64)
    asked = [0] * len(AXES)
    above = [0] * len(AXES)
    for family in families:
        most = suite.command_limits(family)
        for goal, sub_commands in schedule.sub_commands.items():
            for command in (c for row in sub_commands for c in row if goal != TARGET):
                for axis in range(len(AXES)):
                    size = abs(command[axis]) * most[axis]
                    asked[axis] += size > 0.0
                    above[axis] += size > limits[axis] + 1e-9
    return {axis: above[i] / asked[i] for i, axis in enumerate(AXES) if above[i]}


def beyond_in_words(limits: Command | None, beyond: Mapping[Axis, float]) -> str | None:
    """Return a sentence on commands beyond a policy's limits, None where there are none."""
    if not beyond or limits is None:
        return None
    most = dict(zip(AXES, limits, strict=True))
    parts = [
        f"{100 * share:.0f} % of the commands {WORDS[axis][0]} (made for {most[axis]:g} {WORDS[axis][1]})"
        for axis, share in beyond.items()
    ]
    return f"the suite asks for more than the policy was made for: {', '.join(parts)}"
