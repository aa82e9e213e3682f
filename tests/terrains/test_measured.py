"""Terrains in a robot's own measure."""

import numpy as np
import pytest
from gaitgauge.terrains.measured import GO2_LEG, measured_terrain
from gaitgauge.terrains.registry import gauge_terrain_names, make_terrain
from gaitgauge.terrains.shapes import TerrainError

PLACES = [(name, level) for name in gauge_terrain_names()[1:] for level in (1, 10)]


@pytest.mark.parametrize(("name", "level"), PLACES)
def test_a_robot_with_the_go2_s_leg_has_the_published_ground(name, level):
    found, published = measured_terrain(name, level, leg=GO2_LEG, rise=1.0), make_terrain(name, level)
    assert found.boxes == published.boxes and found.target == published.target
    if published.height_field is not None:
        assert np.array_equal(found.height_field.heights, published.height_field.heights)


@pytest.mark.parametrize(("name", "level"), PLACES)
def test_starts_are_on_the_ground_and_no_ground_is_above_the_feet(name, level):
    found = measured_terrain(name, level, leg=0.7, rise=0.6)
    for pose in found.spawns.values():
        x, y, z = pose.position
        around = found.height(x + np.array([0.0, 0.12, -0.12, 0.0, 0.0]), y + np.array([0.0, 0.0, 0.0, 0.12, -0.12]))
        assert around.max() <= z + 1e-9
        assert z - around[0] < 0.06


def test_lengths_grow_with_the_leg_and_heights_are_a_share():
    # the published step of level 10 is 0.23 m high for a leg of 0.426 m, its tread 0.31 m deep
    steps = measured_terrain("stairs_fd", 10, leg=0.852, rise=0.5)
    assert np.ptp([step.center[2] for step in steps.boxes[:2]]) == pytest.approx(0.23)
    assert np.ptp([step.center[0] for step in steps.boxes[:2]]) == pytest.approx(0.62)
    (bar, *_) = measured_terrain("obstacle", 10, leg=0.852, rise=0.5).boxes
    assert 2.0 * bar.half_size[2] == pytest.approx(0.28)
    slope = measured_terrain("slope_fd", 10, leg=0.852, rise=0.5)
    assert slope.height(12.0, 0.0) - slope.height(11.0, 0.0) == pytest.approx(0.285)
    wave = measured_terrain("wave", 10, leg=0.852, rise=0.5).height_field
    assert wave.heights.max() == pytest.approx(0.8, rel=0.01) and wave.half_size == (10.0, 10.0)


def test_other_terrains_have_no_measure():
    with pytest.raises(TerrainError, match="'moon' is none of the gauge's own"):
        measured_terrain("moon", 1, leg=0.7, rise=1.0)
