import json
import subprocess
import sys
from pathlib import Path

import warp_throughput
from gaitgauge.backends.base import TRAINING_PHYSICS

ROOT = Path(__file__).resolve().parents[2]


def test_a_single_configuration_is_measured_without_a_gpu():
    """It ended with a NameError: what it resets worlds with was only named for types."""
    script = ROOT / "benchmarks" / "warp_throughput.py"
    options = ["--single", "plane", "1", "--device", "cpu", "--backend", "mujoco", "--steps", "1"]
    done = subprocess.run([sys.executable, script, *options], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout.splitlines()[-1])
    assert row["control_steps_per_second"] > 0.0 and row["diverged_share"] == 0.0


def test_the_physics_is_that_of_training():
    assert warp_throughput.training_scene("plane", 1).physics == TRAINING_PHYSICS
