"""Intervals: sub-commands fixed, seeds shared or not, levels redone, and none where one seed shows no spread."""

import math
from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.gauge.chance.intervals import Chance, Evidence
from gaitgauge.gauge.result import ChanceRules, EnvironmentRow, Run
from scipy import stats


def rules(**changes):
    usual = {
        "level_weight": 0.09,
        "quality_weight": 0.19,
        "pass_rate": 0.8,
        "levels": 10,
        "seeds": (0, 1, 2),
        "search_seeds": (0, 1, 2, 3, 4),
        "shared_noise": True,
        "resamples": 2000,
    }
    return ChanceRules(**{**usual, **changes})


def flat(*qualities, friction=0.6):
    runs = {s: Run(columns={"quality": q, "lin_vel_err": 1 - q}) for s, q in enumerate(qualities)}
    return EnvironmentRow(terrain="flat", friction=friction, payload=0.0, runs=runs)


def levelled(level, trials, *qualities, terrain="wave"):
    outcomes = {k: {s: s < reached for s in range(n)} for k, (reached, n) in trials.items()}
    return replace(flat(*qualities), terrain=terrain, level=level, trials=outcomes)


SEARCH = {5: (4, 4), 8: (4, 5), 9: (1, 3)}


def test_flat_ground_has_students_interval_over_seeds():
    values = np.array([0.66, 0.68, 0.73])
    low, high = Evidence([flat(*values)], rules()).chance(np.ones(1)).interval(0.69)
    assert (low, high) == pytest.approx(stats.t.interval(0.95, 2, loc=0.69, scale=stats.sem(values)))


def test_a_robot_that_stands_has_hardly_an_interval():
    """Three seeds .2121502, .2121501, .2121501 had the interval .113 to .418 while sub-commands were resampled."""
    low, high = Evidence([flat(0.2121502, 0.2121501, 0.2121501)], rules()).chance(np.ones(1)).interval(0.2121501)
    assert high - low < 1e-6


def test_one_seed_has_no_interval_and_no_p_value():
    chance = Evidence([flat(0.7), levelled(8, SEARCH, 0.4)], rules(seeds=(0,))).chance(np.full(2, 0.5))
    assert not chance.known
    assert chance.interval(0.7) is None
    assert chance.p_value(0.1) is None


def test_the_levels_of_one_quality_seed_still_have_an_interval():
    low, high = Evidence([levelled(8, SEARCH, 0.4)], rules(seeds=(0,))).level_chance(np.ones(1)).interval(8.0, (0, 10))
    assert 6.0 < low < 7.5 and 8.5 < high < 9.7


def test_one_search_seed_has_no_interval():
    evidence = Evidence([levelled(8, {8: (1, 1), 9: (0, 1)}, 0.4, 0.4, 0.4)], rules(search_seeds=(0,)))
    assert evidence.chance(np.ones(1)).interval(0.7) is None
    assert evidence.level_chance(np.ones(1)).interval(8.0) is None


def test_levels_that_were_given_are_certain():
    evidence = Evidence([replace(levelled(6, SEARCH, 0.4, 0.5, 0.6), trials={})], rules())
    assert evidence.redrawn.tolist() == [[6] * 2000]
    assert evidence.chance(np.ones(1)).error == pytest.approx(0.19 * 0.1 / math.sqrt(3))


def test_a_level_is_worth_its_weight():
    """Nearly all of the error of one levelled environment is the level's: some .09 for each."""
    evidence = Evidence([levelled(8, SEARCH, 0.4, 0.4, 0.4)], rules())
    ones = np.ones(1)
    assert 0.3 < evidence.level_chance(ones).error < 0.8
    # of a metric, which stays; the quality falls with the level, and takes something of that
    assert evidence.chance(ones, ("lin_vel_err",)).error == pytest.approx(0.09 * evidence.level_chance(ones).error)
    assert 0.8 < evidence.chance(ones).error / evidence.chance(ones, ("lin_vel_err",)).error < 0.95


def test_shared_seeds_add_up_and_independent_ones_average_out():
    rows = [flat(0.6, 0.7, 0.8, friction=f) for f in (0.2, 0.4, 0.6, 0.8)]
    even = np.full(4, 0.25)
    shared, apart = (Evidence(rows, rules(shared_noise=s)).chance(even) for s in (True, False))
    assert shared.error == pytest.approx(0.1 / math.sqrt(3))
    assert shared.freedom == pytest.approx(2.0)
    assert apart.error == pytest.approx(0.1 / math.sqrt(3) / 2)
    assert apart.freedom == pytest.approx(8.0)


def test_metrics_of_a_run_keep_what_they_have_in_common():
    """A metric that falls as the other rises: their mean has no error."""
    chance = Evidence([flat(0.6, 0.7, 0.8)], rules()).chance(np.ones(1), ("quality", "lin_vel_err"))
    assert chance.error == pytest.approx(0.0, abs=1e-12)


def test_an_environment_that_passes_no_level_may_have_passed_one():
    rows = [
        levelled(0, {5: (0, 2), 2: (0, 2), 1: (3, 5)}),
        levelled(5, {5: (4, 4), 8: (0, 2), 6: (0, 2)}, 0.5, 0.5, 0.5),
    ]
    chance = Evidence(rows, rules()).chance(np.array([1.0, 0.0]))
    assert chance.error > 0.01
    alone = Evidence(rows[:1], rules(), name="x").chance(np.ones(1))
    assert alone.error == pytest.approx(chance.error, rel=0.2)


def test_the_same_rows_have_the_same_interval():
    first, second = (Evidence([levelled(8, SEARCH, 0.4, 0.5, 0.6)], rules()).chance(np.ones(1)) for _ in range(2))
    assert first.interval(0.7) == second.interval(0.7)


def test_intervals_stay_within_what_a_score_can_be():
    assert Evidence([flat(0.9, 0.99, 0.999)], rules()).chance(np.ones(1)).interval(0.963)[1] == 1.0


def test_a_paired_difference_knows_what_both_have_in_common():
    one = Evidence([flat(0.5, 0.6, 0.7)], rules()).chance(np.ones(1))
    other = Evidence([flat(0.4, 0.5, 0.6)], rules()).chance(np.ones(1))
    assert one.minus(other, paired=True).error == pytest.approx(0.0, abs=1e-12)
    assert one.minus(other, paired=True).p_value(0.1) == pytest.approx(0.0, abs=1e-9)
    assert one.minus(other, paired=False).error == pytest.approx(0.1 * math.sqrt(2 / 3))
    assert one.minus(other, paired=False).freedom == pytest.approx(4.0)


def test_the_variance_of_a_level_is_known_from_a_dozen_trials_alone():
    """Eight degrees of freedom for each environment, and more of them know more."""
    one = Evidence([levelled(8, SEARCH, 0.4, 0.4, 0.4)], rules()).level_chance(np.ones(1))
    assert one.freedom == pytest.approx(8.0)
    three = Evidence([levelled(8, SEARCH, 0.4, 0.4, 0.4)] * 3, rules()).level_chance(np.full(3, 1 / 3))
    assert three.freedom == pytest.approx(24.0, rel=0.01)
    other = Evidence([levelled(8, SEARCH, 0.4, 0.4, 0.4)], rules(), name="other").level_chance(np.ones(1))
    assert one.minus(other, paired=True).freedom == pytest.approx(16.0, rel=0.01)


def test_p_value_and_interval_agree():
    chance = Chance(levels=np.array([-0.1, 0.0, 0.1]), seeds=(np.array([[0.02, -0.01, -0.01]]),))
    high = chance.interval(0.0, None)[1]
    assert chance.p_value(high) == pytest.approx(0.05)
    assert Chance(levels=np.zeros(3), seeds=()).p_value(0.0) == 1.0
    assert Chance(levels=np.zeros(3), seeds=()).p_value(0.1) == 0.0
