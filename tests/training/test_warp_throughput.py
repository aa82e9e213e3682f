import json
import sys

import warp_throughput
from gaitgauge.backends.base import TRAINING_PHYSICS


def test_a_single_configuration_is_measured_without_a_gpu(monkeypatch, capsys):
    """It ended with a NameError: what it resets worlds with was only named for types."""
    options = ["--single", "plane", "1", "--device", "cpu", "--backend", "mujoco", "--steps", "1"]
    monkeypatch.setattr(sys, "argv", ["warp_throughput.py", *options])
    warp_throughput.main()
    row = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert row["control_steps_per_second"] > 0.0 and row["diverged_share"] == 0.0


def test_the_physics_is_that_of_training():
    assert warp_throughput.training_scene("plane", 1).physics == TRAINING_PHYSICS
