"""The benchmark that counts feet which sink into a height field: feet at known depths, robots on known ways."""

from dataclasses import replace

import numpy as np
import pytest
from field_contacts import contacts_of_mujoco, model_of
from gaitgauge.backends.base import Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.robots.registry import load_robot
from gaitgauge.terrains.base import HeightField, Terrain
from gaitgauge.terrains.registry import make_terrain
from headings import Changes
from sunken_feet import Walk, contact_lines, count, foot_heights, play

RISE = 0.3
"""Of a field that rises evenly along x."""


def ramp() -> Terrain:
    x = np.linspace(0.0, 6.0, 61)
    field = HeightField(center=(0.0, 0.0), half_size=(3.0, 3.0), heights=np.tile(RISE * x, (61, 1)))
    return Terrain(name="ramp", family="ramp", height_field=field)


def test_a_foot_at_a_known_depth():
    robot = load_robot("go2")
    parameters = robot.parameters[robot.default_parameters]
    scene = Scene(robot=robot, parameters=parameters, terrains=(ramp(),), terrain_index=(0, 0))
    backend = make_backend("mujoco", scene, device="cpu")
    start = backend.standing()
    backend.reset(start)
    feet = backend.state.foot_position_w
    clearance = feet[0, 0, 2] - RISE * (feet[0, 0, 0] + 3.0)
    lower = start.base_position.clone()
    lower[1, 2] -= clearance + 0.004
    backend.reset(replace(start, base_position=lower))
    heights = foot_heights(backend.state.foot_position_w, ramp())
    assert heights.shape == (2, 4)
    assert heights[:, 0] == pytest.approx([float(clearance), -0.004], abs=1e-9)


def test_standing_still_and_sunk_on_known_ways():
    steps, half = 300, 25  # 6 s
    time = 0.02 * np.arange(steps)
    base = np.zeros((steps, 3, 2))
    base[:, 0, 0] = time  # goes on, arrives after 4 s
    base[:, 1, 0] = np.minimum(time, 3.0)  # stops after 3 s, held by a foot
    lowest = np.full((steps, 3), 0.02)
    lowest[:, 0] = np.where(np.arange(steps) < half + 35, -0.01, 0.02)
    lowest[150:, 1] = -0.005
    walking = np.ones((steps, 3), dtype=bool)
    walking[200:, 0] = False
    counts = count(base, lowest, walking, period=0.02)
    assert (counts.robots, counts.arrived, counts.held) == (3, 1, 1)
    # Counted are 150 steps of the first and 250 of the others. The second stands still from the step whose second holds less
    # than 0.15 m of the way, which is 0.35 s after it stopped: 107 steps. The third never moves.
    assert counts.still == pytest.approx((107 + 250) / 650, abs=2 / 650)
    assert counts.still_sunk == pytest.approx(107 / 357, abs=0.005)
    assert counts.moving_sunk == pytest.approx((35 + 18) / (650 - 357), abs=0.01)
    assert counts.quantiles == pytest.approx((-0.01, -0.01, -0.01))
    assert counts.line().startswith("arrived 1 of 3, 1 held at the end; still 0.5")


def test_sides_of_prisms_hold_a_sphere_and_do_not_lift_it():
    terrain = make_terrain("wave", 7)
    x = 10.0 * 40 / 127  # a border of two rows of prisms
    pose = np.array([[x, 0.02, float(terrain.height(x, 0.02)) - 0.01, 1.0, 0.0, 0.0, 0.0]])
    (contacts,) = contacts_of_mujoco(model_of("foot", terrain), pose)
    normals = np.array([normal for _, normal, _ in contacts])
    assert (np.abs(normals[:, 2]) < 0.05).all()
    assert normals[:, 0].min() < -0.9 and normals[:, 0].max() > 0.9


@pytest.mark.parametrize(
    "motor_limits", [*(pytest.param(limits, marks=pytest.mark.slow) for limits in (None, "torque")), "speed"]
)
def test_a_walk_over_the_wave(motor_limits):
    changes = Changes(motor_limits=motor_limits)
    walk = Walk("pretrained", make_terrain("wave", 1), robots=2, friction=0.7, seed=0, changes=changes)
    assert walk.physics.torque_limits == (motor_limits is not None)
    assert walk.physics.torque_speed_limit == (motor_limits == "speed")
    counts = play(walk, 2.0)
    assert (counts.robots, counts.arrived, counts.held) == (2, 0, 0) and counts.still < 0.5
    assert contact_lines(walk, 1) == []
