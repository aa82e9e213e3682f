"""How many torch kernels a control step takes beside the physics: on a GPU each costs microseconds, whatever its size."""

import environment_throughput
from small_environment import STAIRS, make


def test_a_step_takes_few_kernels():
    found = environment_throughput.count_kernels(make(8, terrain=STAIRS))
    assert 0 < found["judging and resetting (torch)"] <= 340
    assert 0 < found["observing (torch)"] <= 65
