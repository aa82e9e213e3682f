"""Walk a policy on level ground at each of its command limits, without noise, latency or pushes; say who falls and how fast it goes.

    python benchmarks/level_walks.py policy.onnx --robot robot.toml [--seconds 20] [--contract contract.toml] [--moving waist]

Eight robots side by side: standing, forward, backward at half of the limit (many policies have a smaller one there), left, right,
turning both ways, and an arc at half of the limits. Motors have the gains of the policy's contract and the torque limits of
``gaitgauge-1``. Three columns are deviations from the mean, RMS: ``bobs``, of the vertical speed [m/s]; ``rocks``, of the roll and pitch
rates, and ``sways``, of the yaw rate [rad/s]. ``--moving`` makes the joints that the policy does not drive rigid but for those of the
roles given; ``none`` makes all rigid. The exit code is 1 if one falls.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from gaitgauge.backends import Scene, make_backend
from gaitgauge.gauge.motors import joint_parameters
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.robot_of import robot_for
from gaitgauge.robots import load_robot
from gaitgauge.robots.rotation import rotate_inverse
from gaitgauge.robots.welding import welded
from gaitgauge.studies.walking import Walk
from gaitgauge.terrains.registry import make_terrain
from gaitgauge.training.environment.policy_interface import joints_of

SHARES = ((0, 0, 0), (1, 0, 0), (-0.5, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (0.5, 0, 0.5))


def main() -> None:
    """Print one line for each robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("--robot")
    parser.add_argument("--contract", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--moving", nargs="+", help="roles of held joints that are not rigid, or none")
    arguments = parser.parse_args()
    asked = None if arguments.robot is None else load_robot(arguments.robot)
    policy = load_policy(arguments.policy, asked, contract_file=arguments.contract)
    robot, period = robot_for(policy.contract, arguments.robot), policy.contract.control_period
    if arguments.moving:
        robot = replace(robot, driven_joints=policy.contract.joint_names)
        moving = joints_of(robot, [role for role in arguments.moving if role != "none"], "moving")
        robot = welded(robot, Path(tempfile.mkdtemp(prefix="gaitgauge-rigid-")), moving)
        policy = load_policy(arguments.policy, robot, contract_file=arguments.contract)
    suite, count = load_suite("gaitgauge-1"), len(SHARES)
    physics = replace(suite.physics, substeps=round(period / suite.physics.timestep), torque_speed_limit=False)
    scene = Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, policy.contract),
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * count,
        physics=physics,
    )
    backend = make_backend("mujoco", scene)
    walk, start = Walk(policy, backend), backend.standing()
    walk.reset(start.base_position, start.base_quaternion)
    command = walk.tensor(SHARES) * walk.tensor(policy.contract.command_limits)
    fell, seen = torch.full((count,), torch.inf), list[torch.Tensor]()
    steps = round(arguments.seconds / period)
    for step in range(steps):
        walk.step(command * (step * period >= 1.0))
        state = walk.state
        fell = torch.where((state.tilt_substep > 0) & fell.isinf(), step * period, fell)
        if step >= steps // 2:
            linear = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)
            seen.append(torch.cat((linear, state.base_angular_velocity_b), dim=1))
    spread, mean = (each.tolist() for each in torch.std_mean(torch.stack(seen), dim=0, correction=0))
    for told, walks, swings, at in zip(command.tolist(), mean, spread, fell.tolist(), strict=True):
        ending = "does not fall" if at == float("inf") else f"falls after {at:.1f} s"
        told_walks = "told {:5.2f} {:5.2f} {:5.2f}  walks {:5.2f} {:5.2f} {:5.2f}".format(*told, *walks[:2], walks[5])
        print(told_walks, " bobs {2:4.2f}  rocks {3:4.2f} {4:4.2f}  sways {5:4.2f}".format(*swings), "", ending)
    sys.exit(int(fell.isfinite().any()))


if __name__ == "__main__":
    main()
