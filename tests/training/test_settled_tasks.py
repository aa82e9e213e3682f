"""Settings of tasks that runs and cards refer to, and the names that lead to them."""

import hashlib
import json

import pytest
from gaitgauge.training.configuration import to_plain
from gaitgauge.training.environment.reward_configuration import FOOT_TERMS, PoseWeights
from gaitgauge.training.tasks import TaskError, find_task

ADDED: dict[str, object] = {
    "environment.observations.noise.height_scan": 0.05,
    "environment.observations.scan_delay": 0.06,
    "environment.joints.driven": [],
    "environment.gait.period": None,
    "environment.gait.offsets": [0.25, 0.75],
    "environment.gait.swing_share": 0.4,
    "environment.gait.swing_height": 0.09,
    "environment.termination.low": None,
    **dict.fromkeys((f"environment.rewards.{name}" for name in ("alive", "orientation", "pose", *FOOT_TERMS)), 0.0),
    **{f"environment.rewards.pose_weights.{name}": weight for name, weight in to_plain(PoseWeights()).items()},
    "environment.rewards.least_apart": 0.15,
    "environment.rewards.longest_step": 0.4,
    "environment.rewards.clock_sigma": 0.008,
    "environment.rewards.foot_contact_force": 5.0,
}
"""Settings that came later, with the values at which nothing changes."""
SETTLED = {
    ("go2-moe-cts", None): "d5382feb9a943360",
    ("go2-cts", None): "bb04a25d8a0c3ee9",
    ("go2-moe-ng", None): "84c2305e772926fd",
    ("go2-ac-moe", None): "6ece78d8f99511e2",
    ("go2-mcp", None): "844d9bc374c490c1",
    ("go2-him", None): "525133ee0f45de02",
    ("go2-dreamwaq", None): "abd92fbd893cf9a5",
    ("go2-flat", None): "d356907218e9c01b",
    ("go2-sprint", None): "bc6388bf5839b6d8",
    ("go2-moe-cts", "go1"): "e891785664c2039f",
    ("go2-flat", "anymal_c"): "af1f21184076f353",
}
"""Digests of 27 November 2026."""


def flat(value, path=""):
    if isinstance(value, dict):
        return {key: each for name, part in value.items() for key, each in flat(part, f"{path}.{name}").items()}
    return {path[1:]: value}


def digest(task):
    settings = flat({"environment": to_plain(task.environment), "training": to_plain(task.training)})
    later = {key: settings.pop(key) for key in ADDED if key in settings}
    assert later == ADDED
    return hashlib.sha256(json.dumps([task.name, task.title, settings], sort_keys=True).encode()).hexdigest()[:16]


@pytest.mark.parametrize(("name", "robot"), SETTLED)
def test_settled_tasks_keep_their_settings(name, robot):
    assert digest(find_task(name, robot=robot)) == SETTLED[name, robot], "a new setting belongs into ADDED"


@pytest.mark.parametrize(
    ("ground", "robot", "task"),
    [
        ("rough", None, "go2-moe-cts"),
        ("rough-dreamwaq", "go1", "go2-dreamwaq"),
        ("flat", "anymal_c", "go2-flat"),
        ("walk", "go2", "go2-flat"),
        ("rough", "g1", "g1-rough"),
        ("flat", "g1", "g1-walk"),
        ("rough-dreamwaq", "g1", "g1-rough-dreamwaq"),
    ],
)
def test_a_ground_and_a_robot_are_a_task(ground, robot, task):
    assert find_task(ground, robot=robot) == find_task(task, robot=robot)
    if robot is not None:
        assert find_task(ground, [f"environment.robot={robot}"]) == find_task(task, robot=robot)


@pytest.mark.parametrize(
    ("name", "robot", "words"),
    [
        ("go2-moe-cts", "g1", "is for a quadruped, and robot 'g1' is a biped; name the ground instead: rough, "),
        ("g1-walk", "go2", "is for a biped, and robot 'go2' is a quadruped"),
        ("sprint", "g1", "task 'sprint' is not made for robot 'g1', a biped; tasks for it are: rough, "),
        ("walk-dreamwaq", None, "'walk-dreamwaq' is not made for robot 'go2', a quadruped"),
    ],
)
def test_no_robot_learns_with_another_body_plans_rewards(name, robot, words):
    with pytest.raises(TaskError, match=words):
        find_task(name, robot=robot)
