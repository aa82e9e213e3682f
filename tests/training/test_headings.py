"""``benchmarks/headings.py``: robots on their way to the target are disturbed as the suite says."""

from dataclasses import replace

import headings
import pytest
import torch
from gaitgauge.gauge.suite import load_suite
from gaitgauge.terrains import gauge_terrains


def disturbances(monkeypatch, *, training: bool, steps: int = 30) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Noise (steps, N, …) and delays (steps, N) [substeps] of a walk that is not played."""
    walk = headings.Walk(
        "pretrained",
        gauge_terrains.stairs(1),
        robots=8,
        friction=0.7,
        seed=0,
        changes=headings.Changes(training=training),
    )
    noises, delays, build = [], [], walk.builder.build

    def built(state, command, action, noise):
        noises.append(noise)
        return build(state, command, action, noise)

    monkeypatch.setattr(walk.builder, "build", built)
    monkeypatch.setattr(walk.backend, "step", lambda target, delay: delays.append(delay))
    for _ in range(steps):
        walk.step(0)
    return {name: torch.stack([n[name] for n in noises]) for name in noises[0]}, torch.stack(delays)


@pytest.mark.parametrize(("training", "latest"), [(False, 9), (True, 4)])
def test_noise_and_latency_are_those_of_the_suite(monkeypatch, training, latest):
    """18 ms are 9 substeps of the gauge and nearly 4 of training."""
    noise, delay = disturbances(monkeypatch, training=training)
    for name, half_width in (("base_angular_velocity_b", 0.8), ("joint_position", 0.01), ("joint_velocity", 3.0)):
        assert 0.9 * half_width < noise[name].abs().max() <= half_width
    assert (delay.min(), delay.max()) == (0, latest)


def test_another_suite_would_disturb_them_otherwise(monkeypatch):
    """The amplitudes stood in the script once more."""
    suite = load_suite("robogauge-1.1")
    calm = replace(suite.noise, base_angular_velocity=0.0, joint_position=0.0, joint_velocity=1.0, latency=2)
    monkeypatch.setattr(headings, "load_suite", lambda name: replace(suite, noise=calm))
    noise, delay = disturbances(monkeypatch, training=False)
    assert noise["base_angular_velocity_b"].abs().max() == noise["joint_position"].abs().max() == 0.0
    assert 0.9 < noise["joint_velocity"].abs().max() <= 1.0
    assert delay.max() == 2
