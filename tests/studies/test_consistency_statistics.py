"""Known answers of the paired statistics."""

import math
from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.backends.description import FootContact
from gaitgauge.gauge.totals import environment_weights
from gaitgauge.studies.consistency.statistics import (
    DIFFERENT,
    EQUIVALENT,
    UNDECIDED,
    Estimate,
    by_goal,
    effect_size,
    outcome_agreement,
    paired_mean,
    replicates,
    sign_flip,
    spread_of_mean,
    tail_probability,
)
from scipy import stats


def estimate(values, terrains=None, *, shared=False, resamples=4000):
    values = np.asarray(values, dtype=float)
    terrains = terrains or [f"t{i}" for i in range(len(values))]
    return paired_mean(values, terrains, shared=shared, resamples=resamples, name="test")


def test_every_terrain_weighs_the_same_whatever_its_environments():
    assert environment_weights(["flat", "wave", "wave", "wave"]) == pytest.approx([1 / 2, 1 / 6, 1 / 6, 1 / 6])
    found = estimate([[1.0, 1.0], [4.0, 4.0], [4.0, 4.0]], ["flat", "wave", "wave"])
    assert found.value == pytest.approx(2.5)
    assert (found.low, found.high) == pytest.approx((2.5, 2.5))


def test_no_difference_has_the_interval_zero_to_zero():
    found = estimate(np.zeros((4, 3)))
    assert (found.value, found.low, found.high) == (0.0, 0.0, 0.0)
    assert found.verdict(0.01) == EQUIVALENT


def test_tail_is_that_of_the_expanded_percentile_interval():
    # n = 5: t(0.975, 4) = 2.776445, times sqrt(5/4) = 3.104160; the normal tail beyond is 9.541e-4
    assert tail_probability(5, 4) == pytest.approx(9.541e-4, rel=1e-3)
    # 28 degrees of freedom: t = 2.048407
    assert tail_probability(5, 28) == pytest.approx(0.5 * math.erfc(2.048407 * math.sqrt(1.25 / 2)), rel=1e-4)
    assert tail_probability(100000, 99999) == pytest.approx(0.025, rel=1e-3)


def test_standard_error_and_degrees_of_freedom():
    even = np.array([[1.0, 2.0, 3.0], [4.0, 6.0, 5.0]])  # variance 1 each
    weights = np.array([0.5, 0.5])
    error, freedom = spread_of_mean(even, weights, shared=False)
    assert error == pytest.approx(math.sqrt(2 * 0.25 / 3))
    assert freedom == pytest.approx(4.0)  # equal spreads: all E (n - 1) of them
    lone = np.array([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]])
    assert spread_of_mean(lone, weights, shared=False)[1] == pytest.approx(2.0)
    # weighted sums of the seeds are 2.5, 4, 4: variance 0.75
    error, freedom = spread_of_mean(even, weights, shared=True)
    assert error == pytest.approx(math.sqrt(0.75 / 3))
    assert freedom == 2.0


def test_few_seeds_get_students_interval():
    found = estimate([[1.0, 2.0, 3.0]], shared=True)
    # t(0.975, 2) = 4.302653, standard error 1/sqrt(3)
    assert (found.low, found.high) == pytest.approx(
        (2 - 4.302653 / math.sqrt(3), 2 + 4.302653 / math.sqrt(3)), rel=1e-5
    )
    size = paired_mean(np.array([[1.0, 2.0, 3.0]]), ["flat"], shared=True, resamples=100, name="m", magnitude=True)
    assert size.low == 0.0


def test_spread_of_the_replicates_is_that_of_a_mean():
    """Variance of a bootstrap mean: the squared standard deviation (divisor n) over n, known exactly."""
    values = np.array([[0.0, 1.0, 2.0, 5.0], [3.0, 3.0, 9.0, 1.0]])
    weights = np.array([0.25, 0.75])
    apart = replicates(values, weights, shared=False, resamples=100_000, name="a")
    together = replicates(values, weights, shared=True, resamples=100_000, name="b")
    assert apart.var() == pytest.approx((weights**2 * values.var(1)).sum() / 4, rel=0.02)
    assert together.var() == pytest.approx((weights @ values).var() / 4, rel=0.02)
    assert apart.mean() == pytest.approx(weights @ values.mean(1), abs=0.02)


def test_seeds_that_cancel_between_environments_are_seen_when_draws_are_shared():
    values = np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]])
    found = estimate(values, shared=True)
    assert (found.low, found.high) == pytest.approx((2.0, 2.0))
    assert estimate(values, shared=False).high > 2.2


@pytest.mark.parametrize("seeds", [2, 3, 10])
def test_interval_holds_the_truth_about_as_often_as_it_says(seeds):
    generator = np.random.default_rng(3)
    trials = 500
    hits = 0
    for trial in range(trials):
        sample = generator.normal(0.3, 1.0, size=(1, seeds))
        found = paired_mean(sample, ["flat"], shared=True, resamples=500, name=str(trial))
        hits += found.low <= 0.3 <= found.high
    assert 0.93 <= hits / trials <= 0.98


def test_one_seed_has_no_interval():
    with pytest.raises(ValueError, match="at least 2 seeds"):
        estimate([[1.0]])


def test_the_same_question_has_the_same_answer():
    values = np.random.default_rng(0).normal(size=(3, 6))
    assert estimate(values) == estimate(values)


def test_effect_size():
    assert effect_size(np.array([1.0, 2.0, 3.0])) == pytest.approx(2.0)
    assert effect_size(np.array([[0.5, -0.5], [0.5, -0.5]])) == pytest.approx(0.0)
    assert effect_size(np.zeros(4)) == 0.0
    assert effect_size(np.full(4, 0.2)) is None
    assert effect_size(np.array([0.2])) is None


def test_agreement_of_outcomes():
    reference = [True] * 5 + [False] * 5 + [True] * 3 + [False] * 7
    compared = [False] * 5 + [False] * 5 + [True] * 3 + [False] * 7
    found = outcome_agreement(reference, compared, range(20), shared=False)
    assert (found["both"], found["only_reference"], found["only_compared"], found["neither"]) == (3, 5, 0, 12)
    assert found["same"] == pytest.approx(0.75)
    # Wilson: (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n) with p = 0.75, n = 20, z = 1.95996
    assert found["interval"] == pytest.approx([0.531299, 0.888138], abs=1e-4)
    # five lone falls, all in one engine: 2 · (1/2)^5
    assert found["p_value"] == pytest.approx(0.0625)
    assert outcome_agreement([], [], [], shared=True) is None
    assert outcome_agreement([True], [True], [0], shared=False)["p_value"] == 1.0


def test_episodes_of_one_seed_are_one_witness_where_they_share_its_noise():
    """Ten environments that all fall with seed 0, in one engine alone, are one accident and not ten."""
    seeds = np.repeat([0, 1, 2], 10)
    reference, compared = np.zeros(30, bool), seeds == 0
    apart = outcome_agreement(reference, compared, seeds, shared=False)
    together = outcome_agreement(reference, compared, seeds, shared=True)
    assert apart["p_value"] == pytest.approx(2 * 0.5**10)
    assert together["p_value"] == 1.0
    assert together["interval"][0] < 0.2 < apart["interval"][0]
    assert apart["same"] == together["same"]


def test_a_share_of_one_seed_could_be_any():
    assert outcome_agreement([True, True], [True, True], [0, 0], shared=True)["interval"] == [0.0, 1.0]


def test_sign_flips_by_hand():
    # of the eight sums of ±3 ±2 ±1 only 6 and -6 are as far from zero as 6; four of 4, 2, 0, -2, -4, … reach 4
    assert sign_flip(np.array([3, 2, 1])) == pytest.approx(2 / 8)
    assert sign_flip(np.array([3, 2, -1])) == pytest.approx(4 / 8)
    assert sign_flip(np.array([0, 0])) == 1.0
    lone = np.array([1] * 8 + [-1] * 2)
    assert sign_flip(lone) == pytest.approx(stats.binomtest(8, 10).pvalue)


def test_false_alarms_of_clustered_outcomes_stay_rare():
    """Two engines that fall alike, seeds being lucky or not as a whole: McNemar alone calls that different every third time."""
    generator = np.random.default_rng(4)
    alarms = {True: 0, False: 0}
    seeds = np.repeat(np.arange(10), 12)
    for _ in range(200):
        lucky = generator.random((2, 10, 1)) < 0.5
        fell = (generator.random((2, 10, 12)) < np.where(lucky, 0.1, 0.7)).reshape(2, -1)
        for shared in alarms:
            alarms[shared] += outcome_agreement(*fell, seeds, shared=shared)["p_value"] < 0.05
    assert alarms[True] <= 0.08 * 200
    assert alarms[False] > 0.2 * 200


def test_shares_of_clusters_are_covered():
    generator = np.random.default_rng(5)
    hits = 0
    for _ in range(300):
        chance = generator.beta(8.0, 2.0, size=(6, 1))
        same = generator.random((6, 10)) < chance
        found = outcome_agreement([True] * 60, same.ravel(), np.repeat(np.arange(6), 10), shared=True)
        hits += found["interval"][0] <= 0.8 <= found["interval"][1]
    assert 0.92 <= hits / 300 <= 0.995


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [
        (-0.01, 0.015, EQUIVALENT),
        (0.001, 0.01, EQUIVALENT),
        (0.001, 0.03, DIFFERENT),
        (-0.3, -0.02, DIFFERENT),
        (-0.001, 0.03, UNDECIDED),
        (-0.4, 0.5, UNDECIDED),
    ],
)
def test_no_difference_is_said_only_where_none_that_matters_can_hide(low, high, word):
    assert Estimate(value=(low + high) / 2, low=low, high=high).verdict(0.02) == word


def test_goals_are_rows_of_their_own():
    # two environments, two seeds, two goals; terrains of one weight
    values = np.array([[[1.0, 10.0], [3.0, 10.0]], [[5.0, 20.0], [7.0, 20.0]]])
    rows, weights = by_goal(values, ["flat", "wave"], shared=True)
    assert rows == pytest.approx(np.array([[3.0, 5.0], [15.0, 15.0]]))  # a goal over both environments, by seed
    assert weights == pytest.approx([0.5, 0.5])
    rows, weights = by_goal(values, ["flat", "wave"], shared=False)
    assert rows == pytest.approx(np.array([[1.0, 3.0], [10.0, 10.0], [5.0, 7.0], [20.0, 20.0]]))
    assert weights == pytest.approx([0.25] * 4)
    assert float(weights @ rows.mean(1)) == pytest.approx(values.mean())


def test_how_many_seeds_would_decide():
    # t(0.975, 4) = 2.776 and 2.776 * 0.04 * sqrt(2 / 5) = 0.0702; with 4 seeds it is 3.182 * 0.0283 = 0.090
    wide = Estimate(value=0.08, low=-0.43, high=0.59, error=0.04, freedom=1.0, seeds=2)
    assert wide.verdict(0.01) == UNDECIDED and wide.deciding_seeds(0.01) == 5
    assert replace(wide, value=1e-6).deciding_seeds(0.5) < replace(wide, value=1e-6).deciding_seeds(0.05)
    assert replace(wide, value=0.0).deciding_seeds(1e-6) is None


def test_contacts_of_mujoco_are_combined_as_mujoco_does():
    # two feet and a floor: the first foot has priority, the second meets the floor as an equal
    found = FootContact.of_mujoco(
        dimension=[6, 1, 3],
        friction=[[0.4, 0.02, 0.01], [0.4, 0.02, 0.01], [1.0, 0.005, 0.0001]],
        softness=[[0.01, 0.5], [-400.0, -100.0], [0.02, 1.0]],
        priority=[1, 0, 0],
        pyramidal=True,
    )
    assert list(found.dimension) == [6, 3] and found.cone == 4.0
    assert list(found.torsion) == [0.02, 0.0] and list(found.rolling) == [0.01, 0.0]
    assert found.softness[0] == 0.01
    # damping ratio 0.5: exp(-pi 0.5 / sqrt(0.75)) of the speed comes back
    assert found.restitution[0] == pytest.approx(0.16303, abs=1e-5)
