"""How many torch kernels a control step takes beside the physics: on a GPU each costs microseconds, whatever its size."""

import environment_throughput
import pytest
import torch
from gaitgauge.training.environment.configuration import PushConfiguration
from small_environment import STAIRS, idle, make


def test_a_step_takes_few_kernels():
    found = environment_throughput.count_kernels(make(8, terrain=STAIRS))
    assert 0 < found["judging and resetting (torch)"] <= 340
    assert 0 < found["observing (torch)"] <= 65


@pytest.mark.slow  # compiling takes a minute
def test_compiled_steps_agree_with_plain_ones():
    plain, fused = (make(8, terrain=STAIRS, push=PushConfiguration()) for _ in range(2))
    fused._fuse(required=True)
    assert fused.unfused == ""
    for _ in range(30):
        (one, reward, done, _), (two, fused_reward, fused_done, _) = idle(plain), idle(fused)
        assert torch.equal(done, fused_done)
        assert torch.allclose(reward, fused_reward, atol=1e-5)
        for group in ("policy", "history", "privileged"):
            assert torch.allclose(one[group], two[group], atol=1e-4), group
