"""Send a biped's policy on walks in MuJoCo, and count how it keeps to its speed and how often it falls.

    python benchmarks/biped_walks.py RUN/best.pt
    python benchmarks/biped_walks.py RUN/best.pt --ground stairs_up stairs_down slope_up slope_down --speed 0.6

Each robot is told the same speed ahead for 10 s, with the noise and latency of gaitgauge-biped-1, on ground of its own friction between
0.4 and 1.0, and a push changes its horizontal velocity by 0.4 m/s in a direction of its own every 2.5 s. Stairs have steps of 10 cm,
slopes 15 degrees; robots start on the platform in the middle of the tile. A robot has fallen where the suite says so. The speed is the mean
along the heading from the third second on; ``went`` is the distance from the start.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from contextlib import closing

import torch
from gaitgauge.backends.base import Randomization, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.motors import joint_parameters
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.robot_of import robot_for
from gaitgauge.robots import Robot, load_robot
from gaitgauge.robots.rotation import from_yaw, in_heading
from gaitgauge.studies.walking import Walk
from gaitgauge.terrains.base import Terrain
from gaitgauge.terrains.registry import make_terrain
from gaitgauge.terrains.training_tiles import TileShape, make_tile

SUITE, SECONDS, SETTLED, PUSH, EVERY = "gaitgauge-biped-1", 10.0, 2.0, 0.4, 2.5


def ground(name: str) -> Terrain:
    """Return level ground, or a tile with steps of 10 cm or slopes of 15 degrees."""
    shape = TileShape(
        stair_riser=(0.1, 0.0), stair_irregularity=0.0, slope_gradient=(math.tan(math.radians(15.0)), 0.0)
    )
    return make_terrain("flat") if name == "flat" else make_tile(name, 0, shape=shape)


def walks(
    policy: str, robot: Robot | None, terrain: Terrain, *, speed: float, count: int
) -> list[tuple[float, float, bool]]:
    """Return mean speed [m/s], distance from the start [m], and whether it fell, of each walk."""
    loaded, suite = load_policy(policy, robot=robot), load_suite(SUITE)
    robot = robot or robot_for(loaded.contract)
    scene = Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, loaded.contract),
        terrains=(terrain,),
        terrain_index=(0,) * count,
        physics=suite.physics,
    )
    frictions = [0.4 + 0.6 * i / max(count - 1, 1) for i in range(count)]
    episodes = [
        Episode(terrain="flat", level=0, friction=mu, payload=0.0, seed=i, stage="trial", goals=())
        for i, mu in enumerate(frictions)
    ]
    steps = round(SECONDS / suite.physics.control_period)
    draw = torch.Generator().manual_seed(0)
    with closing(make_backend("mujoco", scene, device="cpu")) as physics, torch.inference_mode():
        walk = Walk(loaded, physics, suite.noise, episodes, steps=steps)
        physics.randomize(Randomization(friction=walk.tensor(frictions)))
        start = walk.tensor([[0.0, 0.0, float(terrain.height(0.0, 0.0)) + robot.stand_height]] * count)
        walk.reset(start, from_yaw(walk.tensor([2.0 * math.pi * i / count for i in range(count)])))
        command = walk.tensor([[speed, 0.0, 0.0]] * count)
        up = torch.ones(count, dtype=torch.bool)
        total, counted = torch.zeros(count), torch.zeros(count)
        for step in range(1, steps + 1):
            if step % round(EVERY / suite.physics.control_period) == 0:
                turn = 2.0 * math.pi * torch.rand(count, generator=draw)
                velocity = physics.state.base_linear_velocity_w.clone()
                velocity[:, :2] += PUSH * torch.stack((torch.cos(turn), torch.sin(turn)), dim=1)
                velocity[:, 2] = math.nan
                physics.push(linear_velocity_w=velocity, worlds=up)
            walk.step(command, up)
            state = physics.state
            up = up & (state.tilt_substep == 0) & ~state.diverged
            if step * suite.physics.control_period > SETTLED:
                ahead = in_heading(state.base_quaternion_w, state.base_linear_velocity_w)[:, 0]
                total += torch.where(up, ahead, 0.0).float()
                counted += up.float()
        went = (physics.state.base_position_w - start)[:, :2].norm(dim=1)
    return list(zip((total / counted.clamp_min(1.0)).tolist(), went.tolist(), (~up).tolist(), strict=True))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each ground."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="policy file")
    parser.add_argument("--robot", help="robot's name or description; default: the policy's")
    parser.add_argument(
        "--ground", nargs="+", default=["flat"], help="flat, stairs_up, stairs_down, slope_up, slope_down"
    )
    parser.add_argument("--speed", type=float, default=1.0, help="commanded [m/s]")
    parser.add_argument("--walks", type=int, default=20)
    options = parser.parse_args(arguments)
    robot = None if options.robot is None else load_robot(options.robot)
    print("ground        falls  mean speed  worst error  went, least [m]")
    for name in options.ground:
        found = walks(options.policy, robot, ground(name), speed=options.speed, count=options.walks)
        speeds = [speed for speed, _, fell in found if not fell] or [math.nan]
        mean, worst = sum(speeds) / len(speeds), max(abs(each - options.speed) for each in speeds)
        falls, least = sum(fell for *_, fell in found), min(went for _, went, _ in found)
        print(f"{name:12}  {falls:2} of {len(found):2}  {mean:10.3f}  {worst:11.3f}  {least:15.2f}")


if __name__ == "__main__":
    main()
