"""The remaining time of studies of several turns and several engines, on timelines."""

import dataclasses

import pytest
from gaitgauge.gauge.play.progress import Status
from gaitgauge.gauge.play.remaining import CPU_COST, Cost, Pace, Stage, Stages, Work
from gaitgauge.studies.turns import EvaluationTurns, Turns


def errors(seconds, stages, *, in_seconds, ticks=20):
    """Return the error at each tenth where the stages take so long; the share that is done rises evenly in each."""
    told, found, now, ends = Stages(stages, in_seconds), [], 0.0, sum(seconds)
    for number, length in enumerate(seconds):
        told.begin(number, now)
        for tick in range(ticks):
            at = now + length * tick / ticks
            found.append((at, told.left(at, tick / ticks)))
        now += length
        told.end(now)
    assert told.left(now) == 0.0
    nearest = [min(found, key=lambda pair: abs(pair[0] - tenth / 10 * ends)) for tenth in range(1, 10)]
    return [left / (ends - at) - 1.0 for at, left in nearest]


@pytest.mark.parametrize(
    ("seconds", "stages", "in_seconds"),
    [
        # eight scenarios of unequal length, on a machine of unknown speed
        ([4.0, 40.0, 12.0, 6.0, 30.0, 9.0, 15.0, 20.0], [2.0, 22.0, 6.5, 2.8, 14.0, 5.0, 7.0, 11.0], False),
        # an engine that compiles and is slow comes last, and was measured; the machine is slower than then
        ([20.0, 22.0, 180.0], [15.0, 15.0, 140.0], True),
        # two policies in two engines: the second engine takes twice the time that was expected
        ([10.0, 60.0, 10.0, 60.0], [10.0, 45.0, 10.0, 45.0], True),
    ],
)
def test_the_remaining_time_of_unequal_turns_holds(seconds, stages, in_seconds):
    names = [Stage(str(i), cost, f"kind {i % 2}" if len(stages) == 4 else f"kind {i}") for i, cost in enumerate(stages)]
    found = errors(seconds, names, in_seconds=in_seconds)
    assert all(abs(error) <= 0.3 for error in found), found


def test_what_was_there_before_takes_no_time_of_its_kind():
    stages = Stages([Stage("a", 10.0, "x"), Stage("b", 10.0, "x")])
    stages.begin(0, 0.0)
    stages.end(0.1, counts=False)  # all episodes were played by an earlier run
    assert stages.left(0.1) == pytest.approx(10.0)


def test_a_pace_learns_the_scale_at_once_and_the_parts_as_worlds_vary():
    truth, pace = Cost(loop=8e-3, world=4e-3), Pace(CPU_COST)
    assert not pace.known and pace.seconds(Work(loops=1000)) == pytest.approx(3.0)
    loops = steps = seconds = 0.0
    for worlds in [24] * 4 + [20, 12, 6, 2, 1, 1, 1] * 8:
        loops, steps = loops + 50, steps + 50 * worlds
        seconds += truth.seconds(Work(loops=50, world_steps=50 * worlds))
        pace.see(seconds, Work(loops=loops, world_steps=steps))
        if loops == 200:  # 24 worlds alone: their cost is known
            assert pace.seconds(Work(loops=100, world_steps=2400)) == pytest.approx(10.4, rel=0.01)
    assert pace.seconds(Work(loops=100, world_steps=100)) == pytest.approx(1.2, rel=0.2)
    assert pace.seconds(Work(loops=100, world_steps=2400)) == pytest.approx(10.4, rel=0.2)


def test_turns_are_told_with_their_share_of_the_time():
    now, told = 0.0, []
    turns = Turns(told.append, [Stage("a", 1.0), Stage("b", 3.0)], clock=lambda: now)
    turns.begin("first")
    now = 5.0
    turns.step(0.5)
    now = 10.0
    turns.begin("second")
    now = 10.1
    turns.step(0.5)  # too soon to be told
    assert [(t.number, t.count, t.what) for t in told] == [(1, 2, "first"), (1, 2, "first"), (2, 2, "second")]
    assert [t.seconds_left for t in told] == [None, pytest.approx(35.0), pytest.approx(30.0)]
    assert told[2].share == pytest.approx(0.25)


def test_a_comparison_counts_the_policies_that_follow():
    """It told the time of the policy at work alone."""
    now, told = 0.0, []
    turns = EvaluationTurns(told.append, 3, clock=lambda: now)
    status = Status(done=1, expected=9, active=(), seconds=0.0, seconds_left=None, remaining_work=1.0)
    look = turns.begin()
    look(status)
    now = 20.0
    look(dataclasses.replace(status, seconds_left=80.0))
    now = 110.0
    look = turns.begin()
    look(dataclasses.replace(status, seconds_left=90.0))
    now = 210.0
    turns.begin()  # all of it was played before
    assert [s.seconds_left for s in told] == [None, pytest.approx(280.0), pytest.approx(190.0, rel=0.05)]
    assert told[1].remaining_work == pytest.approx(280.0 / 300.0)
