"""What a plan requires, counts and may require, for every table of outcomes."""

import itertools
import random

import pytest
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.pipelines import Environment
from gaitgauge.gauge.plan import PlanRules, environment_result, plan, plan_list
from gaitgauge.gauge.suite import load_suite
from scripted_gauge import MAXIMUM, episode

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")
SLOPE = Environment(terrain="slope_fd", friction=0.6, payload=0.0, level=None)
RULES = PlanRules(suite=REFERENCE, seeds=(0, 1, 2))
LEVELS_ALONE = PlanRules(suite=REFERENCE, seeds=(0, 1, 2), quality=False)


def record(e, success):
    return Record(episode=e, success=success(e) if e.stage == "search" else None)


def play(environment, rules, success, *, order=None, ahead=0.0, records=None):
    """Play one required episode after the other, in random order if ``order`` is given, possible ones among them.

    Returns all records, and those that were required when they were played.
    """
    records, required = dict(records or {}), []
    while (found := plan(environment, records, rules)).required:
        choice = found.possible if order and found.possible and order.random() < ahead else found.required
        e = order.choice(sorted(choice)) if order else choice[0]
        assert e not in records, "played twice"
        records[e] = record(e, success)
        required += [e] if choice is found.required else []
    return records, required


def searched_level(passes):
    """Gauge protocol §7: bisection upwards from level 0, which is never played. ``passes`` has an entry for each level."""
    low, high, tested = 0, 10, []
    while low < high:
        middle = (low + high + 1) // 2
        tested.append(middle)
        if passes[middle - 1]:
            low = middle
        else:
            high = middle - 1
    return low, tested


def search_of(level, outcomes, records=None):
    """The plan after episodes of a level have ended."""
    found = plan(SLOPE, {}, RULES)
    records = dict(records or {})
    tests = {e.seed: e for e in (*found.required, *found.possible) if (e.stage, e.level) == ("search", level)}
    records |= {tests[seed]: Record(episode=tests[seed], success=success) for seed, success in outcomes.items()}
    return plan(SLOPE, records, RULES), records


# ---- one level ------------------------------------------------------------------------------------------------------


def test_a_level_test_has_the_outcome_of_playing_every_seed_in_whatever_order_they_end():
    for outcomes in itertools.product((False, True), repeat=5):
        counted = set()
        for order in ((0, 1, 2, 3), (3, 2, 1, 0), (1, 3, 0, 2)):
            known = {}
            for seed in order:
                known[seed] = outcomes[seed]
                found, _ = search_of(5, known)
            if outcomes[:4].count(True) == 3:
                assert [e.seed for e in found.required if e.level == 5] == [4]
                found, _ = search_of(5, dict(enumerate(outcomes)))
            assert found.passed[5] is (sum(outcomes) / 5 >= 0.8)
            counted.add(frozenset(e.seed for e in found.counted if e.level == 5))
        # four successes are needed: a round of four, and of one more where that leaves it open
        assert counted == {frozenset(range(5 if outcomes[:4].count(True) == 3 else 4))}


def test_what_follows_does_not_wait_for_the_rest_of_a_round_which_still_counts():
    found, _ = search_of(5, {1: False, 3: False})
    assert found.passed == {5: False}
    assert [(e.level, e.seed) for e in found.required] == [(5, 0), (5, 2), *((2, seed) for seed in range(4))]


def test_the_fifth_seed_is_possible_as_long_as_the_round_may_leave_it_open():
    """One failure of four leaves it open; with every rate equally probable that is so in one case of five."""
    found, _ = search_of(5, {})
    fifth = next(e for e in found.possible if (e.level, e.seed) == (5, 4))
    assert found.possible[fifth] == pytest.approx(0.2)
    assert fifth not in search_of(5, {0: True, 1: True, 2: True, 3: True})[0].possible
    assert fifth not in search_of(5, {0: False, 1: False})[0].possible
    assert fifth in search_of(5, {0: False, 1: True, 2: True, 3: True})[0].required


# ---- the search -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_the_search_is_the_references_for_every_table_of_outcomes(every):
    """Monotone or not."""
    for passes in itertools.islice(itertools.product((False, True), repeat=10), 0, None, every):
        records, _ = play(SLOPE, LEVELS_ALONE, lambda e, passes=passes: passes[e.level - 1])
        found = plan(SLOPE, records, LEVELS_ALONE)
        level, tested = searched_level(passes)
        assert found.level == level
        assert found.passed == {k: passes[k - 1] for k in tested}
        assert set(records) == set(found.counted)
        assert found.possible == {}


def test_neither_order_nor_episodes_played_ahead_nor_a_kill_change_what_counts():
    chance, speculative = random.Random(1), 0
    for _ in range(12):
        outcome = {(level, seed): chance.random() < 1.2 - level / 12 for level in range(1, 11) for seed in range(5)}
        passes = [sum(outcome[level, s] for s in range(5)) / 5 >= 0.8 for level in range(1, 11)]
        found = set()
        for ahead, kept in ((0.0, 0.0), (0.5, 0.0), (0.9, 0.3)):
            records, _ = play(SLOPE, RULES, lambda e, o=outcome: o[e.level, e.seed], order=chance, ahead=ahead)
            again = {e: r for e, r in records.items() if chance.random() < kept}
            records, _ = play(
                SLOPE, RULES, lambda e, o=outcome: o[e.level, e.seed], order=chance, records=again | records
            )
            result = plan(SLOPE, records, RULES)
            speculative += len(records) - len(result.counted)
            found.add((result.level, result.counted, tuple(result.passed.items())))
        assert len(found) == 1
        assert result.level == searched_level(passes)[0]
    assert speculative > 60


def test_what_is_required_once_stays_counted_and_was_possible_before():
    """Whatever ends first, required or played ahead: what is neither can be cancelled for good."""
    chance = random.Random(2)
    for ahead in [0.0, 0.5, 0.9] * 8:
        records, required, possible = {}, set(), None
        while (found := plan(SLOPE, records, RULES)).required:
            assert required <= set(found.counted)
            assert possible is None or {*found.required, *found.possible} <= required | possible
            assert not set(found.required) & set(found.possible)
            assert not records.keys() & found.possible.keys()
            assert all(0.0 < p <= 1.0 for p in found.possible.values())
            required, possible = required | set(found.required), set(found.possible)
            choice = found.possible if found.possible and chance.random() < ahead else found.required
            e = chance.choice(sorted(choice))
            records[e] = record(e, lambda e: chance.random() < 1.2 - e.level / 12)
        assert found.possible == {}


def test_how_probable_it_is_that_episodes_are_required():
    """With three of four needed successes and no failure, the next level is asked for unless both other seeds fail: 14 in 15."""
    found, records = search_of(5, {0: True, 1: True, 2: True})
    by_level = {e.level: p for e, p in found.possible.items() if e.stage == "search" and e.seed == 0}
    assert by_level[8] == pytest.approx(14 / 15)
    assert by_level[2] == pytest.approx(1 / 15)
    # all episodes of the search that may be asked for, and quality at every level that may come out
    assert {e.level for e in found.possible if e.stage == "eval"} == set(range(1, 11))
    quality = sum(p for e, p in found.possible.items() if e.stage == "eval" and e.seed == 0)
    assert 0.9 < quality < 1.0, "no level may be passed"
    found, _ = search_of(5, {3: True}, records)
    assert {e.level for e in found.possible if e.stage == "eval"} == set(range(5, 11))
    assert {e.level for e in found.possible if e.stage == "search"} == {6, 7, 8, 9, 10}


def test_quality_follows_at_the_level_reached_with_the_other_goals():
    records, _ = play(SLOPE, RULES, lambda e: e.level <= 4)
    quality = [e for e in plan(SLOPE, records, RULES).counted if e.stage == "eval"]
    assert [(e.level, e.seed) for e in quality] == [(4, 0), (4, 1), (4, 2)]
    assert {e.goals for e in quality} == {("diagonal_velocity", "max_velocity")}
    assert {e.goals for e in records if e.stage == "search"} == {("target_pos_velocity",)}
    assert {e.seed for e in records if e.stage == "search"} <= {0, 1, 2, 3, 4}


def test_the_own_suite_searches_with_seeds_that_quality_does_not_use():
    records, _ = play(SLOPE, PlanRules(suite=OWN, seeds=OWN.matrix.seeds), lambda e: True)
    by_stage = {stage: {e.seed for e in records if e.stage == stage} for stage in ("search", "eval")}
    assert not by_stage["search"] & by_stage["eval"]


def test_quality_is_not_played_where_no_level_is_passed():
    records, _ = play(SLOPE, RULES, lambda e: False)
    result = environment_result(SLOPE, records, RULES)
    assert (result.level, result.search) == (0, {5: False, 2: False, 1: False})
    assert (len(result.trials), result.records) == (12, [])


@pytest.mark.parametrize(("terrain", "level"), [("flat", 0), ("wave", 7)])
def test_flat_ground_and_given_levels_are_not_searched(terrain, level):
    environment = Environment(terrain=terrain, friction=0.6, payload=0.0, level=level)
    found = plan(environment, {}, RULES)
    assert found.level == level
    assert [(e.terrain, e.level, e.seed, e.stage) for e in found.required] == [
        (terrain, level, s, "eval") for s in range(3)
    ]
    assert found.possible == {}
    records = {e: Record(episode=e) for e in found.required}
    result = environment_result(environment, records, RULES)
    assert (result.level, result.search, result.searched) == (level, None, False)
    assert [r.episode for r in result.records] == list(found.counted)


def test_a_list_requires_what_has_not_ended():
    first, second = episode(MAXIMUM, seed=0), episode(MAXIMUM, seed=1)
    found = plan_list([first, second], {first: Record(episode=first)})
    assert (found.counted, found.required) == ((first, second), (second,))
