"""Which episodes pipelines ask for: level tests that stop early, searches, matrices."""

import itertools
import random

import pytest
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.pipelines import Environment, LevelTest, Plan, make_environments
from gaitgauge.gauge.store import MemoryStore
from gaitgauge.gauge.suite import SuiteError, load_suite

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")


# ---- one level ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at_once", [False, True])
@pytest.mark.parametrize(("rate", "seeds"), [(0.8, 5), (0.6, 3), (1.0, 3), (0.5, 4), (0.01, 5)])
def test_a_level_test_has_the_outcome_of_playing_every_seed(rate, seeds, at_once):
    for outcomes in itertools.product((False, True), repeat=seeds):
        test = LevelTest(range(seeds), rate, all_at_once=at_once)
        played = []
        while (batch := test.next_round()) or test.passed is None:
            assert batch
            played += batch
            for seed in batch:
                test.record(outcomes[seed])
        assert test.passed is (sum(outcomes) / seeds >= rate)
        assert played == list(range(len(played)))
        assert test.idle


def test_a_level_test_plays_no_more_than_it_needs():
    def needed(outcomes):
        test, count = LevelTest(range(5), 0.8, all_at_once=False), 0
        while batch := test.next_round():
            count += len(batch)
            for seed in batch:
                test.record(outcomes[seed])
        return count

    assert needed([False, False, True, True, True]) == 4
    assert needed([True] * 5) == 4
    assert needed([True, False, True, True, True]) == 5
    assert needed([True, True, False, False, True]) == 4


# ---- the search -------------------------------------------------------------------------------------------------------


def searched_level(passes):
    """Gauge protocol §7: bisection upwards from level 0, which nobody plays. ``passes`` has an entry for each level."""
    low, high, tested = 0, 10, []
    while low < high:
        middle = (low + high + 1) // 2
        tested.append(middle)
        if passes[middle - 1]:
            low = middle
        else:
            high = middle - 1
    return low, tested


def environment():
    return Environment(terrain="slope_fd", friction=0.6, payload=0.0, level=None, searched=True)


def play(plan, success, *, most=3, order=None):
    """Play a plan as the runner does, ``most`` episodes at a time; returns the episodes in the order of their start."""
    started, active = [], []
    while True:
        new = plan.take(most - len(active))
        started += new
        active += new
        if not active:
            return started
        ended = active.pop(order.randrange(len(active)) if order else 0)
        search = ended.stage == "search"
        needless = plan.finished(Record(episode=ended, success=success(ended) if search else None))
        assert set(needless) <= set(active)
        active[:] = [e for e in active if e not in needless]


@pytest.mark.parametrize("speculative", [False, True])
def test_the_search_is_the_references_for_every_table_of_outcomes(speculative):
    """Monotone or not. Speculative search plays all levels at once; a sample of the tables is enough there."""
    tables = list(itertools.product((False, True), repeat=10))
    if speculative:
        tables = [*random.Random(0).sample(tables, 60), (True,) * 10, (False,) * 10]
    for passes in tables:
        item = environment()
        plan = Plan(REFERENCE, [item], [0], MemoryStore(), evaluate=False, speculative=speculative)
        episodes = play(plan, lambda e, passes=passes: passes[e.level - 1], most=50 if speculative else 3)
        level, tested = searched_level(passes)
        assert item.level == level
        if not speculative:
            assert list(dict.fromkeys(e.level for e in episodes)) == tested
            assert {k: t.passed for k, t in item.tests.items()} == {k: passes[k - 1] for k in tested}


def test_the_search_does_not_depend_on_the_order_in_which_episodes_end():
    chance = random.Random(1)
    for _ in range(40):
        outcome = {(level, seed): chance.random() < 1.1 - level / 10 for level in range(1, 11) for seed in range(5)}
        passes = [sum(outcome[level, s] for s in range(5)) / 5 >= 0.8 for level in range(1, 11)]
        found, played = set(), set()
        for most, speculative in ((1, False), (7, False), (64, True)):
            item = environment()
            plan = Plan(REFERENCE, [item], [0, 1, 2], MemoryStore(), speculative=speculative)
            episodes = play(plan, lambda e, o=outcome: o[e.level, e.seed], most=most, order=chance)
            assert len({e.key for e in episodes}) == len(episodes)
            found.add(item.level)
            if not speculative:
                played.add(frozenset(e.key for e in episodes))
            assert [r.episode.seed for r in item.records] == ([0, 1, 2] if item.level else [])
            assert plan.done == plan.total_known == len(item.trials) + len(item.records)
            assert speculative or plan.done == len(episodes)
            assert plan.expected_left() == 0
        assert found == {searched_level(passes)[0]}
        assert len(played) == 1


def test_what_is_played_at_once_is_dropped_as_soon_as_it_decides_nothing():
    """Level 6 is reached. Two failures settle a level, four successes do, and what bisection has passed by is never asked for."""
    item = environment()
    plan = Plan(REFERENCE, [item], [0], MemoryStore(), speculative=True)
    episodes = {(e.level, e.seed): e for e in plan.take(50)}
    assert len(episodes) == 50

    def end(level, seed):
        return {(e.level, e.seed) for e in plan.finished(Record(episode=episodes[level, seed], success=level <= 6))}

    assert end(8, 0) == set()
    higher = {(level, seed) for level in (9, 10) for seed in range(5)}
    assert end(8, 3) == {(8, 1), (8, 2), (8, 4)} | higher
    assert end(8, 1) == set(), "it ended in the same step as the one before"
    lower = {(level, seed) for level in (1, 2, 3, 4) for seed in range(5)}
    assert [end(5, s) for s in range(4)] == [set(), set(), set(), {(5, 4)} | lower]
    assert [end(6, s) for s in range(4)] == [set(), set(), set(), {(6, 4)}]
    assert end(7, 0) == set() and item.level is None
    assert end(7, 1) == {(7, 2), (7, 3), (7, 4)}
    assert item.level == 6
    assert [(e.stage, e.level) for e in plan.take(50)] == [("eval", 6)]


def test_quality_of_the_last_levels_in_question_begins_before_the_search_ends():
    """Levels 6 and 7 are left; one walk of each ends before level 7 is failed, and the other walk of level 6 goes on."""
    item, store = environment(), MemoryStore()
    plan = Plan(REFERENCE, [item], [0, 1], store, speculative=True)
    tests = {(e.level, e.seed): e for e in plan.take(50)}
    assert plan.take(50) == [], "all worlds have level tests to play"
    for level, seeds in ((5, 4), (6, 4), (8, 2)):
        for seed in range(seeds):
            plan.finished(Record(episode=tests[level, seed], success=level <= 6))
    assert plan.take(50, urgent=True) == []
    early = {(e.level, e.seed): e for e in plan.take(3)}
    assert list(early) == [(6, 0), (6, 1), (7, 0)]
    assert {e.stage for e in early.values()} == {"eval"}
    for level in (6, 7):
        assert plan.finished(Record(episode=early[level, 0])) == ()
    early |= {(e.level, e.seed): e for e in plan.take(50)}
    assert list(early)[3:] == [(7, 1)]
    known, done = plan.total_known, plan.done
    assert plan.finished(Record(episode=tests[7, 0], success=False)) == set()
    assert set(plan.finished(Record(episode=tests[7, 1], success=False))) == {
        *(tests[7, seed] for seed in (2, 3, 4)),
        early[7, 1],
    }
    assert item.level == 6
    assert [r.episode for r in item.records] == [early[6, 0]]
    assert (plan.total_known, plan.done) == (known - 3 + 2, done + 2 + 1)
    assert plan.take(50) == []
    assert plan.finished(Record(episode=early[7, 1])) == ()
    plan.finished(Record(episode=early[6, 1]))
    assert [r.episode for r in item.records] == [early[6, 0], early[6, 1]]
    assert plan.done == plan.total_known == len(item.trials) + len(item.records)


def test_quality_follows_at_the_level_reached_with_the_other_goals():
    item = environment()
    episodes = play(Plan(REFERENCE, [item], [0, 1, 2], MemoryStore()), lambda e: e.level <= 4)
    quality = [e for e in episodes if e.stage == "eval"]
    assert [(e.level, e.seed) for e in quality] == [(4, 0), (4, 1), (4, 2)]
    assert {e.goals for e in quality} == {("diagonal_velocity", "max_velocity")}
    assert {e.goals for e in episodes if e.stage == "search"} == {("target_pos_velocity",)}
    assert {e.seed for e in episodes if e.stage == "search"} <= {0, 1, 2, 3, 4}


def test_the_own_suite_searches_with_seeds_that_quality_does_not_use():
    episodes = play(Plan(OWN, [environment()], list(OWN.matrix.seeds), MemoryStore()), lambda e: True)
    by_stage = {stage: {e.seed for e in episodes if e.stage == stage} for stage in ("search", "eval")}
    assert not by_stage["search"] & by_stage["eval"]


def test_nothing_is_played_where_no_level_is_passed():
    item = environment()
    episodes = play(Plan(REFERENCE, [item], [0], MemoryStore()), lambda e: False)
    assert item.level == 0
    assert all(e.stage == "search" for e in episodes)
    assert item.records == []


def test_flat_ground_and_given_levels_are_not_searched():
    items = make_environments(REFERENCE, terrains=["flat", "wave"], frictions=[0.6], payloads=None, level=7)
    episodes = play(Plan(REFERENCE, items, [0, 1], MemoryStore()), lambda e: True)
    assert [(e.terrain, e.level, e.seed) for e in episodes] == [
        ("flat", 0, 0),
        ("flat", 0, 1),
        ("wave", 7, 0),
        ("wave", 7, 1),
    ]


def test_what_the_store_knows_is_not_played_again():
    store = MemoryStore()
    first = play(Plan(REFERENCE, [environment()], [0, 1], store), lambda e: e.level <= 6)
    item = environment()
    assert play(Plan(REFERENCE, [item], [0, 1], store), lambda e: pytest.fail("played again")) == []
    assert item.level == 6
    assert len(item.records) + len(item.trials) == len(first)
    # with some of it lost, just that is played again
    for e in first[::3]:
        del store.records[e.key]
    again = play(Plan(REFERENCE, [environment()], [0, 1], store), lambda e: e.level <= 6)
    assert {e.key for e in again} == {e.key for e in first[::3]}


# ---- matrices ---------------------------------------------------------------------------------------------------------


def matrix(suite, **choices):
    arguments = {"terrains": suite.matrix.terrains, "frictions": None, "payloads": None, "level": None, **choices}
    return make_environments(suite, **arguments)


def test_the_reference_has_63_environments():
    found = matrix(REFERENCE)
    assert len(found) == 63 == len({e.key for e in found})
    assert {e.payload for e in found} == {0.0}
    assert sum(e.searched for e in found) == 54
    assert [e.level for e in found if e.terrain == "flat"] == [0] * 9


def test_the_own_suite_has_payload_on_an_axis_of_its_own():
    found = matrix(OWN)
    assert len(found) == 7 * (9 + 4)
    pairs = {(e.friction, e.payload) for e in found if e.terrain == "wave"}
    assert pairs == {(f, 0.0) for f in OWN.matrix.frictions} | {(0.6, p) for p in (-1.0, 0.0, 1.0, 2.0, 3.0)}


@pytest.mark.parametrize(
    ("choices", "pairs"),
    [
        ({"frictions": [0.2, 0.6]}, [(0.2, 0.0), (0.6, 0.0)]),
        ({"payloads": [3.0]}, [(0.6, 3.0)]),
        ({"frictions": [0.2], "payloads": [1.0, 3.0]}, [(0.2, 1.0), (0.2, 3.0)]),
        ({"frictions": [0.25]}, [(0.25, 0.0)]),
        ({"payloads": [5.0]}, [(0.6, 5.0)]),
        ({"frictions": [0.6, 0.6], "payloads": [1.0, 1.0]}, [(0.6, 1.0)]),
    ],
)
def test_chosen_frictions_and_payloads_of_the_own_suite(choices, pairs):
    found = matrix(OWN, terrains=["wave"], **choices)
    assert [(e.friction, e.payload) for e in found] == pairs


def test_the_reference_crosses_payloads_with_frictions():
    assert len(matrix(REFERENCE, terrains=["wave"], payloads=[0.0, 2.0])) == 18


@pytest.mark.parametrize("level", [0, 11, -1])
def test_levels_that_do_not_exist_are_refused(level):
    with pytest.raises(SuiteError, match=f"level {level} does not exist; choose 1 to 10"):
        matrix(REFERENCE, level=level)


def test_keys_tell_close_frictions_apart():
    one, other = matrix(REFERENCE, terrains=["wave"], frictions=[0.6, 0.60000001])
    assert one.key == "wave-f0.6-m0"
    assert one.key != other.key
