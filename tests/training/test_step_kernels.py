"""How many torch kernels a control step takes beside the physics: on a GPU each costs microseconds, whatever its size."""

import importlib.util
import sys
from pathlib import Path

from small_environment import STAIRS, make

FILE = Path(__file__).parents[2] / "benchmarks" / "environment_throughput.py"


def test_a_step_takes_few_kernels():
    specification = importlib.util.spec_from_file_location("environment_throughput", FILE)
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    found = module.count_kernels(make(8, terrain=STAIRS))
    assert 0 < found["judging and resetting (torch)"] <= 340
    assert 0 < found["observing (torch)"] <= 65
