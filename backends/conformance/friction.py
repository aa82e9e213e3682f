"""Checks of friction: the randomized coefficient acts, in every world its own."""

from __future__ import annotations

import numpy as np

from .bench import Bench, expect, expect_close
from .check import check
from .contact import lay_on_back, stand_still
from .ground import incline
from .reference import GRAVITY, Reference, axis_angle

HEADING_X = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))


@check("friction/incline", "friction", "boxes", "per_world_terrain")
def slides_or_stays(bench: Bench) -> str:
    """A stiff robot on an incline slides where tan(angle) exceeds the friction, below and above the model's own."""
    gentle, steep = 0.30, 0.45
    angle, friction = np.array([gentle, gentle, steep, steep]), np.array([0.2, 0.4, 0.4, 0.65])
    terrains = (incline(gentle, name="gentle"), incline(steep, name="steep"))
    with bench.worlds(bench.stiff(), terrains=terrains, terrain_index=(0, 0, 1, 1)) as worlds:
        worlds.randomize(friction=friction)
        turns = np.array([axis_angle((0.0, 1.0, 0.0), float(a)) for a in angle])
        before = stand_still(bench, worlds, seconds=0.2, turn=turns, ground=0.8)
        worlds.run(0.2)
        after = worlds.read()
        downhill = np.c_[np.cos(angle), np.zeros(4), -np.sin(angle)]
        gained = ((after.base_linear_velocity_w - before.base_linear_velocity_w) * downhill).sum(1) / 0.2
        moved = ((after.base_position_w - before.base_position_w) * downhill).sum(1)
        expected = GRAVITY * (np.sin(angle) - friction * np.cos(angle))
        bound = bench.bound("friction", exact=0.1, approximate=0.3)
        for row in range(4):
            said = f"friction {friction[row]} on an incline of tan {np.tan(angle[row]):.3f}"
            if expected[row] > 0:
                expect_close(f"acceleration down, {said} [m/s²]", gained[row], expected[row], bound * GRAVITY * 0.5)
                expect(moved[row] > 0.01, f"{said}: the robot must slide, but moved {1e3 * moved[row]:.1f} mm")
            else:
                expect(abs(moved[row]) < 0.01, f"{said}: the robot must stay, but slid {1e3 * moved[row]:.1f} mm")
    return f"slides with {gained[0]:.2f} and {gained[2]:.2f} m/s², must {expected[0]:.2f} and {expected[2]:.2f}"


@check("friction/braking", "friction", "plane", "contact_forces")
def braking(bench: Bench) -> str:
    """A robot that slides on its feet is braked with friction × normal force, friction differing between worlds."""
    friction = np.array([0.1, 0.25, 0.4, 0.8])
    level = slice(0, 3)  # at 0.8 the robot pitches onto its front feet, which slip sideways too
    with bench.worlds(bench.stiff()) as worlds:
        worlds.randomize(friction=friction)
        start = stand_still(bench, worlds, seconds=0.02, turn=HEADING_X, base_linear_velocity=(3.0, 0.0, 0.0))
        impulse = np.zeros((worlds.count, 3))
        tangential, normal = np.zeros(worlds.count), np.zeros(worlds.count)
        steps = 40
        for _ in range(steps):
            worlds.step(substeps=1)
            state = worlds.read()
            impulse += state.ground_force_w
            tangential += state.foot_tangential_force.sum(1)
            normal += state.foot_normal_force.sum(1)
        bound = bench.bound("friction", exact=0.05, approximate=0.15)
        ratio = -impulse[:, 0] / impulse[:, 2]
        expect_close("braking force over ground pressure", ratio[level], friction[level], bound * friction[level])
        expect_close("foot_tangential_force over foot_normal_force", tangential / normal, friction, bound * friction)
        seconds = steps * worlds.backend.scene.physics.timestep
        braked = (start.base_linear_velocity_w[:, 0] - state.base_linear_velocity_w[:, 0]) / seconds
        lost = impulse[:, 0] / steps / Reference(bench.robot, bench.stiff()).mass
        expect_close("deceleration of the base [m/s²]", braked, -lost, 0.15 * np.abs(lost) + 0.3)
    return f"force ratio at the feet {_list(tangential / normal)} for {_list(friction)}"


@check("friction/bodies", "friction", "plane", "contact_forces")
def body_friction(bench: Bench) -> str:
    """The friction acts in contacts of the other bodies too: a robot on its back is braked with it."""
    friction = np.array([0.15, 0.3, 0.5, 0.7])
    with bench.worlds(bench.stiff()) as worlds:
        worlds.randomize(friction=friction)
        lay_on_back(bench, worlds, base_linear_velocity=(3.0, 0.0, 0.0), held_target=worlds.default_pose)
        worlds.step(substeps=20)
        impulse = np.zeros((worlds.count, 3))
        for _ in range(40):
            worlds.step(substeps=1)
            impulse += worlds.read().ground_force_w
        ratio = np.linalg.norm(impulse[:, :2], axis=1) / impulse[:, 2]
        bound = bench.bound("friction", exact=0.05, approximate=0.15)
        expect_close("braking force over ground pressure on the back", ratio, friction, bound * friction)
    return f"force ratio {_list(ratio)} for {_list(friction)}"


def _list(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3f}" for value in values)
