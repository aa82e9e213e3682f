"""Playing ahead of time: what a search will probably ask for is begun early, and nothing but the time shows it."""

import random
from types import SimpleNamespace

import pytest
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.lanes import _Crew
from gaitgauge.gauge.pipelines import Environment, Plan
from gaitgauge.gauge.runner import EpisodeRunner
from gaitgauge.gauge.store import MemoryStore
from gaitgauge.gauge.suite import load_suite
from scripted_gauge import DIAGONAL, Agenda, ScriptedPolicy, episode, fake, short_suite

REFERENCE = load_suite("robogauge-1.1")


def environment():
    return Environment(terrain="slope_fd", friction=0.6, payload=0.0, level=None, searched=True)


def begun():
    """A search whose first level, 5, has three of the four successes that it needs; one episode of it is at work."""
    item, store = environment(), MemoryStore()
    plan = Plan(REFERENCE, [item], [0, 1], store)
    *some, last = plan.take(9)
    for e in some:
        assert plan.take_ahead(9) == []
        plan.finished(Record(episode=e, success=True))
    return item, store, plan, last


def test_the_next_level_is_begun_when_one_success_is_missing_and_nothing_shows_until_it_is_asked_for():
    item, store, plan, last = begun()
    ahead = plan.take_ahead(3)
    assert [(e.stage, e.level, e.seed) for e in ahead] == [("search", 8, 0), ("search", 8, 1), ("search", 8, 2)]
    before = plan.done, plan.total_known, set(store.records)
    plan.finished(Record(episode=ahead[0], success=False))
    assert (plan.done, plan.total_known, set(store.records)) == before
    assert plan.needless() == []
    plan.finished(Record(episode=last, success=True))
    assert ahead[0].key in store.records
    assert [(e.level, e.seed) for e in plan.take(9)] == [(8, 3)], "two are at work already"
    plan.finished(Record(episode=ahead[1], success=False))
    assert ahead[1].key in store.records
    assert len(item.trials) == plan.done == 6
    assert plan.needless() == []


def test_what_nobody_will_ask_for_is_called_off_and_leaves_nothing():
    item, store, plan, last = begun()
    ahead = plan.take_ahead(9)
    assert len(ahead) == 4
    plan.finished(Record(episode=ahead[0], success=True))
    plan.finished(Record(episode=last, success=False))
    assert plan.take_ahead(9) == [], "a failure makes it uncertain"
    assert plan.needless() == [], "the fifth seed can still pass the level"
    (fifth,) = plan.take(9)
    plan.finished(Record(episode=fifth, success=False))
    assert plan.needless() == ahead[1:]
    assert plan.needless() == []
    plan.finished(Record(episode=ahead[1], success=True))  # it ended before its lane heard of it
    assert not {e.key for e in ahead} & set(store.records)
    assert len(item.trials) == plan.done == 5
    assert {e.level for e in plan.take(9)} == {2}


def test_quality_is_begun_where_the_last_level_in_question_is_nearly_passed():
    item, _, plan, _ = begun()
    item.low, item.high = 4, 5
    ahead = plan.take_ahead(9)
    assert [(e.stage, e.level, e.seed) for e in ahead] == [("eval", 5, 0), ("eval", 5, 1)]
    assert plan.take_ahead(9) == []


def play(plan, success, order, *, ahead):
    """Play a plan, episodes ending in any order; returns how many were played ahead."""
    at_work, played = [], 0
    while True:
        at_work += plan.take(4)
        if ahead:
            new = plan.take_ahead(order.randrange(4))
            played += len(new)
            at_work += new
        if not at_work:
            return played
        ended = at_work.pop(order.randrange(len(at_work)))
        plan.finished(Record(episode=ended, success=success(ended) if ended.stage == "search" else None))
        needless = plan.needless() if order.random() < 0.5 else []
        assert set(needless) <= set(at_work)
        at_work = [e for e in at_work if e not in needless]


@pytest.mark.parametrize("share_known", [0.0, 0.3])
def test_playing_ahead_changes_neither_results_nor_what_is_stored(share_known):
    """Whatever the outcomes and whoever ends first, after a kill too."""
    chance, played = random.Random(3), 0
    for _ in range(60):
        outcome = {(level, seed): chance.random() < 1.2 - level / 12 for level in range(1, 11) for seed in range(5)}
        found, known = [], None
        for ahead in (False, True):
            items, store = [environment(), Environment(**vars(environment()) | {"terrain": "wave"})], MemoryStore()
            if known is not None:
                store.records = {k: r for k, r in known.items() if chance.random() < share_known}
            plan = Plan(REFERENCE, items, [0, 1, 2], store)
            played += play(plan, lambda e, o=outcome: o[e.level, e.seed], chance, ahead=ahead)
            assert plan.done == plan.total_known
            assert not any(item.ahead for item in items)
            rows = [sorted(r.episode.key for r in (*item.trials, *item.records)) for item in items]
            found.append(([item.level for item in items], rows, set(store.records)))
            known = store.records
        assert found[0] == found[1]
    assert played > 60


def test_an_episode_that_is_called_off_leaves_with_the_next_control_step():
    agenda, steps = Agenda([episode(DIAGONAL)]), []
    suite = short_suite()
    runner = EpisodeRunner(suite, ScriptedPolicy(), fake(suite, slots=8), lambda e: 0)
    runner.run(
        agenda,
        lambda progress: steps.append(progress.control_steps),
        lambda: [episode(DIAGONAL)] if len(steps) == 5 else [],
    )
    assert runner.control_steps == 5
    assert agenda.records == []


def crew(lanes):
    """A crew without processes, whose connections keep what is sent."""
    made = _Crew.__new__(_Crew)
    made._connections = [SimpleNamespace(sent=[], send=lambda message: None) for _ in range(lanes)]
    made._at_work, made._needless = [set() for _ in range(lanes)], [[] for _ in range(lanes)]
    made._calls, made._changes = [SimpleNamespace(value=0) for _ in range(lanes)], SimpleNamespace(value=0)
    return made


def test_a_lane_with_little_to_do_plays_ahead_and_hears_when_that_is_over():
    _, _, plan, last = begun()
    made = crew(3)
    made._at_work[0].add(last)
    made._at_work[1].update(episode(DIAGONAL, seed=seed) for seed in range(16))
    assert made._share(plan, 1, 9, False) == [], "it has enough to do"
    assert made._share(plan, 2, 9, True) == [], "nobody waits for it yet"
    ahead = made._share(plan, 2, 9, False)
    assert [e.level for e in ahead] == [8]
    made._give(2, ahead)
    plan.finished(Record(episode=last, success=False))
    made._call_off(plan.needless())
    assert [calls.value for calls in made._calls] == [0, 0, 0]
    (fifth,) = made._share(plan, 0, 9, True)
    plan.finished(Record(episode=fifth, success=False))
    made._call_off(plan.needless())
    assert [calls.value for calls in made._calls] == [0, 0, 1]
    assert made._needless == [[], [], ahead]
    assert made._at_work[2] == set()
