"""Feet of several collision shapes."""

from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.backends.conformance.soles import HEIGHT, two_soles
from gaitgauge.robots import RobotError, check_robot
from gaitgauge.robots.anatomy.body_plan import body_plan
from gaitgauge.robots.loading import _check, robot_digest

SPHERES, BOX = two_soles().foot_shapes


def test_a_sole_s_position_is_the_mean_of_its_shapes():
    plan = body_plan(two_soles())
    # the ankle is 0.25 (cos 0.3 + cos 0.3) below the hips and right under them; the shapes' centres are 4 and 5 cm lower
    below = 0.06 - HEIGHT
    np.testing.assert_allclose(
        plan.foot_position, [[0.03, 0.11, below - 0.04], [0.03, -0.11, below - 0.05]], atol=1e-12
    )
    assert plan.standing_height == pytest.approx(HEIGHT)
    assert plan.mass == pytest.approx(12.6)


def test_names_of_shapes_are_flat_in_the_digest_s_eyes():
    robot = replace(two_soles(), foot_shapes=("left_toe_inside", "right_sole"))
    assert robot.soles == (("left_toe_inside",), ("right_sole",)) and robot.foot_geoms == robot.foot_shapes
    assert robot_digest(robot) != robot_digest(two_soles())
    assert two_soles().foot_geoms == (*SPHERES, BOX)


@pytest.mark.parametrize(
    ("shapes", "check", "sentence"),
    [
        ((SPHERES, SPHERES), _check, "robot.toml: foot_shapes names 'left_heel_inside' twice"),
        ((SPHERES,), _check, "foot_shapes has 1 entries but foot_names has 2; give one name, or one list of names,"),
        (((*SPHERES, "left_thigh_shape"), BOX), check_robot, "'left' lie on the bodies left_foot and left_thigh; name"),
        ((SPHERES, "right_heel"), check_robot, "right_heel"),
    ],
)
def test_wrong_soles_are_refused(shapes, check, sentence):
    robot = replace(two_soles(), foot_shapes=shapes)
    with pytest.raises(RobotError, match=sentence):
        check(robot, "robot.toml") if check is _check else check(robot)
