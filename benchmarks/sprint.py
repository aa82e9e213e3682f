"""How fast a policy runs on level ground, and how well it keeps the speed: the paper's test of its fast task.

    python benchmarks/sprint.py logs/rsl_rl/go2_sprint/RUN/model_2000.pt --speed 4.2 --reach 4.0

Robots stand for a second, are told to run straight ahead, and to stop after the runway (the paper's has 8 m, a robot
gets there 4.01 m/s within 2.16 s with an error of 0.20 m/s). Physics and noise are those of a suite, in MuJoCo, with the
motors' torque-speed limits. Prints the time until the forward speed, a mean over 0.1 s, first comes to ``--reach``, its
peak, the mean error from then to the runway's end, falls, and joint speeds.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace

import torch
from gaitgauge.backends.base import PhysicsState, Randomization, ResetState, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from gaitgauge.robots.rotation import rotate_inverse
from gaitgauge.terrains.registry import make_terrain

STAND, BRAKE = 1.0, 2.0
"""Time before the run and after it [s]."""
SMOOTHING = 0.1
"""Time over which speeds are averaged [s]."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """What happened; R robots, T control steps."""

    period: float
    """Control period [s]."""
    speed: torch.Tensor
    """Forward speed of the base, smoothed [m/s], (T, R)."""
    running: torch.Tensor
    """Whether the command was to run, (T, R) bool."""
    joint_speed: torch.Tensor
    """Absolute joint speeds while running, NaN elsewhere [rad/s], (T, R, J)."""
    fallen: torch.Tensor
    """(R,) bool."""


def run(policy_path: str, *, speed: float, runway: float, friction: float, robots: int, seed: int, suite: str) -> Run:
    """Let robots run.

    Args:
        policy_path: what ``gaitgauge evaluate`` takes.
        speed: commanded forward speed [m/s].
        runway: way after which the command is to stand [m].
        friction: sliding friction.
        robots: how many run side by side, each with noise of its own.
        seed: of the noise.
        suite: whose physics and noise act.
    """
    rules, policy = load_suite(suite), load_policy(policy_path)
    robot = load_robot(policy.contract.robot)
    scene = Scene(
        robot=robot,
        parameters=robot.parameters[rules.parameters],
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * robots,
        physics=replace(rules.physics, torque_limits=True, torque_speed_limit=True),
    )
    physics = make_backend("mujoco", scene)
    session, builder = policy.session(robots), ObservationBuilder(policy.contract, robot, robots)
    random = torch.Generator().manual_seed(seed)

    def noise(state: PhysicsState, name: str) -> torch.Tensor:
        width = getattr(rules.noise, name.removesuffix("_b"))
        return width * (2.0 * torch.rand(getattr(state, name).shape, generator=random) - 1.0)

    try:
        physics.randomize(Randomization(friction=torch.full((robots,), friction)))
        position = torch.tensor([0.0, 0.0, robot.stand_height]).expand(robots, 3)
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(robots, 4)
        default = torch.tensor(robot.default_joint_position).expand(robots, -1)
        physics.reset(ResetState(base_position=position, base_quaternion=upright, held_target=default))
        period = scene.physics.control_period
        longest = STAND + 2.0 * runway / speed + 3.0 + BRAKE
        speeds, commands, joints = [], [], []
        command, action = torch.zeros(robots, 3), torch.zeros(robots, policy.contract.num_joints)
        fallen, stopped = torch.zeros(robots, dtype=torch.bool), torch.zeros(robots, dtype=torch.bool)
        for step in range(round(longest / period)):
            state = physics.state
            stopped |= state.base_position_w[:, 0].float() >= runway
            runs = ~stopped & (step * period >= STAND)
            command[:, 0] = speed * runs
            noisy = {
                name: noise(state, name) for name in ("base_angular_velocity_b", "joint_position", "joint_velocity")
            }
            action = session.act(builder.build(state, command, action, noisy))
            delay = torch.randint(rules.noise.latency + 1, (robots,), generator=random)
            physics.step(builder.targets(action), delay=delay)
            state = physics.state
            forward = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)[:, 0].float()
            up = 1.0 - 2.0 * state.base_quaternion_w[:, 1:3].square().sum(dim=1)
            fallen |= (up < math.cos(1.2)) | state.diverged | (state.trunk_contact_force_w.norm(dim=1) > 1.0)
            speeds.append(forward.clone())
            commands.append(runs)
            joints.append(torch.where(runs[:, None], state.joint_velocity.float().abs(), math.nan))
        window = round(SMOOTHING / period)
        raw = torch.stack(speeds)
        padded = torch.cat((torch.zeros(window - 1, robots), raw))
        smooth = padded.unfold(0, window, 1).mean(dim=-1)
        return Run(
            period=period, speed=smooth, running=torch.stack(commands), joint_speed=torch.stack(joints), fallen=fallen
        )
    finally:
        physics.close()


def lines(done: Run, *, speed: float, reach: float) -> list[str]:
    """What is printed, a line each."""
    start = done.running.int().argmax(dim=0)
    there = done.running & (done.speed >= reach)
    reached = there.any(dim=0)
    time = (there.int().argmax(dim=0) - start + 1) * done.period
    after = done.running & (torch.arange(len(done.speed))[:, None] >= there.int().argmax(dim=0)) & reached
    error = (done.speed - speed).abs()[after]
    rows = [
        f"robots                       {len(reached)}, of which fell {int(done.fallen.sum())}",
        f"came to {reach:g} m/s             {int(reached.sum())}",
        f"peak forward speed           {done.speed.amax(dim=0).mean():.2f} m/s",
    ]
    if reached.any():
        rows += [
            f"time to {reach:g} m/s             {time[reached].mean():.2f} s ({time[reached].min():.2f} to {time[reached].max():.2f})",
            f"error from there on          {error.mean():.2f} m/s",
        ]
    for joint, name in enumerate(("hips", "thighs", "calves")):
        seen = done.joint_speed[..., joint::3]
        seen = seen[seen.isfinite()]
        rows.append(f"{name + ' turn at up to':<28} {seen.max():.1f} rad/s, 99 % below {seen.quantile(0.99):.1f} rad/s")
    return rows


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("--speed", type=float, default=4.2, help="commanded forward speed [m/s]")
    parser.add_argument("--reach", type=float, default=4.0, help="speed whose time is taken [m/s]")
    parser.add_argument("--runway", type=float, default=8.0, help="way after which the robot is to stop [m]")
    parser.add_argument("--friction", type=float, default=0.6)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--suite", default="robogauge-1.1", help="suite whose physics and noise act")
    given = parser.parse_args()
    done = run(
        given.policy,
        speed=given.speed,
        runway=given.runway,
        friction=given.friction,
        robots=given.robots,
        seed=given.seed,
        suite=given.suite,
    )
    print("\n".join(lines(done, speed=given.speed, reach=given.reach)))


if __name__ == "__main__":
    main()
