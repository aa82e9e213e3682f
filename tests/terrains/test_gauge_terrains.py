"""Every gauge terrain at every level against the measured tables of the published benchmark."""

import math

import numpy as np
import pytest
from gaitgauge.terrains import gauge_terrain_names, make_terrain

LEVELS = range(1, 11)
GRADIENTS = (0.147, 0.194, 0.241, 0.288, 0.335, 0.382, 0.429, 0.476, 0.523, 0.570)
ANGLES_DEGREES = (8.36, 10.98, 13.55, 16.07, 18.52, 20.91, 23.22, 25.45, 27.61, 29.68)
RISERS = (0.08, 0.11, 0.14, 0.17, 0.18, 0.19, 0.20, 0.21, 0.22, 0.23)
BARS = (0.073, 0.096, 0.119, 0.142, 0.165, 0.188, 0.211, 0.234, 0.257, 0.280)
STAIRS_SEARCH_Z = (0.35, 0.50, 0.65, 0.80, 0.85, 0.90, 0.95, 1.00, 1.05, 1.10)
STAIRS_TARGET_Z = (1.35, 1.80, 2.25, 2.70, 2.85, 3.00, 3.15, 3.30, 3.45, 3.60)
STAIRS_EVAL_Z = (1.40, 1.85, 2.33, 2.83, 3.00, 3.17, 3.34, 3.51, 3.68, 3.85)

# Go2 in its default pose: foot centre ahead of the base, and the lowest point of the foot below it [m].
FRONT_FOOT, REAR_FOOT = (0.176, 0.3235), (-0.272, 0.3139)
STAND_HEIGHT = 0.445


def ground(terrain):
    return [b for b in terrain.boxes if not b.wall]


def close(value):
    return pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize("name", [n for n in gauge_terrain_names() if n != "flat"])
@pytest.mark.parametrize("level", LEVELS)
def test_every_levelled_terrain_stands_between_four_walls(name, level):
    terrain = make_terrain(name, level)
    assert (terrain.name, terrain.level) == (name, level)
    assert terrain.family == name.removesuffix("_fd").removesuffix("_bd")
    walls = {(b.center, b.half_size) for b in terrain.boxes if b.wall}
    assert walls == {
        ((-0.25, 0.0, 5.0), (0.25, 5.5, 5.0)),
        ((10.25, 0.0, 5.0), (0.25, 5.5, 5.0)),
        ((5.0, 5.25, 5.0), (5.0, 0.25, 5.0)),
        ((5.0, -5.25, 5.0), (5.0, 0.25, 5.0)),
    }
    assert terrain.height(-0.25, 0.0) == 0.0 or name.startswith("stairs")
    assert set(terrain.spawns) == {"level_search", "level_eval"}


def test_flat_is_the_bare_plane():
    terrain = make_terrain("flat")
    assert terrain.boxes == () and terrain.height_field is None and terrain.target is None and terrain.level == 0
    assert {s.position for s in terrain.spawns.values()} == {(0.0, 0.0, 0.0)}
    assert np.all(terrain.height(np.linspace(-50, 50, 7), 3.0) == 0.0)


@pytest.mark.parametrize("level", LEVELS)
def test_slope(level):
    terrain = make_terrain("slope_fd", level)
    gradient = GRADIENTS[level - 1]
    angle = math.radians(ANGLES_DEGREES[level - 1])
    (ramp,) = ground(terrain)
    assert ramp.half_size == pytest.approx((5 / math.cos(angle), 5.0, 0.5), abs=1e-3)
    assert 2 * math.degrees(math.asin(-ramp.quaternion[2])) == pytest.approx(ANGLES_DEGREES[level - 1], abs=0.005)
    assert terrain.height(0.8, 0.0) == close(0.0)
    assert terrain.height(0.79, 4.9) == 0.0
    x = np.linspace(0.8, 10.8, 21)
    assert terrain.height(x, np.linspace(-5, 5, 21)) == close((x - 0.8) * gradient)
    assert terrain.height(10.8 + 0.1 * gradient, 0.0) == close(10 * gradient - 0.1)  # down the end face
    assert terrain.spawns["level_search"].position == (0.5, 0.0, 0.0)
    assert terrain.spawns["level_eval"].position == close((5.0, 0.0, 0.03 + 4.2 * gradient))
    assert terrain.target == close((4.8, 0.0, 0.688 + 0.188 * (level - 1)))


@pytest.mark.parametrize("level", LEVELS)
def test_stairs(level):
    terrain = make_terrain("stairs_fd", level)
    riser = RISERS[level - 1]
    steps = ground(terrain)
    assert len(steps) == 33
    for i, step in enumerate(steps):
        assert step.center == close((0.155 + 0.31 * i, 0.0, (i + 0.5) * riser))
        assert step.half_size == close((0.186, 5.0, riser / 2))
    first_riser = 0.31 * np.arange(33) - 0.031
    assert terrain.height(first_riser + 1e-6, 2.0) == close(riser * np.arange(1, 34))
    assert terrain.height(first_riser - 1e-6, 2.0) == close(riser * np.arange(0, 33))
    assert terrain.spawns["level_search"].position == close((1.15, 0.0, STAIRS_SEARCH_Z[level - 1]))
    assert terrain.spawns["level_eval"].position == close((4.85, 0.0, STAIRS_EVAL_Z[level - 1]))
    assert terrain.target == close((4.5, 0.0, STAIRS_TARGET_Z[level - 1]))


@pytest.mark.parametrize("level", LEVELS)
def test_obstacle(level):
    terrain = make_terrain("obstacle", level)
    height = BARS[level - 1]
    assert len(ground(terrain)) == 5
    for start in (1.0, 3.0, 5.0, 7.0, 9.0):
        x = np.array([start - 1e-6, start, start + 0.5, start + 1.0, start + 1.0 + 1e-6])
        assert terrain.height(x, -4.999) == close([0.0, height, height, height, 0.0])
    assert all(
        b.half_size == close((0.5, 5.0, height / 2)) and b.center[2] == close(height / 2) for b in ground(terrain)
    )
    assert terrain.spawns["level_search"].position == (0.5, 2.0, 0.0)
    assert terrain.spawns["level_eval"].position == close(
        (5.0, 0.0, (-0.007, 0.016)[level - 1] if level < 3 else 0.2 - 0.023 * (10 - level))
    )
    assert terrain.target == (6.5, -2.0, 0.3)


@pytest.mark.parametrize("level", LEVELS)
def test_wave(level):
    terrain = make_terrain("wave", level)
    field = terrain.height_field
    assert field is not None and ground(terrain) == []
    assert (field.center, field.half_size, field.heights.shape, field.base) == ((5.0, 0.0), (5.0, 5.0), (128, 128), 0.1)
    assert field.heights.min() == 0.0 and field.heights.max() == close(0.08 * level)
    # 256 equally spaced heights, the lowest 8 bits of the published image are lost.
    steps = field.heights / (0.08 * level) * 255
    assert steps == pytest.approx(np.round(steps), abs=1e-6)
    assert len(np.unique(np.round(steps))) == 256
    x, y = np.meshgrid(np.linspace(0, 10, 128), np.linspace(-5, 5, 128))
    smooth = 0.02 * level * (2 + np.sin(np.pi * x) + np.cos(3 * np.pi * y / 4))
    lost = smooth - field.heights
    assert abs(lost).max() < 1.2 * 0.08 * level / 255
    assert abs(lost).mean() < 0.08 * level / 255
    trough, crest = terrain.height(1.5, 1.25), terrain.height(6.5, -2.65)
    assert trough < 0.003 * level and crest > 0.078 * level
    assert terrain.spawns["level_search"].position == (1.5, 1.25, 0.0)
    assert terrain.spawns["level_eval"].position == close((4.55, 0.0, 0.65 - 0.075 * (10 - level)))
    assert terrain.target == close((6.5, -2.65, 0.08 * level))


@pytest.mark.parametrize("family", ["slope", "stairs"])
@pytest.mark.parametrize("level", LEVELS)
def test_backward_is_the_same_ground_with_the_robot_turned_around(family, level):
    forward, backward = make_terrain(f"{family}_fd", level), make_terrain(f"{family}_bd", level)
    assert backward.backward and not forward.backward
    assert forward.boxes == backward.boxes and forward.target == backward.target
    for stage, pose in forward.spawns.items():
        assert pose.yaw == 0.0
        assert backward.spawns[stage].position == pose.position
        assert backward.spawns[stage].yaw == close(math.pi)


@pytest.mark.parametrize(
    ("name", "foot", "gap"),
    [
        ("stairs_fd", FRONT_FOOT, 0.06),
        ("stairs_fd", REAR_FOOT, 0.53),
        ("slope_fd", FRONT_FOOT, 0.05),
        ("slope_fd", REAR_FOOT, 0.32),
    ],
)
def test_feet_start_as_far_above_the_ground_as_in_the_reference(name, foot, gap):
    terrain = make_terrain(name, 10)
    x, _, z = terrain.spawns["level_eval"].position
    ahead, below = foot
    assert z + STAND_HEIGHT - below - terrain.height(x + ahead, 0.142) == pytest.approx(gap, abs=0.01)


@pytest.mark.parametrize("name", gauge_terrain_names())
@pytest.mark.parametrize("level", LEVELS)
def test_no_foot_starts_in_the_ground(name, level):
    terrain = make_terrain(name, None if name == "flat" else level)
    for pose in terrain.spawns.values():
        x, y, z = pose.position
        heading = math.cos(pose.yaw)
        for ahead, below in (FRONT_FOOT, REAR_FOOT):
            assert z + STAND_HEIGHT - below > terrain.height(x + heading * ahead, y)
