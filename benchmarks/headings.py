"""Where a policy heads while it is led up the gauge's stairs or over its bars, and what keeps it from arriving.

    python benchmarks/headings.py pretrained RUN/model_1800.pt --terrain stairs --level 8 --friction 0.7
    python benchmarks/headings.py pretrained --level 8 --training speed --riser 0.21 --tread 0.26

Robots walk from the start of the level search to the target, steered as robogauge-1.1 steers, with its noise and latency. Prints
how many arrive, their way along the stairs, the share of the time that they head more than 45 and 90 degrees away from the
target's direction, and the yaw rate that they have, along the commanded one, while that is at its limit. ``--training`` puts
the physics, joints and motors of training in place of the gauge's; other options change one thing at a time.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from gaitgauge.backends.base import TRAINING_PHYSICS, PhysicsBackend, Randomization, ResetState, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.goals import target_command, target_offset
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.policy.robot_of import robot_for
from gaitgauge.robots.rotation import yaw_of
from gaitgauge.terrains import gauge_terrains
from gaitgauge.terrains.base import Box, Terrain

YAW_LIMIT, STANDING = 1.5, 25
"""Largest yaw rate [rad/s], and control steps before the robots set out."""


@dataclass(frozen=True, kw_only=True)
class Changes:
    """What differs from the gauge's own episodes."""

    training: bool = False
    """Physics and joints of training."""
    speed_limit: bool = True
    """Whether training's motors lose torque with speed."""
    motor_limits: Literal["torque", "speed"] | None = None
    """Limits of the gauge's motors: of torque, or also of torque over speed; None for the suite's own."""
    riser: float | None = None
    """Height of a step [m]."""
    tread: float | None = None
    """Depth of a step [m]."""
    gravity_noise: float = 0.0
    """Half-width of the noise on each component of projected gravity."""
    strength: float = 0.0
    """Motors are up to so much stronger or weaker, as a share."""
    push: float = 0.0
    """Largest push along each axis, every 4 s [m/s]."""


def ground(terrain: str, level: int, changes: Changes) -> Terrain:
    """The gauge's terrain, with other steps where they are asked for."""
    found: Terrain = getattr(gauge_terrains, terrain)(level)
    if changes.riser is None and changes.tread is None:
        return found
    riser = changes.riser or gauge_terrains.STAIR_RISERS[level - 1]
    tread = changes.tread or gauge_terrains.STAIR_TREAD
    steps = tuple(
        Box(center=(tread * (i + 0.5), 0.0, (i + 0.5) * riser), half_size=(0.6 * tread, 5.0, riser / 2))
        for i in range(math.floor(10.0 / tread) + 1)
    )
    return replace(found, boxes=steps + tuple(box for box in found.boxes if box.wall))


class Walk:
    """Robots on their way to the target of one terrain."""

    def __init__(
        self, policy: str, terrain: Terrain, *, robots: int, friction: float, seed: int, changes: Changes
    ) -> None:
        """Put them at the start."""
        loaded = load_policy(policy)
        robot, suite = robot_for(loaded.contract), load_suite("robogauge-1.1")
        own = TRAINING_PHYSICS if changes.speed_limit else replace(TRAINING_PHYSICS, torque_speed_limit=False)
        parameters = "training" if changes.training and "training" in robot.parameters else robot.default_parameters
        by_speed = changes.motor_limits == "speed"
        limited = replace(suite.physics, torque_limits=True, torque_speed_limit=by_speed)
        gauge = limited if changes.motor_limits else suite.physics
        self.physics = own if changes.training else gauge
        self.noise = replace(suite.noise, projected_gravity=changes.gravity_noise)
        self.latency = round(suite.noise.latency * suite.physics.timestep / self.physics.timestep)
        self.terrain, self.changes, self.speed = terrain, changes, suite.commands.target_speed[terrain.family]
        self.target = torch.tensor(terrain.target, dtype=torch.float64)
        self.random = torch.Generator().manual_seed(seed)
        scene = Scene(
            robot=robot,
            parameters=robot.parameters[parameters],
            terrains=(terrain,),
            terrain_index=(0,) * robots,
            physics=self.physics,
        )
        self.backend: PhysicsBackend = make_backend("mujoco", scene, device="cpu")
        strength = 1.0 + self._noise(changes.strength, robots, robot.num_joints)
        self.backend.randomize(Randomization(friction=torch.full((robots,), friction), motor_strength=strength))
        start = torch.tensor(terrain.spawns["level_search"].position, dtype=torch.float64).repeat(robots, 1)
        start[:, 2] += robot.stand_height
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(robots, 1)
        self.backend.reset(ResetState(base_position=start, base_quaternion=upright))
        self.start = start[:, 0]
        self.builder, self.session = ObservationBuilder(loaded.contract, robot, robots), loaded.session(robots)
        self.action = torch.zeros(robots, robot.num_joints)
        self.walking = torch.ones(robots, dtype=torch.bool)
        self.off: list[torch.Tensor] = []
        self.turning: list[torch.Tensor] = []

    def _noise(self, half_width: float, *shape: int) -> torch.Tensor:
        return half_width * (2.0 * torch.rand(*shape, generator=self.random) - 1.0)

    def step(self, number: int) -> None:
        """One control step; those that arrived stand still and are not counted."""
        state, count = self.backend.state, len(self.walking)
        offset = target_offset(state, self.target, "body")
        self.walking &= offset.norm(dim=1) >= 0.1
        everywhere = torch.full((count,), 1.0, dtype=torch.float64)
        backward = torch.zeros(count, dtype=torch.bool)
        command = target_command(offset, backward, self.speed * everywhere, YAW_LIMIT * everywhere).float()
        command *= (self.walking & (number >= STANDING))[:, None]
        joints = self.action.shape[1]
        noise = {
            "base_angular_velocity_b": self._noise(self.noise.base_angular_velocity, count, 3),
            "joint_position": self._noise(self.noise.joint_position, count, joints),
            "joint_velocity": self._noise(self.noise.joint_velocity, count, joints),
            "projected_gravity_b": self._noise(self.noise.projected_gravity, count, 3),
        }
        self.action = self.session.act(self.builder.build(state, command, self.action, noise))
        delay = torch.randint(self.latency + 1, (count,), generator=self.random)
        before = yaw_of(state.base_quaternion_w).clone()
        self.backend.step(self.builder.targets(self.action), delay=delay)
        if self.changes.push and number % 200 == 150:
            self._push()
        if number < STANDING:
            return
        yaw = yaw_of(self.backend.state.base_quaternion_w)
        turned = torch.remainder(yaw - before + math.pi, 2 * math.pi) - math.pi
        limited = self.walking & (command[:, 2].abs() > 0.95 * YAW_LIMIT)
        self.off.append(yaw[self.walking].abs())
        self.turning.append((turned * command[:, 2].sign())[limited] / self.physics.control_period)

    def _push(self) -> None:
        state, count = self.backend.state, len(self.walking)
        linear = state.base_linear_velocity_w.clone()
        linear[:, :2] += self._noise(self.changes.push, count, 2)
        angular = state.base_angular_velocity_b + self._noise(1.5 * self.changes.push, count, 3)
        everyone = torch.ones(count, dtype=torch.bool)
        self.backend.push(everyone, linear_velocity_w=linear, angular_velocity_b=angular)

    def line(self) -> str:
        """What is printed."""
        way = (self.backend.state.base_position_w[:, 0].minimum(self.target[0]) - self.start).float()
        off, turning = torch.cat(self.off), torch.cat(self.turning)
        rate = f"{float(turning.mean()):.2f} rad/s" if len(turning) else "never"
        return (
            f"arrived {int((~self.walking).sum())} of {len(way)}, way {float(way.mean()):.2f} m (standard error "
            f"{float(way.std()) / math.sqrt(len(way)):.2f}); off by 45 degrees: {float((off > math.pi / 4).float().mean()):.2f} "
            f"of the time, 90: {float((off > math.pi / 2).float().mean()):.2f}; yaw command at its limit "
            f"{len(turning) / max(len(off), 1):.2f} of the time, yaw rate then {rate}"
        )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--terrain", choices=("stairs", "obstacle"), default="stairs")
    parser.add_argument("--level", type=int, default=8)
    parser.add_argument("--friction", type=float, default=0.7)
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--training", choices=("torque", "speed"), help="training's physics, with that limit of motors")
    for name, unit in (("riser", "m"), ("tread", "m"), ("gravity-noise", "1"), ("strength", "share"), ("push", "m/s")):
        parser.add_argument(f"--{name}", type=float, help=f"[{unit}]")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    changes = Changes(
        training=arguments.training is not None,
        speed_limit=arguments.training == "speed",
        riser=arguments.riser,
        tread=arguments.tread,
        gravity_noise=arguments.gravity_noise or 0.0,
        strength=arguments.strength or 0.0,
        push=arguments.push or 0.0,
    )
    for policy in arguments.policies:
        walk = Walk(
            policy,
            ground(arguments.terrain, arguments.level, changes),
            robots=arguments.robots,
            friction=arguments.friction,
            seed=arguments.seed,
            changes=changes,
        )
        with torch.no_grad():
            for number in range(round(arguments.seconds / walk.physics.control_period)):
                walk.step(number)
        print(f"{policy}: {walk.line()}", flush=True)


if __name__ == "__main__":
    main()
