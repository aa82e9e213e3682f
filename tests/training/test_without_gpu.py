"""A task that needs a GPU says at once that there is none, and what this machine can do instead."""

from __future__ import annotations

import ctypes

import pytest
from gaitgauge.backends.base import DeviceError
from gaitgauge.backends.gpu import gpu_count
from gaitgauge.training.run import without_gpu
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.tasks import TaskError


@pytest.fixture
def bare(monkeypatch):
    """Two cores and no GPU."""
    monkeypatch.setattr(without_gpu, "gpu_count", lambda: 0)
    monkeypatch.setattr(without_gpu, "cpu_threads", lambda asked: 2)


def refusal(**choices) -> str:
    with pytest.raises(DeviceError) as caught:
        without_gpu.check_gpu(TrainRequest(**choices))
    return str(caught.value)


@pytest.mark.usefixtures("bare")
def test_each_part_of_the_refusal():
    said = refusal(task="go2-flat")
    assert said.startswith(
        "task 'go2-flat' trains on mujoco-warp, which wants an NVIDIA GPU, and this machine has none; "
    )
    assert "'gaitgauge train toy' learns to walk here in about" in said
    assert "the repository's docs/start/first_training.ipynb trains go2-flat on a hosted GPU" in said
    assert said.endswith("--backend mujoco trains this task here in about 14 h")  # 380 x 24 x 8192 / 1450 s


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("choices", "task"),
    [
        ({"task": "walk-dreamwaq", "robot": "g1"}, "g1-walk-dreamwaq"),
        ({"task": "rough", "robot": "g1"}, "g1-rough"),
        ({"task": "rough", "overrides": ("environment.robot=g1",)}, "g1-rough"),
    ],
)
def test_a_ground_has_the_task_of_the_robot_asked_for(choices, task):
    assert refusal(**choices).startswith(f"task '{task}' trains on")
    assert prepare(TrainRequest(**choices, backend="fake", device="cpu")).task.name == task


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("choices", "time"),
    [
        ({"task": "go2-moe-cts"}, "about 16 days"),  # 5000 x 24 x 16384 / 1450 s
        ({"task": "go2-flat", "num_envs": 256, "iterations": 170}, "about 12 min"),
    ],
)
def test_the_time_is_that_of_the_sizes_asked_for(choices, time):
    assert refusal(**choices).endswith(time)


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    "choices",
    [
        {"task": "toy"},
        {"task": "go2-flat", "backend": "mujoco"},
        {"task": "go2-flat", "device": "cpu"},
        {"task": "go2-flat", "resume": "latest"},
    ],
)
def test_what_needs_no_gpu_goes_on(choices):
    without_gpu.check_gpu(TrainRequest(**choices))


@pytest.mark.usefixtures("bare")
def test_engine_and_task_are_named():
    assert refusal(task="toy", backend="newton:steel").startswith("task 'toy' trains on newton:steel, which wants")
    with pytest.raises(TaskError, match="unknown task 'go2-fla'; did you mean go2-flat"):
        without_gpu.check_gpu(TrainRequest(task="go2-fla"))


def test_a_machine_with_a_gpu_trains(monkeypatch):
    monkeypatch.setattr(without_gpu, "gpu_count", lambda: 1)
    without_gpu.check_gpu(TrainRequest(task="go2-flat"))


@pytest.mark.parametrize(("error", "found"), [(0, 3), (100, 0)])
def test_gpus_are_counted_by_the_driver(monkeypatch, error, found):
    class Driver:
        def cuInit(self, flags):  # noqa: N802 (the driver's name)
            return error

        def cuDeviceGetCount(self, count):  # noqa: N802
            count._obj.value = 3
            return 0

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Driver())
    assert gpu_count() == found


def test_without_a_driver_there_is_no_gpu(monkeypatch):
    def missing(name):
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    assert gpu_count() == 0
