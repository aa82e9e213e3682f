"""Settings of tasks that runs and cards refer to, and the names that lead to them."""

import json
from pathlib import Path

import pytest
from gaitgauge.training.configuration import to_plain
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.tasks import TaskError, find_task


def rounded(text):
    """Models of scaled robots weigh the same on every machine but for the last digits."""
    return json.loads(text, parse_float=lambda number: float(f"{float(number):.9g}"))


SETTLED = rounded((Path(__file__).parent / "settled_tasks.json").read_text())
"""Settings of 29 November 2026 by command: all of the first task's, and what is different in the others."""


def flat(value, path=""):
    if isinstance(value, dict) and "until" not in value:  # a ramp is one setting
        return {key: each for name, part in value.items() for key, each in flat(part, f"{path}.{name}").items()}
    return {path[1:]: value}


@pytest.mark.parametrize("command", SETTLED)
def test_settled_tasks_keep_their_settings(command):
    name, _, robot = command.partition(" --robot ")
    task = find_task(name, robot=robot or None)
    settings = {"title": task.title, "environment": to_plain(task.environment), "training": to_plain(task.training)}
    found = flat(rounded(json.dumps(settings)))
    settled = {**SETTLED["go2-moe-cts"], **SETTLED[command]}
    assert {key: found[key] for key in settled} == settled


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


def test_a_run_goes_by_the_task_that_a_ground_became():
    request = TrainRequest(
        task="walk", robot="g1", backend="mujoco", device="cpu", overrides=("environment.num_envs=8",)
    )
    assert prepare(request).request.task == "g1-walk"


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
