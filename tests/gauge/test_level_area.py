"""The area under the pass curve: which trials it asks for, that its mean is the area whatever the curve, and how far it scatters."""

import itertools
import random

import numpy as np
import pytest
from gaitgauge.gauge.chance.level_area import area_variances, follow_area, trial_counts
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.pipelines import Environment
from gaitgauge.gauge.plan import PlanRules, environment_result, plan
from gaitgauge.gauge.suite import load_suite
from test_plan import play

OWN = load_suite("gaitgauge-1")
SEEDS = len(OWN.matrix.search_seeds)
WAVE = Environment(terrain="wave", friction=0.6, payload=0.0, level=None)
RULES = PlanRules(suite=OWN, seeds=(0, 1, 2))


def first(passed, levels=10):
    return tuple(level <= passed for level in range(1, levels + 1))


def found(table):
    return follow_area(lambda level: [bool(o) for o in table[level - 1]], len(table), table.shape[1])


@pytest.mark.parametrize(
    ("outcomes", "counts"),
    [
        (first(5), (1, 2, 3, 4, 6, 6, 4, 3, 2, 1)),
        (first(10), (1, 1, 1, 1, 1, 1, 2, 3, 4, 6)),
        (first(0), (6, 4, 3, 2, 1, 1, 1, 1, 1, 1)),
        # one level that fails between others that pass: it is not the crossing of the others
        ((True, True, False, *[True] * 3, *[False] * 4), (1, 1, 2, 3, 4, 6, 6, 4, 3, 2)),
    ],
)
def test_most_trials_are_beside_the_crossing(outcomes, counts):
    """Six beside it, then four, three, two and one; counted by hand."""
    assert trial_counts(outcomes, 6) == counts


def test_the_number_of_trials_at_a_level_ignores_its_own_outcome():
    for outcomes in itertools.product((False, True), repeat=5):
        for at in range(5):
            turned = (*outcomes[:at], not outcomes[at], *outcomes[at + 1 :])
            assert trial_counts(outcomes, 6)[at] == trial_counts(turned, 6)[at]


@pytest.mark.parametrize(
    "chance",
    [(0.9, 0.9, 0.9, 0.4), (1.0, 0.3, 1.0, 0.5), (0.8, 0.8, 0.1, 0.1), (0.5, 0.5, 0.5, 0.5), (0.2, 0.4, 0.6, 0.8)],
)
def test_the_mean_is_the_area_exactly(chance):
    """Over all outcomes of four levels with two seeds, weighted by their probability: no approximation."""
    mean = 0.0
    for outcomes in itertools.product((False, True), repeat=8):
        table = np.array(outcomes).reshape(4, 2)
        probability = np.prod(np.where(table, np.array(chance)[:, None], 1 - np.array(chance)[:, None]))
        mean += probability * found(table).level
    assert mean == pytest.approx(sum(chance), abs=1e-12)


def test_variances_are_those_of_the_levels_found():
    """Of 400 environments with lapses: the mean of the estimates is the spread around the truth, or a little more."""
    generator = np.random.default_rng(0)
    chance = 0.9 / (1.0 + np.exp((np.arange(1, 11) - generator.uniform(3, 9, (400, 1))) / 0.4))
    tables = generator.uniform(size=(400, 10, SEEDS)) < chance[:, :, None]
    searches = [found(table) for table in tables]
    off = np.array([s.level for s in searches]) - chance.sum(1)
    trials = [
        {level: table[level - 1, :count].tolist() for level, count in s.seeds.items()}
        for s, table in zip(searches, tables, strict=True)
    ]
    assert 0.97 < area_variances(trials).mean() / (off**2).mean() < 1.45


def test_an_environment_without_a_surprise_is_not_certain():
    assert 0.01 < area_variances([{1: [True], 2: [True] * 6, 3: [False] * 6}])[0] < 0.1


# ---- as a plan --------------------------------------------------------------------------------------------------------


def tables_of_chance(count):
    generator = np.random.default_rng(3)
    levels = np.arange(1, 11)
    for _ in range(count):
        chance = 0.9 / (1 + np.exp((levels - generator.uniform(-1, 12)) / generator.uniform(0.1, 2.0)))
        yield generator.uniform(size=(10, SEEDS)) < chance[:, None]


def outcome(tables):
    return lambda e: bool(tables[e.level - 1, e.seed - 100])


def test_neither_order_nor_episodes_played_ahead_change_what_counts():
    for tables in tables_of_chance(4):
        records, required = play(WAVE, RULES, outcome(tables))
        level = plan(WAVE, records, RULES).level
        assert level == found(tables).level
        mixed, _ = play(WAVE, RULES, outcome(tables), order=random.Random(1), ahead=0.4)
        again = plan(WAVE, mixed, RULES)
        assert again.level == level
        assert again.counted == plan(WAVE, records, RULES).counted
        assert set(required) == set(again.counted)


def test_what_is_required_once_stays_counted_and_was_possible_before():
    for tables in tables_of_chance(4):
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


def test_a_robot_that_stands_plays_few_trials_and_no_quality():
    records, _ = play(WAVE, RULES, lambda _: False)
    assert len(records) == 6 + 4 + 3 + 2 + 6
    assert environment_result(WAVE, records, RULES).level == 0.0
