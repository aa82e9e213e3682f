"""Which episode starts when and where; that neither workers, nor order, nor kills show in what is played for results."""

import random
from collections import Counter
from functools import partial

import pytest
from gaitgauge.backends.base import BackendError
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.pipelines import Environment
from gaitgauge.gauge.plan import Plan, PlanRules, plan, plan_list
from gaitgauge.gauge.play.dispatcher import Speculation, play
from gaitgauge.gauge.play.segments import AtWork, count_segments
from gaitgauge.gauge.play.workers import Drop, Failed, Finished, Lost, Play, Progress, Stop
from gaitgauge.gauge.suite import load_suite
from scripted_gauge import DIAGONAL, MAXIMUM, TARGET, episode

RULES = PlanRules(suite=load_suite("robogauge-1.1"), seeds=(0, 1, 2))
SLOPE, WAVE = (Environment(terrain=t, friction=0.6, payload=0.0, level=None) for t in ("slope_fd", "wave"))
PLANNERS = [partial(plan, environment, rules=RULES) for environment in (SLOPE, WAVE)]
EAGER = Speculation(at_work=40, test_probability=0.0, quality_probability=0.0)


class KilledError(Exception):
    pass


class Workers:
    """A transport without processes: at every ``receive`` a worker ends an episode, and all report."""

    def __init__(self, count, worlds, success=lambda e: True, order=None):
        self.count, self.worlds, self.success = count, worlds, success
        self.order = order or random.Random(0)
        self.have = [[] for _ in range(count)]
        self.played, self.stopped = [0] * count, [False] * count
        self.started, self.sent, self.dropped = [], [], []

    def send(self, worker, message):
        assert not self.stopped[worker]
        self.sent.append((worker, message))
        if isinstance(message, Play):
            self.played[worker] += 1
            self.have[worker] += message.episodes
            self.started += message.episodes
        elif isinstance(message, Drop):
            assert set(message.episodes) <= set(self.have[worker])
            self.dropped += message.episodes
            self.have[worker] = [e for e in self.have[worker] if e not in message.episodes]
        else:
            assert isinstance(message, Stop)
            self.stopped[worker] = True

    def receive(self):
        messages = []
        busy = [worker for worker in range(self.count) if self.have[worker] and not self.stopped[worker]]
        assert busy or all(self.stopped), "nothing is at work and nothing was stopped"
        if busy:
            worker = self.order.choice(busy)
            ended = self.have[worker].pop(self.order.randrange(len(self.have[worker])))
            success = self.success(ended) if ended.stage == "search" else None
            messages.append((worker, Finished(Record(episode=ended, success=success))))
        return messages + [(worker, self.progress(worker)) for worker in range(self.count)]

    def progress(self, worker):
        have = self.have[worker]
        return Progress(
            played=self.played[worker],
            room=self.worlds - sum(map(count_segments, have)),
            active=dict.fromkeys(have, AtWork(steps=1, parts=1, spent=1, youngest=1)),
            physics_steps=10,
            engine_seconds=0.5,
            stopped=self.stopped[worker],
        )

    def close(self):
        pass


def finish(workers, *, planners=PLANNERS, records=None, speculation=EAGER, kept=None, watch=None):
    records = {} if records is None else records
    kept = [] if kept is None else kept
    dispatcher = play(planners, records, kept.append, workers, speculation=speculation, watch=watch)
    return records, kept, dispatcher


def counted(records):
    plans = [planner(records) for planner in PLANNERS]
    return [(p.level, p.counted, [records[e].success for e in p.counted]) for p in plans]


def outcomes(chance):
    table = {
        (t, level, s): chance.random() < 1.2 - level / 12 for t in "sw" for level in range(1, 11) for s in range(5)
    }
    return lambda e: table[e.terrain[0], e.level, e.seed]


# ---- the same results -------------------------------------------------------------------------------------------------


def test_neither_workers_nor_their_order_nor_speculation_show_in_what_counts():
    chance, speculative = random.Random(3), 0
    for _ in range(6):
        success, found = outcomes(chance), []
        for count, worlds, speculation in ((1, 24, Speculation()), (3, 24, Speculation(at_work=48)), (1, 500, EAGER)):
            workers = Workers(count, worlds, success, chance)
            records, kept, _ = finish(workers, speculation=speculation)
            assert max(Counter(workers.started).values()) == 1, "an episode was started twice"
            assert {r.episode for r in kept} == set(records)
            assert len(kept) == len(records)
            assert all(workers.stopped)
            found.append(counted(records))
            speculative += len(workers.started) - sum(len(c) for _, c, _ in found[-1])
            if speculation.at_work == 0:
                assert set(workers.started) == {e for _, c, _ in found[-1] for e in c}
        assert found[0] == found[1] == found[2]
    assert speculative > 100


def test_a_run_that_is_killed_again_and_again_plays_nothing_twice_and_loses_nothing():
    chance = random.Random(4)
    for _ in range(4):
        success = outcomes(chance)
        whole, *_ = finish(Workers(2, 24, success, chance))
        records, ended = {}, []
        while True:
            workers, stop_after = Workers(2, 24, success, chance), chance.randrange(1, 30)
            kept = []

            def watch(_, kept=kept, stop_after=stop_after):
                if len(kept) >= stop_after:
                    raise KilledError

            try:
                finish(workers, records=dict(records), kept=kept, watch=watch)
                break
            except KilledError:
                pass
            finally:
                ended += [r.episode for r in kept]
                records |= {r.episode: r for r in kept}
        assert max(Counter(ended).values()) == 1
        assert counted(records) == counted(whole)


def test_a_finished_run_starts_nothing():
    records, *_ = finish(Workers(1, 24))
    workers = Workers(2, 24)
    again, kept, _ = finish(workers, records=dict(records))
    assert (again, kept, workers.started) == (records, [], [])


def test_an_error_of_a_worker_is_the_runs():
    class Broken(Workers):
        def receive(self):
            return [(1, Failed(BackendError("out of memory")))]

    with pytest.raises(BackendError, match="out of memory"):
        finish(Broken(2, 24))


def test_effort_is_added_up_over_workers():
    *_, dispatcher = finish(Workers(3, 24))
    assert (dispatcher.physics_steps, dispatcher.engine_seconds) == (30, 1.5)


def test_a_record_that_was_on_its_way_when_its_episode_was_cancelled_is_kept_and_counts_for_nothing():
    class Late(Workers):
        """Cancelled episodes end all the same."""

        late = ()

        def send(self, worker, message):
            super().send(worker, message)
            if isinstance(message, Drop):
                self.late = [*self.late, *message.episodes]

        def receive(self):
            late, self.late = self.late, []
            return [(0, Finished(Record(episode=e, success=True))) for e in late] + super().receive()

    success = outcomes(random.Random(5))
    late = Late(1, 500, success)
    records, *_ = finish(late)
    assert late.dropped
    assert counted(records) == counted(finish(Workers(1, 500, success))[0])


class Mortal(Workers):
    """Workers that die with all that they have, and perhaps come back; the first one stays."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.dead, self.deaths, self.patience = set(), 0, 2000

    def send(self, worker, message):
        assert worker not in self.dead
        super().send(worker, message)

    def receive(self):
        for worker in [w for w in self.dead if self.order.random() < 0.2]:
            self.dead.remove(worker)
            self.have[worker], self.played[worker], self.stopped[worker] = [], 0, False
        self.patience -= 1
        assert self.patience > 0, "nothing is at work"
        busy = any(have and not stopped for have, stopped in zip(self.have, self.stopped, strict=True))
        heard = super().receive() if busy else [(worker, self.progress(worker)) for worker in range(self.count)]
        messages = [m for m in heard if m[0] not in self.dead]
        for worker in range(1, self.count):
            if worker not in self.dead and self.order.random() < 0.1:
                self.dead.add(worker)
                self.deaths += 1
                self.have[worker], self.stopped[worker] = [], True
                messages = [*(m for m in messages if m[0] != worker), (worker, Lost())]
        return messages


def test_lost_workers_lose_nothing_and_do_not_show_in_what_counts():
    chance, deaths = random.Random(6), 0
    for _ in range(8):
        success = outcomes(chance)
        expected, *_ = finish(Workers(1, 24, success, chance))
        workers = Mortal(4, 24, success, chance)
        records, kept, dispatcher = finish(workers, speculation=Speculation(at_work=30))
        assert counted(records) == counted(expected)
        assert len(kept) == len(records)
        assert dispatcher.active().keys() <= set(workers.have[0])
        deaths += workers.deaths
    assert deaths > 50


def test_what_a_lost_worker_has_done_is_counted_and_its_episodes_wait_again():
    class Dying(Workers):
        """The second worker is lost at the second report."""

        calls = 0

        def receive(self):
            self.calls += 1
            if self.calls == 1:
                return [(0, self.progress(0)), (1, Progress(played=1, physics_steps=700))]
            if self.calls == 2:
                self.have[1], self.stopped[1] = [], True
                return [(1, Lost())]
            return [(worker, message) for worker, message in super().receive() if worker == 0]

    walks = [episode(MAXIMUM, seed=seed) for seed in range(6)]
    workers = Dying(2, 12)
    records, _, dispatcher = finish(workers, planners=[partial(plan_list, walks)], speculation=Speculation())
    assert set(records) == set(walks)
    assert Counter(workers.started) == {e: 1 + (e in walks[1:4:2]) for e in walks}
    assert dispatcher.physics_steps == 710


# ---- who plays what ---------------------------------------------------------------------------------------------------


def first_pushes(workers, episodes, *, speculation=None):
    """What each worker gets before anything has ended."""

    def watch(_):
        raise KilledError

    workers.receive = lambda: [(0, workers.progress(0))]
    with pytest.raises(KilledError):
        planner = episodes if callable(episodes) else partial(plan_list, episodes)
        finish(workers, planners=[planner], speculation=speculation or Speculation(), watch=watch)
    return workers.have


def test_few_level_tests_stay_together_and_many_are_shared():
    tests = [episode(TARGET, stage="search", seed=seed) for seed in range(30)]
    assert [len(have) for have in first_pushes(Workers(2, 24), tests[:6])] == [6, 0]
    assert [len(have) for have in first_pushes(Workers(2, 24), tests[:12])] == [8, 4]
    assert [len(have) for have in first_pushes(Workers(2, 24), tests)] == [15, 15]
    assert [len(have) for have in first_pushes(Workers(2, 10), tests)] == [10, 10], "no more than worlds"


def test_quality_goes_where_there_is_room_but_not_beside_tests_while_a_worker_has_none():
    tests = [episode(TARGET, stage="search", seed=seed) for seed in range(4)]
    walks = [episode(DIAGONAL, MAXIMUM, seed=seed) for seed in range(8)]
    # fourteen segments each: two fill 24 worlds
    assert first_pushes(Workers(2, 24), [*walks, *tests]) == [tests, walks[:2]]
    assert first_pushes(Workers(1, 24), [*walks, *tests]) == [[*tests, *walks[:2]]]
    assert first_pushes(Workers(2, 24), walks) == [[walks[0], walks[2]], [walks[1], walks[3]]]


def test_the_most_probable_episodes_are_begun_within_the_budget_and_cancelled_when_they_decide_nothing():
    sure, likely, unlikely = (episode(TARGET, stage="search", level=level, terrain="wave") for level in (5, 8, 2))
    walk = episode(MAXIMUM, level=8, terrain="wave")

    def planner(records):
        if sure in records:
            return Plan(level=None, counted=(sure, unlikely), required=() if unlikely in records else (unlikely,))
        return Plan(level=None, counted=(sure,), required=(sure,), possible={unlikely: 0.3, walk: 0.95, likely: 0.7})

    def pushed(**options):
        return first_pushes(Workers(1, 24), planner, speculation=Speculation(**options))[0]

    assert pushed() == [sure]
    assert pushed(at_work=24) == [sure, walk]
    assert pushed(at_work=1) == [sure]
    assert pushed(at_work=24, test_probability=0.5) == [sure, likely, walk]
    assert pushed(at_work=2, test_probability=0.5) == [sure, likely]
    assert pushed(at_work=24, test_probability=0.0, quality_probability=1.0) == [sure, likely, unlikely]

    class FirstCome(Workers):
        """The episode that was sent first ends first."""

        def receive(self):
            self.order.choice, self.order.randrange = min, lambda n: 0
            return super().receive()

    workers = FirstCome(1, 24)
    finish(workers, planners=[planner], speculation=EAGER)
    assert workers.started == [sure, likely, unlikely, walk]
    assert set(workers.dropped) == {likely, walk}
