"""The expected level: which trials it asks for, what it comes to, and that one trial moves it a little."""

import itertools
import random

import numpy as np
import pytest
from gaitgauge.gauge.chance.level_curve import bracketing_levels, expected_levels, fitted_curve, follow
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.pipelines import Environment
from gaitgauge.gauge.plan import PlanRules, environment_result, plan
from gaitgauge.gauge.suite import load_suite
from scipy.optimize import isotonic_regression
from test_plan import play

OWN = load_suite("demo")
SEEDS = len(OWN.matrix.search_seeds)
WAVE = Environment(terrain="wave", friction=0.6, payload=0.0, level=None)
RULES = PlanRules(suite=OWN, seeds=(0, 1, 2))


def table(*reached, seeds=SEEDS):
    """Outcomes by level, from the number of seeds that reach the target, the first ones."""
    return np.array([[seed < count for seed in range(seeds)] for count in (*reached, *[0] * (10 - len(reached)))])


def outcome(tables):
    """What ``play`` asks: whether an episode of a level test succeeds."""
    return lambda e: bool(tables[e.level - 1, e.seed - 100])


def found(tables, seeds=SEEDS, bracket=2):
    return follow(lambda level: [bool(o) for o in tables[level - 1]], 10, seeds, bracket)


# ---- the design -------------------------------------------------------------------------------------------------------


def test_a_sharp_crossing_is_its_level_and_costs_two_levels_and_a_bisection():
    search = found(table(6, 6, 6, 6, 6, 6))
    assert search.level == 6.0
    assert search.seeds == {5: 2, 8: 2, 6: 6, 7: 6}


def test_trials_reach_down_to_a_level_that_all_pass_and_up_to_one_that_none_does():
    search = found(table(6, 6, 6, 5, 4, 4, 1, 1, 0, 3))
    assert (search.lowest, search.highest) == (3, 9)
    assert search.level == pytest.approx(3 + 15 / 6)


@pytest.mark.parametrize("count", range(SEEDS + 1))
def test_the_first_level_may_be_passed_in_part(count):
    assert found(table(count)).level == pytest.approx(count / SEEDS)


def test_the_end_of_the_scale_is_an_end():
    assert found(table(*[6] * 10)).level == 10.0
    assert found(table(*[6] * 9, 3)).level == 9.5


def test_one_unlucky_trial_moves_the_level_by_one_part_in_the_seeds():
    """With bisection one level test between 10s that failed by chance was level 7 on waves."""
    lucky = table(6, 6, 6, 6, 6, 6, 6, 6, 6, 6)
    for level, seed in itertools.product(range(10), range(SEEDS)):
        unlucky = lucky.copy()
        unlucky[level, seed] = False
        assert 10.0 - found(unlucky).level <= 1 / SEEDS + 1e-12


def test_the_level_is_the_area_under_the_isotonic_fit():
    generator = np.random.default_rng(0)
    for _ in range(300):
        chance = np.sort(generator.uniform(size=10))[::-1] ** generator.uniform(0.3, 3.0)
        tables = generator.uniform(size=(10, SEEDS)) < chance[:, None]
        search = found(tables)
        played = range(search.lowest, search.highest + 1)
        shares = np.concatenate((np.ones(search.lowest - 1), tables[list(np.array(played) - 1)].mean(1)))
        assert search.level == pytest.approx(isotonic_regression(shares, increasing=False).x.sum())


def test_all_tables_at_once_are_each_on_its_own():
    generator = np.random.default_rng(1)
    tables = generator.uniform(size=(400, 10, 4)) < generator.uniform(size=(400, 10, 1)) ** 0.7
    tables[:200] = np.sort(tables[:200], axis=1)[:, ::-1]
    expected = [found(t, seeds=4).level for t in tables]
    assert expected_levels(tables, 2).tolist() == expected


def test_the_fit_falls_with_the_level():
    assert fitted_curve({5: [True] * 6, 6: [True, False] * 3, 7: [True] * 4 + [False] * 2, 8: [False] * 6}) == (
        pytest.approx({5: 1.0, 6: 7 / 12, 7: 7 / 12, 8: 0.0})
    )
    assert fitted_curve({}) == {}


def test_expected_levels_scatter_about_half_as_much_as_tested_ones():
    """Chances as measured on waves: 6: 1, 7: .9, 8: .55, 9: .1."""
    from gaitgauge.gauge.chance.level_chance import bisected_levels

    generator = np.random.default_rng(2)
    chance = np.array([1, 1, 1, 1, 1, 1, 0.9, 0.55, 0.1, 0.0])
    tested = bisected_levels(generator.uniform(size=(20_000, 10, 5)) < chance[:, None], 0.8)
    expected = expected_levels(generator.uniform(size=(20_000, 10, SEEDS)) < chance[:, None], 2)
    assert expected.mean() == pytest.approx(chance.sum(), abs=0.05)
    assert expected.std() < 0.55 * tested.std()


@pytest.mark.parametrize(
    ("level", "expected"),
    [(0.0, {}), (0.25, {1: 1.0}), (1.0, {1: 1.0}), (5.25, {5: 0.75, 6: 0.25}), (10.0, {10: 1.0})],
)
def test_quality_is_measured_at_the_levels_beside(level, expected):
    assert bracketing_levels(level) == pytest.approx(expected)


# ---- as a plan --------------------------------------------------------------------------------------------------------


def tables_of_chance(count):
    generator = np.random.default_rng(3)
    levels = np.arange(1, 11)
    for _ in range(count):
        chance = 1 / (1 + np.exp((levels - generator.uniform(-1, 12)) / generator.uniform(0.1, 2.0)))
        yield generator.uniform(size=(10, SEEDS)) < chance[:, None]


def test_neither_order_nor_episodes_played_ahead_change_what_counts():
    for tables in tables_of_chance(4):
        records, required = play(WAVE, RULES, outcome(tables))
        level = plan(WAVE, records, RULES).level
        assert level == found(tables).level
        for seed in range(2):
            order = random.Random(seed)
            mixed, _ = play(WAVE, RULES, outcome(tables), order=order, ahead=0.4)
            again = plan(WAVE, mixed, RULES)
            assert again.level == level
            assert again.counted == plan(WAVE, records, RULES).counted
            assert set(required) == set(again.counted)


def test_what_is_required_once_stays_counted_and_was_possible_before():
    for tables in tables_of_chance(8):
        order, records = random.Random(0), {}
        known = plan(WAVE, records, RULES)
        while known.required:
            assert not known.possible.keys() & {*records, *known.counted}
            assert all(0.0 < p < 1.0 for p in known.possible.values())
            e = order.choice(sorted(known.required))
            records[e] = Record(episode=e, success=outcome(tables)(e) if e.stage == "search" else None)
            after = plan(WAVE, records, RULES)
            assert set(known.counted) <= set(after.counted)
            assert set(after.counted) - set(known.counted) <= known.possible.keys()
            known = after


def test_a_gpu_plays_every_level_at_once_but_no_quality_before_the_crossing_is_near():
    from gaitgauge.gauge.evaluate import GPU_SPECULATION

    first = plan(WAVE, {}, RULES)
    ahead = GPU_SPECULATION.choose([first], first.required)
    assert len(ahead) == 10 * SEEDS - 2 and {e.stage for e in ahead} == {"search"}
    # one trial of a narrow crossing is left: quality begins at its levels (0.8 probable) and at those beside them (0.4)
    records, _ = play(WAVE, RULES, outcome(table(6, 6, 6, 6, 6, 6)))
    records = {e: r for e, r in records.items() if e.stage == "search" and (e.level, e.seed) != (7, 105)}
    nearly = plan(WAVE, records, RULES)
    ahead = GPU_SPECULATION.choose([nearly], nearly.required)
    assert {e.level for e in ahead if e.stage == "eval"} == {5, 6, 7, 8}


def test_quality_follows_at_both_levels_with_every_seed():
    records, _ = play(WAVE, RULES, outcome(table(6, 6, 6, 6, 4, 2)))
    result = environment_result(WAVE, records, RULES)
    assert result.level == 5.0  # 4 and one, 4 + 4/6 + 2/6
    assert [(r.episode.level, r.episode.seed) for r in result.records] == [(5, 0), (5, 1), (5, 2)]
    records, _ = play(WAVE, RULES, outcome(table(6, 6, 6, 6, 4, 1)))
    result = environment_result(WAVE, records, RULES)
    assert result.level == pytest.approx(4 + 5 / 6)
    assert [(r.episode.level, r.episode.seed) for r in result.records] == [
        (4, 0),
        (4, 1),
        (4, 2),
        (5, 0),
        (5, 1),
        (5, 2),
    ]
    assert result.search == {5: True, 8: False, 6: False, 4: True, 7: False}


def test_a_robot_that_stands_costs_few_trials_and_no_quality():
    records, _ = play(WAVE, RULES, outcome(table(0)))
    assert len(records) == 2 + 2 + SEEDS
    assert environment_result(WAVE, records, RULES).level == 0.0
