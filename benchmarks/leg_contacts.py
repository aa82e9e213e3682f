"""Whether a policy's legs strike each other on level ground, and what that does to its walking.

    python benchmarks/leg_contacts.py pretrained other.gauge.pt --friction 1.0

Robots walk with full and half commands for 5 s, with noise, latency and physics of a suite, once as it is and once with parts of the
robot that pass through each other. Prints the share of control steps at whose end parts of a robot touch, the mean error of the
yaw rate, and the pairs that touch most often.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, replace

import mujoco
import torch
from gaitgauge.backends.base import Randomization, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.suite import Suite, load_suite
from gaitgauge.gauge.walking import Walk
from gaitgauge.policy.its_robot import robot_for
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import Robot
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
    pairs: Counter[str]


def self_contacts(model: mujoco.MjModel, data: mujoco.MjData) -> set[str]:
    """Pairs of the robot's geoms that overlap; there is nothing else in the model."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    touching = (c for c in data.contact[: data.ncon] if c.dist < 0.0)
    return {"–".join(sorted((model.geom(c.geom1).name, model.geom(c.geom2).name))) for c in touching}


def walk(
    path: str, robot: Robot, suite: Suite, commands: torch.Tensor, options: argparse.Namespace, *, self_collision: bool
) -> list[Watched]:
    """Let robots walk with each of the commands, (N, 3), and watch them."""
    count, each = len(commands), options.robots
    scene = Scene(
        robot=robot,
        parameters=robot.parameters[suite.parameters],
        terrains=(flat(),),
        terrain_index=(0,) * (count * each),
        physics=replace(suite.physics, self_collision=self_collision),
    )
    backend = make_backend("mujoco", scene, device="cpu")
    backend.randomize(Randomization(friction=torch.full((count * each,), options.friction)))
    episodes = [
        Episode(
            terrain="flat",
            level=0,
            friction=options.friction,
            payload=0.0,
            seed=seed,
            stage="legs",
            goals=(str(command),),
        )
        for command in range(count)
        for seed in range(each)
    ]
    steps = SETTLED + round(options.seconds / suite.physics.control_period)
    robots = Walk(load_policy(path), backend, suite.noise, episodes, steps=steps)
    position = torch.zeros(count * each, 3, dtype=backend.dtype)
    position[:, 2] = robot.stand_height
    robots.reset(position, torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=backend.dtype).expand(count * each, -1))
    told = commands.repeat_interleave(each, 0)
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    data = mujoco.MjData(model)
    joints = [model.joint(name).qposadr[0] for name in robot.joint_names]
    found = [Watched(pairs=Counter()) for _ in range(count)]
    for step in range(steps):
        robots.step(told * (step >= STANDING))
        if step < SETTLED:
            continue
        yaw_error = (robots.state.base_angular_velocity_b[:, 2] - told[:, 2]).abs()
        for world in range(count * each):
            data.qpos[joints] = robots.state.joint_position[world]
            pairs = self_contacts(model, data)
            watched = found[world // each]
            watched.steps += 1
            watched.touching += bool(pairs)
            watched.yaw_error += float(yaw_error[world])
            watched.pairs.update(pairs)
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
        contract = load_policy(path).contract
        robot = robot_for(contract)
        limits = torch.tensor(robot.command_limits)
        names = [f"{name}, {share:g}" for share in options.shares for name in DIRECTIONS]
        commands = torch.cat([share * limits * torch.tensor(list(DIRECTIONS.values())) for share in options.shares])
        print(f"{path}, friction {options.friction:g}: with self-collision, and without", flush=True)
        both = [walk(path, robot, suite, commands, options, self_collision=on) for on in (True, False)]
        for name, on, off in zip(names, *both, strict=True):
            pairs = ", ".join(f"{pair} {100 * n / on.steps:.0f} %" for pair, n in on.pairs.most_common(3))
            shares = " and ".join(f"{100 * w.touching / w.steps:5.1f} %" for w in (on, off))
            errors = " and ".join(f"{w.yaw_error / w.steps:.2f}" for w in (on, off))
            print(f"  {name:16} touching {shares}, yaw rate off by {errors} rad/s  {pairs}", flush=True)


if __name__ == "__main__":
    main()
