"""Whether parts of a robot touch each other, from its joint angles."""

from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.gauge.play.self_contact import SelfContact
from gaitgauge.gauge.results import health, self_contact
from gaitgauge.robots import load_robot

from .test_edited_episodes import record

HIPS = {"go2": ("RL_hip_joint", "RR_hip_joint"), "anymal_c": ("LH_HAA", "RH_HAA")}


def pose(robot, inwards):
    """The default pose with the hips of both hind legs turned inwards [rad]."""
    found = np.asarray(robot.default_joint_position, dtype=np.float64).copy()
    left, right = (robot.joint_names.index(name) for name in HIPS[robot.name])
    found[left] -= inwards
    found[right] += inwards
    return found


@pytest.mark.parametrize(("name", "inwards"), [("go2", 0.7), ("anymal_c", 0.7)])
def test_legs_turned_into_each_other_touch(name, inwards):
    robot = load_robot(name)
    watch = SelfContact(robot)
    poses = np.stack([pose(robot, 0.0), pose(robot, inwards), pose(robot, -0.2)])
    assert watch.touching(poses).tolist() == [False, True, False]
    assert watch.pairs(poses[0]) == set()
    assert watch.pairs(poses[1])


@pytest.mark.parametrize(
    ("changed", "pairs"),
    [
        ({}, set()),
        # hips 0.0465 m from the middle and 0.0955 m wide, legs 0.311 m long: at 0.4 rad inwards the front feet, of radius
        # 0.022 m, are 0.0465 + 0.0955 cos 0.4 - 0.311 sin 0.4 = 0.013 m from the middle, the calves' lower ends 0.03 m
        ({"FL_hip_joint": -0.4, "FR_hip_joint": 0.4}, {"FL–FR"}),
        ({"FL_hip_joint": -0.2, "FR_hip_joint": 0.2}, set()),
    ],
)
def test_feet_that_meet_are_named(changed, pairs):
    robot = load_robot("go2")
    angles = zip(robot.joint_names, robot.default_joint_position, strict=True)
    assert SelfContact(robot).pairs(np.array([changed.get(name, angle) for name, angle in angles])) == pairs


def test_what_overlaps_in_the_default_pose_does_not_count():
    robot = load_robot("go2")
    crossed = replace(robot, default_joint_position=tuple(pose(robot, 0.52)))
    assert not SelfContact(crossed).touching(pose(robot, 0.52)[None]).any()


def test_a_pose_that_is_no_number_touches_nothing():
    robot = load_robot("go2")
    assert SelfContact(robot).touching(np.full((2, robot.num_joints), np.nan)).tolist() == [False, False]


def test_shares_are_of_all_samples():
    touching = [record(touching=np.array(values)) for values in ([True, False, False], [True, True, False])]
    assert self_contact(touching) == 0.5
    assert health(touching).self_contact == 0.5


def test_files_that_do_not_say_make_the_share_unknown():
    assert self_contact([record(touching=np.zeros(3, np.bool_)), record()]) is None
    assert self_contact([]) is None
