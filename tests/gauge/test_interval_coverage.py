"""The intervals' promise: 95 of 100 hold the truth, on evaluations that were repeated and on ones whose truth is known."""

import gzip
import json

import interval_coverage as bench
import numpy as np
import pytest


@pytest.fixture(scope="module")
def recorded():
    return [bench.restored(data) for data in json.loads(gzip.decompress(bench.DATA.read_bytes()))]


def test_intervals_of_repeated_evaluations_hold_their_mean(recorded):
    """Whole evaluations of the shipped policy that differ in seeds alone. With the levels held fixed, none held it."""
    found = bench.judge(recorded)
    assert len(recorded) >= 20
    for name in ("score", "level"):
        assert found[name][3] >= 0.9, name
    for name, (_, reach, printed, _) in found.items():
        assert 0.7 * reach < printed < 1.6 * reach, name


def test_levels_held_fixed_would_tell_runs_of_one_policy_apart(recorded):
    """What the interval was before: that of the quality seeds at the levels found."""
    assert bench.fixed_levels(recorded) < 0.6 * len(recorded)


@pytest.mark.parametrize("kind", ["flat alone", "one terrain, one friction"])
def test_synthetic_intervals_hold_the_truth(kind):
    """92 to 98 %, give or take what 120 trials can tell."""
    assert 0.9 <= bench.coverage(kind, 120) <= 0.995


def test_intervals_of_areas_hold_the_truth():
    """As many as 30 trials can tell; the slow test has twenty times as many."""
    assert bench.coverage("areas, one friction", 30) >= 0.83


@pytest.mark.slow
@pytest.mark.parametrize("kind", bench.KINDS)
def test_many_synthetic_intervals_hold_the_truth(kind):
    assert 0.92 <= bench.coverage(kind, 600) <= 0.985


@pytest.mark.slow
def test_a_policy_is_hardly_ever_told_apart_from_itself(recorded):
    by_score, by_detail = bench.false_alarms("waves and obstacles, one friction", 100)
    assert by_score <= 0.05 and by_detail <= 0.07
    pairs = list(zip(recorded[::2], recorded[1::2], strict=False))
    assert len(pairs) >= 10
    assert np.sum([bench.alarm(pair) for pair in pairs], axis=0).tolist() == [0.0, 0.0]


@pytest.mark.slow
def test_areas_tell_a_policy_from_itself_as_seldom():
    by_score, by_detail = bench.false_alarms("areas, one friction", 60)
    assert by_score <= 0.1 and by_detail <= 0.1


def test_a_policy_that_is_better_is_told_apart():
    generator = np.random.default_rng(5)
    policy = bench.make_policy(generator, ("wave", "obstacle", "stairs_fd"), tuple(0.1 * n for n in range(2, 11)))
    better = bench.replace(policy, success=np.roll(policy.success, 1, axis=1), quality=policy.quality + 0.05)
    better.success[:, 0] = 1.0
    found = bench.compare([bench.synthetic(p, bench.RULES, generator) for p in (policy, better)], ["old", "new"])
    score = found.differences[0]
    assert score.real and score.difference == pytest.approx(0.09, abs=0.05)
    assert found.sentences[0].startswith("'new' is better than 'old'")


def test_lapses_neither_shift_the_score_nor_leave_the_interval():
    """One failure in five trials at easy levels: as much as 24 evaluations can tell; the slow test has all shapes."""
    found = bench.judge_shape("lapses of 20 %", 12, seed=11, environments=4)
    assert abs(found.bias) < 0.008
    assert found.covered >= 0.8
    assert found.trials < 1.2 * found.before


@pytest.mark.slow
@pytest.mark.parametrize("shape", bench.SHAPES)
def test_scores_are_unbiased_for_pass_curves_of_every_shape(shape):
    found = bench.judge_shape(shape, 200)
    assert abs(found.bias) < 0.002
    assert 0.92 <= found.covered <= 0.98
    assert found.alarms <= 0.07
    assert found.trials <= 1.2 * found.before
