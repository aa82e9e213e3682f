"""Check of collisions between parts of the robot."""

from __future__ import annotations

import numpy as np

from ...robots.anatomy.body_plan import body_plan, joint_ranges
from .bench import Bench, Worlds, expect
from .check import check
from .reference import Reference


@check("contact/legs", "self_collision")
def legs(bench: Bench) -> str:
    """Legs meet each other unless self_collision is False: feet meet feet, shanks meet shanks, and a foot meets a shank."""
    reference, pose = Reference(bench.robot, bench.soft()), np.asarray(bench.robot.default_joint_position)
    pairs = opposite_feet(bench)
    crossed = [crossed_legs(reference, pair) for pair in pairs]
    # two worlds are driven from the default to a crossed pose; two start where shanks, or a foot and a shank, overlap
    goal = np.array([*crossed, crossed[0], foot_in_shank(reference, pairs[1], crossed[1])])
    if np.isnan(goal).any():
        return "the feet of this robot do not reach beyond each other"
    start = np.array([pose, pose, *goal[2:]])
    # gentle: weak motors and much inertia against a contact's own stiffness keep the feet apart
    inertia = bench.stiff().armature[0]
    parameters = bench.soft(armature=inertia, stiffness=200.0 * inertia, damping=20.0 * inertia)
    said = []
    for option in (True, False):
        with bench.worlds(parameters, self_collision=option) as worlds:
            positions = driven(worlds, start, goal)
        near = [nearest(reference, pair, of_world) for pair, of_world in zip(pairs, positions, strict=False)]
        shank, foot = np.abs(positions - start[:, None]).max((1, 2))[2:]
        text = (
            f"self_collision {option}: feet come as near as {near[0]:.2f} and {near[1]:.2f} radii, crossed shanks "
            f"move joints by {shank:.1e} rad, a foot in a shank by {foot:.1e} rad"
        )
        expect(np.greater(near, 1.75) if option else np.less(near, 0.5), text)
        for moved in (shank, foot):
            expect(moved > 0.01 if option else moved < 1e-4, text)
        said.append(text)
    return "; ".join(said)


def driven(worlds: Worlds, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Move the joints' targets from ``start`` to ``goal``, (N, J), in the air; joint positions after every control period, (N, K, J)."""
    worlds.reset(base_position=(0.0, 0.0, 5.0), joint_position=start, held_target=start)
    positions = []
    for share in np.minimum(np.arange(1, 41) / 35, 1.0):  # 0.8 s, a fall of 3.1 m
        worlds.step(start + share * (goal - start))
        positions.append(worlds.read().joint_position)
    return np.stack(positions, axis=1)


def nearest(reference: Reference, pair: list[int], positions: np.ndarray) -> float:
    """Return the least distance of the centres of two feet over joint positions (K, J), in foot radii."""
    distances = []
    for joints in positions:
        reference.place(joint_position=joints)
        distances.append(np.linalg.norm(np.subtract(*reference.foot_position[pair])))
    return float(min(distances)) / reference.foot_radius


def opposite_feet(bench: Bench) -> list[list[int]]:
    """Return pairs of left and right feet, by their order from back to front."""
    place = body_plan(bench.robot).foot_position
    by_x = np.argsort(place[:, 0])
    sides = by_x[place[by_x, 1] > 0.0], by_x[place[by_x, 1] < 0.0]
    return [[int(left), int(right)] for left, right in zip(*sides, strict=True)]


def crossed_legs(reference: Reference, pair: list[int]) -> np.ndarray:
    """Return the default pose with both feet of a pair one and a half radii beyond the robot's middle, from ``posed_feet``."""
    reference.place()
    goal = reference.foot_position
    goal[pair, 1] = -1.5 * reference.foot_radius * np.sign(goal[pair, 1])
    return posed_feet(reference, reference.joint_position, goal)


def foot_in_shank(reference: Reference, pair: list[int], crossed: np.ndarray) -> np.ndarray:
    """Return a crossed pose with the first foot inside the second foot's leg, a quarter of the way to its last joint."""
    reference.place(joint_position=crossed)
    goal, (first, second) = reference.foot_position, pair
    knee = reference.model.joint(reference.robot.joint_names[body_plan(reference.robot).legs[second][-1]]).id
    goal[first] = 0.75 * goal[second] + 0.25 * reference.data.xanchor[knee]
    return posed_feet(reference, crossed, goal)


def posed_feet(reference: Reference, pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return joint positions with the feet at ``goal`` [m], (F, 3), by damped Gauss-Newton steps from ``pose``; NaN out of reach."""
    lower, upper = joint_ranges(reference.robot).T
    for _ in range(30):
        reference.place(joint_position=pose)
        off = (goal - reference.foot_position).ravel()
        slope = reference.foot_jacobian[..., reference.at_velocity].reshape(len(off), -1)
        step = slope.T @ np.linalg.solve(slope @ slope.T + 1e-4 * np.eye(len(off)), off)
        pose = np.clip(pose + step, lower, upper)
    return pose if np.abs(off).max() < 1e-3 else np.full_like(pose, np.nan)
