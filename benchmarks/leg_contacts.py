"""Whether a policy's legs strike each other on level ground, and what that does to its walking.

    python benchmarks/leg_contacts.py pretrained other.gauge.pt --friction 1.0

Robots walk with full and half commands for 5 s, with noise, latency and physics of a suite, once as it is and once with
parts of the robot that pass through each other. Prints the share of control steps at whose end parts of a robot touch, the
mean error of the yaw rate, the pairs that touch most often, and how many robots fell; what has fallen is not watched.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field, replace

import torch
from gaitgauge.backends.base import Randomization, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.play.self_contact import SelfContact
from gaitgauge.gauge.suite import Suite, load_suite
from gaitgauge.policy.base import Policy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.robot_of import robot_for
from gaitgauge.robots.rotation import tilt
from gaitgauge.studies.walking import Walk
from gaitgauge.terrains.gauge_terrains import flat

DIRECTIONS = {
    "ahead": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "ahead left": (1, 1, 0),
    "back right": (-1, -1, 0),
    "turning": (0, 0, 1),
    "all three": (1, 1, 1),
}
"""Shares of the largest forward, lateral and yaw speed."""
STANDING, SETTLED = 25, 75
"""Control steps before the robots set out, and before they are watched."""


@dataclass(kw_only=True)
class Watched:
    """Robots with one command."""

    steps: int = 0
    touching: int = 0
    """Steps at whose end parts of the robot touched."""
    yaw_error: float = 0.0
    """Sum over steps [rad/s]."""
    pairs: Counter[str] = field(default_factory=Counter)
    falls: int = 0

    @property
    def touching_share(self) -> float:
        """Share of the steps in which parts touched, NaN where none was watched."""
        return self.touching / self.steps if self.steps else math.nan

    @property
    def mean_yaw_error(self) -> float:
        """[rad/s], NaN where no step was watched."""
        return self.yaw_error / self.steps if self.steps else math.nan


def walk(
    policy: Policy, suite: Suite, commands: torch.Tensor, options: argparse.Namespace, *, self_collision: bool
) -> list[Watched]:
    """Let robots walk with each of the commands, (N, 3), and watch them."""
    robot = robot_for(policy.contract)
    command_of = [command for command in range(len(commands)) for _ in range(options.robots)]
    episodes = [
        Episode(
            terrain="flat",
            level=0,
            friction=options.friction,
            payload=0.0,
            seed=world % options.robots,
            stage="legs",
            goals=(str(command),),
        )
        for world, command in enumerate(command_of)
    ]
    scene = Scene(
        robot=robot,
        parameters=robot.parameters[suite.parameters],
        terrains=(flat(),),
        terrain_index=(0,) * len(episodes),
        physics=replace(suite.physics, self_collision=self_collision),
    )
    contact = SelfContact(robot)
    steps = SETTLED + round(options.seconds / scene.physics.control_period)
    found = [Watched() for _ in commands]
    with closing(make_backend("mujoco", scene, device="cpu")) as physics:
        robots = Walk(policy, physics, suite.noise, episodes, steps=steps)
        physics.randomize(Randomization(friction=robots.tensor([options.friction] * len(episodes))))
        robots.reset(
            robots.tensor([(0.0, 0.0, robot.stand_height)] * len(episodes)),
            robots.tensor([(1.0, 0.0, 0.0, 0.0)] * len(episodes)),
        )
        told = commands[command_of]
        fallen = torch.zeros(len(episodes), dtype=torch.bool)
        for step in range(steps):
            robots.step(told * (step >= STANDING))
            state = robots.state
            fallen |= state.diverged | (tilt(state.base_quaternion_w) > suite.events.fall_tilt)
            if step < SETTLED:
                continue
            yaw_error = (state.base_angular_velocity_b[:, 2] - told[:, 2]).abs()
            for world in (~fallen).nonzero()[:, 0].tolist():
                pairs = contact.pairs(state.joint_position[world].numpy())
                watched = found[command_of[world]]
                watched.steps += 1
                watched.touching += bool(pairs)
                watched.yaw_error += float(yaw_error[world])
                watched.pairs.update(pairs)
    for world in fallen.nonzero()[:, 0].tolist():
        found[command_of[world]].falls += 1
    return found


def main() -> None:
    """Watch each policy with and without self-collision."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--friction", type=float, default=1.0)
    parser.add_argument("--suite", default="robogauge-1.1")
    parser.add_argument("--robots", type=int, default=4, help="for each command")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.5, 1.0], help="of the largest command")
    options = parser.parse_args()
    suite = load_suite(options.suite)
    for path in options.policies:
        policy = load_policy(path)
        limits = torch.tensor(robot_for(policy.contract).command_limits)
        names = [f"{name}, {share:g}" for share in options.shares for name in DIRECTIONS]
        commands = torch.cat([share * limits * torch.tensor(list(DIRECTIONS.values())) for share in options.shares])
        print(f"{path}, friction {options.friction:g}: with self-collision, and without", flush=True)
        both = [walk(policy, suite, commands, options, self_collision=on) for on in (True, False)]
        for name, on, off in zip(names, *both, strict=True):
            pairs = "".join(f", {pair} {100 * n / on.steps:.0f} %" for pair, n in on.pairs.most_common(3))
            shares = " and ".join(f"{100 * w.touching_share:5.1f} %" for w in (on, off))
            errors = " and ".join(f"{w.mean_yaw_error:.2f}" for w in (on, off))
            print(
                f"  {name:16} touching {shares}, yaw rate off by {errors} rad/s, {on.falls} and {off.falls} fell{pairs}",
                flush=True,
            )


if __name__ == "__main__":
    main()
