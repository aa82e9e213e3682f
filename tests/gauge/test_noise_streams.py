"""Random numbers of episodes: the published stream number by number, and the statistics of the project's own."""

import random

import numpy as np
import pytest
import torch
from gaitgauge.gauge.play import noise
from gaitgauge.gauge.play.noise import CounterStream, ReferenceStream, make_stream, uniform_hash
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.observation_table import OBSERVATIONS
from scripted_gauge import MAXIMUM, episode

REFERENCE, OWN = load_suite("robogauge-1.1").noise, load_suite("gaitgauge-1").noise
CPU = torch.device("cpu")
TERMS = {"joint_position": 0.01, "joint_velocity": 3.0, "base_angular_velocity_b": 0.8}


def python_draws(seed, steps):
    """What the published code draws: 36 uniform numbers in this order, then the delay."""
    generator = random.Random(seed)
    for _ in range(steps):
        widths = [0.01] * 12 + [3.0] * 12 + [0.05] * 3 + [0.8] * 3 + [0.05] * 3 + [0.8] * 3
        numbers = [generator.uniform(-w, w) for w in widths]
        yield numbers, generator.randint(0, 9)


def stream(kind, seeds=(0,)):
    made = make_stream(kind, 12, len(seeds), CPU)
    for world, seed in enumerate(seeds):
        made.assign(world, episode(MAXIMUM, seed=seed))
    return made


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_the_reference_stream_is_pythons_in_the_published_order(seed):
    made = stream(REFERENCE, (seed,))
    for step, (numbers, delay) in enumerate(python_draws(seed, 400)):
        terms, delays = made.draw(torch.tensor([step]))
        assert int(delays[0]) == delay
        for name, part in (
            ("joint_position", numbers[:12]),
            ("joint_velocity", numbers[12:24]),
            ("base_angular_velocity_b", numbers[-3:]),  # the gyroscope is the last of the four
        ):
            assert torch.equal(terms[name][0], torch.tensor(part, dtype=torch.float32)), (step, name)


def test_the_reference_stream_goes_on_after_its_table(monkeypatch):
    monkeypatch.setattr(noise, "TABLE_STEPS", 7)
    made = stream(REFERENCE, (3,))
    made.assign(0, episode(MAXIMUM, seed=3), 60)
    found = [made.draw(torch.tensor([step])) for step in range(60)]
    for (numbers, delay), (terms, delays) in zip(python_draws(3, 60), found, strict=True):
        assert int(delays[0]) == delay
        assert torch.equal(terms["joint_velocity"][0], torch.tensor(numbers[12:24], dtype=torch.float32))


def test_the_reference_stream_depends_on_the_seed_and_the_step_alone():
    one = stream(REFERENCE, (5,))
    many = stream(REFERENCE, (2, 5, 0, 5))
    many.draw(torch.tensor([9, 9, 9, 9]))
    alone, delay = one.draw(torch.tensor([4]))
    together, delays = many.draw(torch.tensor([0, 4, 4, 1]))
    for name in TERMS:
        assert torch.equal(together[name][1], alone[name][0])
        assert not torch.equal(together[name][3], alone[name][0])
    assert int(delays[1]) == int(delay[0])
    # a seed that comes later changes nothing for those at work
    many.assign(2, episode(MAXIMUM, seed=77), 9000)
    again, _ = many.draw(torch.tensor([0, 4, 4, 1]))
    for name in TERMS:
        assert torch.equal(again[name][[0, 1, 3]], together[name][[0, 1, 3]])
        assert not torch.equal(again[name][2], together[name][2])


def test_the_suites_choose_their_streams():
    assert isinstance(stream(REFERENCE), ReferenceStream)
    assert isinstance(stream(OWN), CounterStream)


# ---- the project's own stream -------------------------------------------------------------------------------------------


def draws(made, steps):
    terms, delays = zip(*(made.draw(torch.full((len(made._key),), step)) for step in range(steps)), strict=True)
    return {name: torch.stack([t[name] for t in terms]) for name in TERMS}, torch.stack(delays)


def test_the_own_stream_is_uniform_within_its_widths():
    terms, delays = draws(stream(OWN, (0, 1)), 2000)
    for name, half in TERMS.items():
        unit = terms[name].double() / half
        assert unit.abs().max() <= 1.0
        count = unit.numel()
        assert unit.mean().item() == pytest.approx(0.0, abs=5 / np.sqrt(3 * count))
        assert (unit**2).mean().item() == pytest.approx(1 / 3, abs=5 * 0.3 / np.sqrt(count))
    counts = torch.bincount(delays.flatten(), minlength=10)
    assert len(counts) == 10
    assert ((counts - 400.0) ** 2 / 400.0).sum() < 27.9  # chi square with 9 degrees of freedom, one in a thousand


def test_gravity_and_what_no_robot_measures_are_noisy_too_in_the_own_suite():
    """Both were read exactly; so they still are in the reference, whose policies are told no velocity."""
    made = stream(OWN, (0, 1))
    terms = [made.draw(torch.tensor([step, step]))[0] for step in range(2000)]
    for name, half in {"projected_gravity_b": 0.05, "base_linear_velocity_b": 0.1}.items():
        unit = torch.stack([t[name] for t in terms]).double() / half
        assert unit.shape == (2000, 2, 3) and 0.99 < unit.abs().max() <= 1.0
        assert (unit**2).mean().item() == pytest.approx(1 / 3, abs=0.02)
    assert terms[0].keys() == {o.name for o in OBSERVATIONS.values() if o.noise is not None and not o.exteroceptive}
    assert "projected_gravity_b" not in stream(REFERENCE).draw(torch.tensor([0]))[0]


def test_delays_reach_from_zero_to_the_latency():
    _, delays = draws(stream(OWN, (4,)), 300)
    assert (int(delays.min()), int(delays.max())) == (0, 9)
    assert delays.dtype == torch.int64


def test_the_own_stream_has_no_correlation_between_steps_entries_and_episodes():
    terms, delays = draws(stream(OWN, (0, 1)), 4000)
    values = terms["joint_velocity"].double() / 3.0
    bound = 4.5 / np.sqrt(4000)

    def correlation(a, b):
        return np.corrcoef(a.numpy(), b.numpy())[0, 1]

    assert abs(correlation(values[:, 0, 0], values[:, 1, 0])) < bound  # episodes of neighbouring seeds
    assert abs(correlation(values[:, 0, 0], values[:, 0, 1])) < bound  # neighbouring entries
    assert abs(correlation(values[1:, 0, 0], values[:-1, 0, 0])) < bound  # neighbouring steps
    assert abs(correlation(values[1:, 0, 0], values[:-1, 0, 1])) < bound  # diagonal neighbours
    assert abs(correlation(values[:, 0, 0], delays[:, 0].double())) < bound


@pytest.mark.parametrize(
    "changes", [{"seed": 1}, {"friction": 0.7}, {"terrain": "wave"}, {"level": 3}, {"stage": "search"}]
)
def test_every_episode_has_numbers_of_its_own(changes):
    made = make_stream(OWN, 12, 2, CPU)
    made.assign(0, episode(MAXIMUM))
    made.assign(1, episode(MAXIMUM, **changes))
    terms, _ = made.draw(torch.tensor([3, 3]))
    assert not torch.equal(terms["joint_velocity"][0], terms["joint_velocity"][1])


def test_the_own_stream_is_the_same_in_any_world_and_at_any_time():
    many, one = stream(OWN, (2, 0, 1)), stream(OWN, (1,))
    many.draw(torch.tensor([50, 3, 0]))
    for step in (7, 0, 7):
        terms, delays = many.draw(torch.tensor([1, 2, step]))
        alone, delay = one.draw(torch.tensor([step]))
        assert int(delays[2]) == int(delay[0])
        for name in TERMS:
            assert torch.equal(terms[name][2], alone[name][0])


def test_the_hash_is_the_published_splitmix_finalizer():
    """Against whole numbers of Python, which do not overflow."""

    def expected(key, step, index):
        mask = (1 << 64) - 1
        state = (key + step * 0x5851F42D4C957F2D + index * 0x9E3779B97F4A7C15) & mask
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & mask
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & mask
        return ((state ^ (state >> 31)) >> 40) / (1 << 24)

    for key, step, index in [(0, 0, 0), (1, 2, 3), ((1 << 62) + 12345, 6000, 27), (987654321987, 1, 0)]:
        found = uniform_hash(torch.tensor([key]), torch.tensor([step]), torch.tensor([index]))
        assert found.item() == expected(key, step, index)
