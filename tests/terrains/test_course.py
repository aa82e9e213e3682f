import math

import numpy as np
import pytest
from gaitgauge.terrains.base import Terrain
from gaitgauge.terrains.course import Stretch, course_boxes
from gaitgauge.terrains.registry import TerrainError


def heights(stretches: list[Stretch], x: list[float], *, begin: float = 0.0, height: float = 0.0) -> list[float]:
    boxes = course_boxes(stretches, begin=begin, height=height, width=2.0, source="here")
    ground = Terrain(name="course", family="course", boxes=boxes)
    assert np.allclose(ground.height(x, [1.1] * len(x)), 0.0)  # beside the course lies the floor
    return [round(float(z), 6) for z in ground.height(x, [0.9] * len(x))]


def test_stairs_up_a_landing_and_stairs_down():
    stretches = [
        Stretch(length=0.9, rise=0.3, steps=3),
        Stretch(length=1.0),
        Stretch(length=0.6, rise=-0.3, steps=2),
    ]
    x = [0.9, 1.05, 1.35, 1.65, 2.0, 2.85, 3.05, 3.4]
    assert heights(stretches, x, begin=1.0) == [0.0, 0.1, 0.2, 0.3, 0.3, 0.3, 0.15, 0.0]


def test_a_platform_whose_edge_leads_to_the_floor():
    assert heights([Stretch(length=3.5)], [-1.9, 1.4, 1.6], begin=-2.0, height=0.6) == [0.6, 0.6, 0.0]


def test_a_ramp_ends_where_the_next_stretch_begins():
    rise = math.tan(math.radians(30.0))
    up_and_down = [Stretch(length=1.0, rise=rise), Stretch(length=1.0), Stretch(length=2.0, rise=-rise)]
    expected = [rise / 2, rise, rise, rise / 2, 0.0]
    assert np.allclose(heights(up_and_down, [0.5, 1.0, 1.5, 3.0, 4.1]), expected, atol=1e-6)


def test_a_course_below_the_floor_is_refused():
    with pytest.raises(TerrainError, match=r"here: stretch 2 leads to -0.2 m, below the floor"):
        heights([Stretch(length=1.0, rise=0.1), Stretch(length=1.0, rise=-0.3, steps=2)], [0.0])
