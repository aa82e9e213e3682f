"""Which device an engine computes on: one rule for gauge, training and the command line."""

import pytest
import torch
from gaitgauge.backends import BackendError
from gaitgauge.backends.devices import find_device
from gaitgauge.backends.registry import choose_device, find_backend


@pytest.fixture
def gpus(monkeypatch):
    def set_number(count):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)

    return set_number


@pytest.mark.parametrize("name", ["tpu9", "mps", "cuda:99", "cuda"])
def test_a_device_that_is_not_there_is_refused_by_name(name, gpus):
    gpus(0)
    with pytest.raises(BackendError, match=f"device '{name}'"):
        find_device(name, "mujoco-warp")


def test_a_gpu_without_a_number_is_the_present_one(gpus):
    gpus(2)
    assert find_device("cuda", "newton") == torch.device("cuda", 1)
    assert find_device("cuda:0", "newton") == torch.device("cuda", 0)
    assert find_device("cpu:0", "newton") == torch.device("cpu")
    with pytest.raises(BackendError, match="torch finds 2"):
        find_device("cuda:2", "newton")


@pytest.mark.parametrize("kind", [AssertionError, RuntimeError])
def test_a_gpu_that_torch_cannot_use_is_one_sentence(kind, gpus, monkeypatch):
    gpus(1)

    def unusable():
        raise kind("Torch not compiled with CUDA enabled")

    monkeypatch.setattr(torch.cuda, "current_device", unusable)
    with pytest.raises(BackendError, match=r"'cuda' cannot be used: Torch not compiled .*; use --device cpu"):
        find_device("cuda", "newton")


def test_an_engine_of_the_cpu_takes_no_gpu(gpus):
    gpus(1)
    with pytest.raises(BackendError, match="'mujoco' runs on the CPU, not on 'cuda'"):
        find_backend("mujoco", "cuda")
    assert choose_device("mujoco") == "cpu"


def test_engines_that_are_made_for_a_gpu_want_one_unless_told(gpus):
    gpus(1)
    assert choose_device("mujoco-warp") == "cuda"
    gpus(0)
    with pytest.raises(BackendError, match="'mujoco-warp' wants a GPU and this machine has none; add --device cpu"):
        choose_device("mujoco-warp")
    assert choose_device("mujoco-warp", "cpu") == "cpu"
    assert choose_device("fake") == "cpu"


def test_a_device_without_a_name_is_refused():
    """It was taken for none at all, and failed later."""
    with pytest.raises(BackendError, match="there is no device ''; give cpu, cuda or cuda:N"):
        choose_device("mujoco", "")
