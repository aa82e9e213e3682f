"""Feet that sink into the gauge's wave, and robots that stand still because of them.

    python benchmarks/sunken_feet.py pretrained RUN/model_1800.pt --level 7 --friction 0.7
    python benchmarks/sunken_feet.py pretrained --level 7 --motor-limits --contacts 2

Robots walk over the wave as in ``headings.py``: from the start of the level search to the target, steered as robogauge-1.1
steers, with its noise and latency. Prints how many arrive, the share of the walk in which they stand still, and how often a
foot is sunk: its centre less than 1 mm above the surface. MuJoCo makes a height field of prisms. A sphere whose centre
touches the surface near the border of two of them gets contacts with their sides, which lie inside the ground: they press
from left and right, hold it by friction, and do not lift it. ``--motor-limits`` gives the suite's motors their limits
of torque over speed; ``--training`` puts physics, joints and motors of training in place of the gauge's.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
import torch
from field_contacts import contacts_of_mujoco, model_of
from gaitgauge.terrains.base import Terrain
from gaitgauge.terrains.registry import make_terrain
from headings import STANDING, Changes, Walk
from numpy.typing import NDArray

STILL, SPAN, SUNK = 0.15, 1.0, 0.001
"""A robot stands still where its base gets less than so far [m] in such a time [s]; height of a sunk foot's centre [m]."""
QUANTILES = (0.001, 0.01, 0.05)
"""Of the height of the lowest foot."""


@dataclass(frozen=True, kw_only=True)
class Counts:
    """What happened on the way, over all robots and control steps that count; NaN where there are none."""

    robots: int
    """Robots that set out."""
    arrived: int
    """Those that got to the target."""
    held: int
    """Those that did not, and at the end stand still with a foot sunk."""
    still: float
    """Share of the time in which they stand still."""
    still_sunk: float
    """Share of that in which a foot is sunk."""
    moving_sunk: float
    """Share of the other time in which a foot is sunk."""
    quantiles: tuple[float, ...]
    """``QUANTILES`` of the lowest foot's height [m]."""

    def line(self) -> str:
        """What is printed."""
        heights = ", ".join(f"{1e3 * height:.1f}" for height in self.quantiles)
        return (
            f"arrived {self.arrived} of {self.robots}, {self.held} held at the end; still {self.still:.3f} of the time, "
            f"{self.still_sunk:.2f} of it with a foot sunk; sunk {self.moving_sunk:.4f} of the time in motion; lowest foot "
            f"at {', '.join(f'{100 * share:g} %' for share in QUANTILES)}: {heights} mm"
        )


def foot_heights(foot_position_w: torch.Tensor, terrain: Terrain) -> NDArray[np.float64]:
    """Height of the feet's centres straight above the ground [m], (N, F); a foot that stands on flat ground has its radius.

    Args:
        foot_position_w: ``PhysicsState.foot_position_w``: centres, world frame [m], (N, F, 3).
        terrain: the ground of all worlds.
    """
    x, y, z = foot_position_w.double().cpu().numpy().transpose(2, 0, 1)
    return z - terrain.height(x, y)


def count(
    base: NDArray[np.float64], lowest: NDArray[np.float64], walking: NDArray[np.bool_], *, period: float
) -> Counts:
    """Count standing still and sunk feet.

    A control step counts if its robot was on its way for half of ``SPAN`` before and after it; the way between the two ends
    says whether the robot stood still. One that has fallen stands still too.

    Args:
        base: positions of the bases after each control step, world frame [m], (T, N, 2).
        lowest: heights of each robot's lowest foot [m], (T, N).
        walking: whether the robot had set out and not arrived before that step, (T, N).
        period: length of a control step [s].
    """
    half = round(0.5 * SPAN / period)
    counted = walking[: -2 * half] & walking[2 * half :]
    still = np.linalg.norm(base[2 * half :] - base[: -2 * half], axis=2) < STILL
    heights = lowest[half:-half]
    sunk = heights < SUNK

    def share(of: NDArray[np.bool_], among: NDArray[np.bool_]) -> float:
        return float(of[among].mean()) if among.any() else float("nan")

    return Counts(
        robots=walking.shape[1],
        arrived=int((~walking[-1]).sum()),
        held=int((still & sunk & counted)[-1].sum()),
        still=share(still, counted),
        still_sunk=share(sunk, counted & still),
        moving_sunk=share(sunk, counted & ~still),
        quantiles=tuple(float(q) for q in np.quantile(heights[counted], QUANTILES)) if counted.any() else (),
    )


def play(walk: Walk, seconds: float) -> Counts:
    """Let them walk so long [s], longer than ``SPAN``, and count."""
    base, lowest, walking = [], [], []
    with torch.no_grad():
        for number in range(round(seconds / walk.physics.control_period)):
            walk.step(number)
            if number < STANDING:
                continue
            state = walk.backend.state
            base.append(state.base_position_w[:, :2].double().numpy().copy())
            lowest.append(foot_heights(state.foot_position_w, walk.terrain).min(axis=1))
            walking.append(walk.walking.numpy().copy())
    return count(np.array(base), np.array(lowest), np.array(walking), period=walk.physics.control_period)


def contact_lines(walk: Walk, most: int) -> list[str]:
    """The contacts that MuJoCo finds for a sphere of the Go2's foot (radius 22 mm) put where sunk feet are now.

    Args:
        walk: after its last step.
        most: number of feet.

    Returns:
        A line for each foot, and below it one for each contact: depth, and the normal out of the ground, world frame.
    """
    feet = walk.backend.state.foot_position_w
    heights = foot_heights(feet, walk.terrain)
    sunk = np.argwhere((heights < SUNK) & walk.walking.numpy()[:, None])[:most]
    qpos = np.zeros((len(sunk), 7))
    qpos[:, 3] = 1.0
    qpos[:, :3] = feet.double().numpy()[sunk[:, 0], sunk[:, 1]]
    lines = []
    for (robot, foot), pose, contacts in zip(
        sunk, qpos, contacts_of_mujoco(model_of("foot", walk.terrain), qpos), strict=True
    ):
        place = ", ".join(f"{coordinate:.4f}" for coordinate in pose[:3])
        lines.append(
            f"robot {robot}, foot {foot} at ({place}), centre {1e3 * heights[robot, foot]:.1f} mm above the field"
        )
        for distance, normal, _ in contacts:
            lines.append(f"  depth {-1e3 * distance:.1f} mm, normal ({', '.join(f'{part:.2f}' for part in normal)})")
    return lines


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--level", type=int, default=7)
    parser.add_argument("--friction", type=float, default=0.7)
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=0)
    motors = parser.add_mutually_exclusive_group()
    motors.add_argument(
        "--motor-limits",
        nargs="?",
        const="speed",
        choices=("torque", "speed"),
        help="the suite's physics, with that limit of motors; 'speed' if none is named",
    )
    motors.add_argument("--training", choices=("torque", "speed"), help="training's physics, with that limit of motors")
    parser.add_argument(
        "--contacts", type=int, default=0, help="feet whose contacts are shown, of those sunk at the end"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    changes = Changes(
        training=arguments.training is not None,
        speed_limit=arguments.training == "speed",
        motor_limits=arguments.motor_limits,
    )
    for policy in arguments.policies:
        walk = Walk(
            policy,
            make_terrain("wave", arguments.level),
            robots=arguments.robots,
            friction=arguments.friction,
            seed=arguments.seed,
            changes=changes,
        )
        print(f"{policy}: {play(walk, arguments.seconds).line()}", flush=True)
        for line in contact_lines(walk, arguments.contacts):
            print(line)


if __name__ == "__main__":
    main()
