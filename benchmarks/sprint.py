"""How fast a policy runs on level ground, and how well it keeps the speed: the paper's test of its fast task.

    python benchmarks/sprint.py logs/rsl_rl/go2_sprint/RUN/model_2000.pt --speed 4.2 --reach 4.0

The scenario ``sprint`` of ``gaitgauge trial`` with settings of its own: robots stand for a second, are told to run straight
ahead, and to stop after the runway (the paper's has 8 m, a robot gets there 4.01 m/s within 2.16 s with an error of 0.20 m/s).
Prints the time until the forward speed, a mean over 0.1 s, first comes to ``--reach``, its peak, the mean error from then to
the runway's end, falls, and joint speeds.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from gaitgauge.backends.base import PhysicsState
from gaitgauge.files.parsing import Seed, from_text
from gaitgauge.gauge.suite import SuiteError
from gaitgauge.policy.base import Policy, PolicyError
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.robot_of import robot_for
from gaitgauge.robots import Robot
from gaitgauge.robots.anatomy.body_plan import body_plan
from gaitgauge.studies.trials.running import Trial, run_scenario
from gaitgauge.studies.trials.scenario import Scenario, load_scenario
from pydantic import Field

_Speed = Annotated[float, Field(ge=0.1, le=100.0)]
_Way = Annotated[float, Field(gt=0.0, le=50.0)]
_Friction = Annotated[float, Field(ge=0.0, le=10.0)]
_Robots = Annotated[int, Field(ge=1, le=1000)]


def scenario(*, speed: float, reach: float, runway: float, friction: float, suite: str) -> Scenario:
    """The sprint.

    Args:
        speed: commanded forward speed [m/s].
        reach: speed whose time is taken [m/s].
        runway: way after which the command is to stand [m].
        friction: sliding friction.
        suite: whose physics and noise act.
    """
    whole = load_scenario("sprint")
    stand, run, brake = whole.commands
    run = replace(run, velocity=(speed, 0.0, 0.0), until_x=runway, seconds=2.0 * runway / speed + 3.0)
    success = replace(whole.success, speed=reach)
    return replace(whole, commands=(stand, run, brake), success=success, friction=friction, suite=suite)


def run(policy: Policy, robot: Robot, sprint: Scenario, *, robots: int, seed: int) -> tuple[list[Trial], torch.Tensor]:
    """Let robots run, each with noise of its own.

    Returns:
        What came of each, and absolute joint speeds of those that were told to run, (T, J) [rad/s].
    """
    joint_speeds: list[torch.Tensor] = []

    def watch(state: PhysicsState, moving: torch.Tensor) -> None:
        joint_speeds.append(state.joint_velocity[moving].float().abs())

    trials = run_scenario(policy, robot, sprint, range(seed, seed + robots), backend="mujoco", watch=watch)
    return trials, torch.cat(joint_speeds)


def lines(trials: Sequence[Trial], joint_speeds: torch.Tensor, robot: Robot, *, reach: float) -> list[str]:
    """What is printed, a line each; ``joint_speeds`` are those of ``run``, in the robot's order."""
    times = [t.speed_time for t in trials if t.speed_time is not None]
    errors = [t.tracking_error for t in trials if t.speed_time is not None and t.tracking_error is not None]
    rows = [
        f"robots                       {len(trials)}, of which fell {sum(t.outcome == 'fell' for t in trials)}",
        f"came to {reach:g} m/s             {len(times)}",
        f"peak forward speed           {math.fsum(t.peak_speed for t in trials) / len(trials):.2f} m/s",
    ]
    if times:
        mean, least, largest = math.fsum(times) / len(times), min(times), max(times)
        rows += [
            f"time to {reach:g} m/s             {mean:.2f} s ({least:.2f} to {largest:.2f})",
            f"error from there on          {math.fsum(errors) / len(errors):.2f} m/s",
        ]
    plan = body_plan(robot)
    parts = [plan.part(joint) for joint in range(robot.num_joints)]
    for part, name in {"hip": "hips", "thigh": "thighs", "calf": "calves", "": "other joints"}.items():
        joints = [joint for joint, moved in enumerate(parts) if moved == part]
        if not joints:
            continue
        seen = joint_speeds[:, joints].flatten()
        rows.append(f"{name + ' turn at up to':<28} {seen.max():.1f} rad/s, 99 % below {seen.quantile(0.99):.1f} rad/s")
    return rows


def _within(hint: Any) -> Callable[[str], Any]:
    """What argparse reads an option of a type and range with."""
    return lambda text: from_text(hint, text, "value", argparse.ArgumentTypeError)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("--speed", type=_within(_Speed), default=4.2, help="commanded forward speed [m/s]")
    parser.add_argument("--reach", type=_within(_Speed), default=4.0, help="speed whose time is taken [m/s]")
    parser.add_argument("--runway", type=_within(_Way), default=8.0, help="way after which the robot is to stop [m]")
    parser.add_argument("--friction", type=_within(_Friction), default=0.6)
    parser.add_argument("--robots", type=_within(_Robots), default=20)
    parser.add_argument("--seed", type=_within(Seed), default=0)
    parser.add_argument("--suite", default="robogauge-1.1", help="suite whose physics and noise act")
    try:
        sprint_as_told(parser.parse_args())
    except (PolicyError, SuiteError) as error:
        sys.exit(f"error: {error}")


def sprint_as_told(given: argparse.Namespace) -> None:
    """Run and print what the options ask for."""
    sprint = scenario(
        speed=given.speed, reach=given.reach, runway=given.runway, friction=given.friction, suite=given.suite
    )
    policy = load_policy(given.policy)
    robot = robot_for(policy.contract)
    trials, joint_speeds = run(policy, robot, sprint, robots=given.robots, seed=given.seed)
    print("\n".join(lines(trials, joint_speeds, robot, reach=given.reach)))


if __name__ == "__main__":
    main()
