"""Against a finished run of the published reference: the public CTS policy at friction 0.6, seeds 0 to 2.

The policy's weights are not part of the repository. ``GAITGAUGE_PUBLIC_CTS`` names a file of them in any format that
``gaitgauge evaluate`` takes; ``benchmarks/import_public_cts.py`` makes one of the published archive. The reference ran on MuJoCo
3.3.7; tolerances cover the engine's changes since and the chaos of contacts.
"""

import os
from pathlib import Path

import pytest
from gaitgauge.gauge.evaluate import Request, evaluate

POLICY = os.environ.get("GAITGAUGE_PUBLIC_CTS", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not POLICY, reason="GAITGAUGE_PUBLIC_CTS names no policy file"),
]

FLAT_QUALITY = (0.7918, 0.6009, 0.7003)  # mean, mean@25, mean@50
FLAT_METRICS = {  # mean@50
    "ang_vel_err": 0.5492,
    "lin_vel_err": 0.7228,
    "dof_limits": 0.9424,
    "dof_power": 0.7594,
    "orientation_stability": 0.9512,
    "torque_smoothness": 0.7210,
}
LEVELS = {"slope_fd": 6, "slope_bd": 6, "stairs_fd": 9, "stairs_bd": 7, "wave": 4, "obstacle": 7}
BENCHMARK = 0.5806


def request(**choices):
    return Request(policy=POLICY, suite="robogauge-1.1", frictions=(0.6,), threads=os.cpu_count() or 1, **choices)


def test_flat_ground_agrees_with_the_reference(tmp_path: Path):
    result = evaluate(request(pipeline="multi", terrains=("flat",), seeds=(0, 1, 2)), tmp_path / "flat")
    flat = result.environments[0]
    assert flat.quality.mean50 == pytest.approx(FLAT_QUALITY[2], abs=0.03)
    assert flat.quality.mean == pytest.approx(FLAT_QUALITY[0], abs=0.03)
    found = {name: values.mean50 for name, values in flat.metrics.items()}
    assert found == pytest.approx(FLAT_METRICS, abs=0.04)
    assert flat.diverged == 0
    assert flat.falls <= 1  # the reference's own episodes of this policy fell twice in 141: which one does is chance


def test_the_whole_friction_agrees_with_the_reference(tmp_path: Path):
    """Minutes of simulation: seven terrains, level searches and all."""
    result = evaluate(request(), tmp_path / "stress")
    assert result.score == pytest.approx(BENCHMARK, abs=0.03)
    for terrain, level in LEVELS.items():
        assert abs(result.terrains[terrain].level - level) <= 1, terrain
