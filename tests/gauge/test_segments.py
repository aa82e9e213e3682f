"""Segments played side by side make up the very record that playing them in a row would give."""

import random
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from gaitgauge.gauge.goals import Schedule
from gaitgauge.gauge.play.rollout import Rollout
from gaitgauge.gauge.play.segments import OpenEpisode, Segment, SegmentOutcome, SegmentRules
from gaitgauge.gauge.suite import load_suite
from scripted_gauge import (
    DIAGONAL,
    MAXIMUM,
    TARGET,
    Puppet,
    ScriptedPolicy,
    episode,
    fake,
    ground,
    run,
    scene,
    short_suite,
    to_the_end,
)

REFERENCE, OWN = "robogauge-1.1", "gaitgauge-1"
PARTS = {DIAGONAL: 8, MAXIMUM: 6}


def rules_of(name, suite=None):
    suite = suite or load_suite(name)
    return SegmentRules(suite, Schedule(suite, torch.device("cpu"), torch.float64))


# ---- assembly, against playing in a row ------------------------------------------------------------------------------


def tale(chance, falls, penetrations):
    """What would happen in every sub-command, in a first attempt and in a second one."""
    told = {}
    for goal, parts in PARTS.items():
        for part in range(parts):
            for again in (False, True):
                length = chance.randrange(4, 9)
                told[goal, part, again] = {
                    "steps": length,
                    "fell": chance.random() < falls,
                    "deep": chance.randrange(1, length) if chance.random() < penetrations else None,
                    "overflow": chance.randrange(length) if chance.random() < 0.1 else None,
                }
    return told


def in_a_row(told, goals, closes, restarts):
    """Goal after goal, part after part; a step has one sample, which says where it belongs."""
    samples, fallen, restarted, overflowed = [], [], False, False
    for number, goal in enumerate(goals):
        part, again = 0, False
        while part < PARTS[goal]:
            told_now = told[goal, part, again]
            length, interrupted = told_now["steps"], False
            if restarts and not restarted and told_now["deep"] is not None:
                length, interrupted = told_now["deep"], True
            samples += [(number, part, again, step) for step in range(length)]
            overflowed |= told_now["overflow"] is not None and told_now["overflow"] < length
            if interrupted:
                restarted, again, part = True, True, 0
                continue
            fallen += [(number, part)] * told_now["fell"]
            if told_now["fell"] and closes:
                break
            part += 1
    return samples, tuple(fallen), restarted, overflowed


def outcome_of(told, segment, restarts):
    it = told[segment.goal, segment.sub_command, segment.again]
    rows = [(segment.goal_index, segment.sub_command, segment.again, step) for step in range(it["steps"])]
    samples = np.asarray(rows, dtype=np.float32)
    whole = SegmentOutcome(
        samples=samples,
        touching=samples[:, 3] % 2 == 0,
        control_steps=it["steps"],
        physics_steps=10 * it["steps"],
        falls=int(it["fell"]),
        diverged=it["fell"],
        overflowed=it["overflow"] is not None,
    )
    deep = it["deep"]
    if not restarts or deep is None or segment.again:
        return whole
    early = it["overflow"] is not None and it["overflow"] < deep
    cut = replace(
        whole,
        samples=whole.samples[:deep],
        touching=whole.touching[:deep],
        control_steps=deep,
        physics_steps=10 * deep,
        overflowed=early,
        falls=0,
        diverged=False,
        restarted=True,
    )
    return replace(whole, until_penetration=cut)


@pytest.mark.parametrize("name", [REFERENCE, OWN])
@pytest.mark.parametrize(("falls", "penetrations"), [(0.0, 0.0), (0.1, 0.0), (0.0, 0.15), (0.15, 0.15), (0.6, 0.6)])
def test_any_order_of_completion_gives_what_playing_in_a_row_gives(name, falls, penetrations):
    chance, rules = random.Random(f"{name} {falls} {penetrations}"), rules_of(name)
    restarts = closes = name == REFERENCE
    for _ in range(30):
        goals = chance.choice([(DIAGONAL, MAXIMUM), (MAXIMUM,), (DIAGONAL,)])
        told = tale(chance, falls, penetrations)
        samples, fallen, restarted, overflowed = in_a_row(told, goals, closes, restarts)
        opened = OpenEpisode(episode(*goals), rules)
        playing = opened.start()
        assert len(playing) == sum(PARTS[g] for g in goals)
        played = 0
        while playing:
            segment = playing.pop(chance.randrange(len(playing)))
            opened.outcomes[segment] = outcome_of(told, segment, restarts)
            played += 1
            playing += opened.start()
            needed = opened.missing()
            playing = [s for s in playing if s in needed]
            assert set(playing) == needed
        record = opened.record(("goal", "part", "again", "step"))
        assert [tuple(row) for row in record.samples.astype(int).tolist()] == samples
        assert record.goal_index.tolist() == [s[0] for s in samples]
        assert record.part_index.tolist() == [s[1] for s in samples]
        assert record.touching.tolist() == [s[3] % 2 == 0 for s in samples]
        assert (record.fallen, record.restarted, record.overflowed) == (fallen, restarted, overflowed)
        assert record.falls == len(fallen)
        assert record.diverged == (len(fallen) > 0)
        assert (record.control_steps, record.physics_steps) == (len(samples), 10 * len(samples))
        assert record.success is None
        assert played <= 2 * sum(PARTS[g] for g in goals)


def test_a_target_goal_waits_for_what_comes_before_it_and_has_no_second_penetration():
    rules = rules_of(REFERENCE)
    for deep in (None, 2):
        opened = OpenEpisode(episode(MAXIMUM, TARGET), rules)
        waiting = opened.start()
        assert {s.goal for s in waiting} == {MAXIMUM}
        told = {
            (MAXIMUM, part, again): {"steps": 4, "fell": False, "deep": deep, "overflow": None}
            for part in range(6)
            for again in (False, True)
        }
        while waiting[0].goal != TARGET:
            opened.outcomes[waiting[0]] = outcome_of(told, waiting[0], True)
            waiting = [s for s in waiting[1:] + opened.start() if s in opened.missing()]
        assert waiting[0].again is (deep is not None)
        zeros = np.zeros((1, 4), dtype=np.float32)
        opened.outcomes[waiting[0]] = SegmentOutcome(
            samples=zeros, touching=zeros[:, 0] > 0, control_steps=1, physics_steps=10, reached=True
        )
        record = opened.record(("a", "b", "c", "d"))
        assert record.success is True
        assert record.restarted is (deep is not None)
        assert record.goal_index.tolist()[-1] == 1


# ---- noise ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [REFERENCE, OWN])
def test_no_two_segments_share_a_draw(name):
    rules = rules_of(name)
    for goals in ((DIAGONAL, MAXIMUM), (MAXIMUM,), (DIAGONAL, MAXIMUM, TARGET)):
        walk = episode(*goals)
        segments = [
            s
            for again in (False, True)
            for i, g in enumerate(goals)
            for s in rules.segments(walk, i, again=again)
            if not (again and g == TARGET)
        ]
        spans = sorted((rules.noise_start(s), rules.noise_start(s) + rules.most_steps(s)) for s in segments)
        assert len(segments) == 2 * sum(PARTS[g] for g in goals if g != TARGET) + (TARGET in goals)
        assert rules.noise_start(segments[0]) == 0
        assert all(end <= begin for (_, end), (begin, _) in pairwise(spans))
        # the longest settling, then the longest sub-command, in control steps of 20 ms
        assert all(end - begin >= 151 + 350 for begin, end in spans)
    assert rules.noise_start(Segment(episode=episode(TARGET), goal=TARGET, goal_index=0, sub_command=0)) == 0


# ---- the rollout ------------------------------------------------------------------------------------------------------

SIGNS = {  # commanded directions of first phases that no other sub-command has at that time
    "diagonal 1": (-1, 1, 0),
    "diagonal 3": (1, -1, 0),
    "diagonal 4": (1, 1, 0),
    "maximum 4": (0, 0, -1),
    "target": (1, 0, 0),
}


class Stage(Puppet):
    """Tells by the joints' targets what is commanded; falls and penetrations happen at given substeps since the reset.

    Substep 1 hangs limp, 2 to 5 are two control steps of settling, 6 to 15 the first phase, 16 to 25 the second; the reference
    samples at 5, 10, … 25.
    """

    def __init__(self, scene, falls, penetrations):
        self.falls, self.penetrations = falls, penetrations
        super().__init__(scene)

    def _watch(self, mask, substep):
        state = self._state
        since, asked = self._substeps_since_reset, (self.targets - self.default_pose)[:, :3]
        for events, first in ((self.falls, state.tilt_substep), (self.penetrations, state.penetration_substep)):
            for name, when in events.items():
                now = mask & (since == when)
                if bool(now.any()):
                    here = (torch.sign(torch.round(asked, decimals=3)) == torch.tensor(SIGNS[name])).all(1)
                    first[now & here & (first == 0)] = substep


def stage(name, worlds, falls, penetrations, count=1, *, poll_interval=None):
    """Records of both goals and of a crossing, for one seed or several; a ``poll_interval`` is for GPUs, where a poll waits."""
    suite = short_suite(name)

    def act(observation):
        action = torch.zeros(len(observation), 12)
        action[:, :3] = observation[:, 6:9]
        return action

    walks = [episode(DIAGONAL, MAXIMUM, seed=seed) for seed in range(count)]
    crossings = [episode(TARGET, stage="search", seed=seed) for seed in range(count)]
    backend = Stage(scene(suite, worlds, ground((5.0, 0.0, 0.4))), falls, penetrations)
    records = run(suite, backend, [*walks, *crossings], ScriptedPolicy(act), poll_interval=poll_interval)
    return sorted(records, key=lambda r: (r.episode.stage, r.episode.seed))


def counts(record):
    """Samples of each sub-command of both goals."""
    return [
        [int(((record.goal_index == goal) & (record.part_index == part)).sum()) for part in range(parts)]
        for goal, parts in enumerate(PARTS.values())
    ]


WHOLE = [[5] * 7 + [4], [5] * 5 + [4]]  # the goal's clock ends the last sub-command a step early
STEPS, SUBSTEPS = 12, 25


@pytest.mark.parametrize("worlds", [7, pytest.param(24, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("falls", "penetrations", "samples", "fell", "restarted", "steps", "substeps"),
    [
        ({}, {}, WHOLE, 0, False, 14 * STEPS - 2, 14 * SUBSTEPS - 4),
        # a fall at substep 10, in the fifth control step: its sample counts, the rest of the goal does not exist
        (
            {"diagonal 1": 10},
            {},
            [[5, 2, 0, 0, 0, 0, 0, 0], WHOLE[1]],
            1,
            False,
            STEPS + 5 + 6 * STEPS - 1,
            SUBSTEPS + 10 + 6 * SUBSTEPS - 2,
        ),
        # a penetration at substep 12, in the sixth control step: the goal starts again and does not mind the next one
        (
            {},
            {"diagonal 1": 12, "maximum 4": 12},
            [[10, 7, *WHOLE[0][2:]], WHOLE[1]],
            0,
            True,
            STEPS + 6 + 14 * STEPS - 2,
            SUBSTEPS + 12 + 14 * SUBSTEPS - 4,
        ),
        # the penetration that a fall hides does not count, so that of the other goal does
        (
            {"diagonal 1": 10},
            {"diagonal 4": 12, "maximum 4": 8},
            [[5, 2, 0, 0, 0, 0, 0, 0], [10, 10, 10, 10, 6, 4]],
            1,
            True,
            STEPS + 5 + 4 * STEPS + 4 + 6 * STEPS - 1,
            SUBSTEPS + 10 + 4 * SUBSTEPS + 8 + 6 * SUBSTEPS - 2,
        ),
        # a fall after a penetration is not reached at first, but in the second attempt
        (
            {"diagonal 3": 12},
            {"diagonal 3": 8},
            [[10, 10, 10, 3, 0, 0, 0, 0], WHOLE[1]],
            1,
            True,
            3 * STEPS + 4 + 3 * STEPS + 6 + 6 * STEPS - 1,
            3 * SUBSTEPS + 8 + 3 * SUBSTEPS + 12 + 6 * SUBSTEPS - 2,
        ),
        # the fall comes first within a control step, and in the same substep
        *[
            (
                {"diagonal 3": 8},
                {"diagonal 3": late},
                [[5, 5, 5, 1, 0, 0, 0, 0], WHOLE[1]],
                1,
                False,
                3 * STEPS + 4 + 6 * STEPS - 1,
                3 * SUBSTEPS + 8 + 6 * SUBSTEPS - 2,
            )
            for late in (8, 9)
        ],
        # the penetration comes first within a control step
        (
            {"diagonal 3": 9},
            {"diagonal 3": 8},
            [[10, 10, 10, 2, 0, 0, 0, 0], WHOLE[1]],
            1,
            True,
            3 * STEPS + 4 + 3 * STEPS + 4 + 6 * STEPS - 1,
            3 * SUBSTEPS + 8 + 3 * SUBSTEPS + 9 + 6 * SUBSTEPS - 2,
        ),
    ],
)
def test_falls_and_penetrations_of_the_reference(
    worlds, falls, penetrations, samples, fell, restarted, steps, substeps
):
    record = stage(REFERENCE, worlds, falls, penetrations)[0]
    assert counts(record) == samples
    assert (record.falls, record.restarted) == (fell, restarted)
    assert (record.control_steps, record.physics_steps) == (steps, substeps)


@pytest.mark.parametrize(("substep", "samples"), [(9, 1), (10, 2), (11, 2)])
def test_a_sample_counts_up_to_the_penetration(substep, samples):
    """The control step has substeps 10 and 11; its sample falls on the first or, with the penetration at 10, on the same."""
    record = stage(REFERENCE, 7, {}, {"diagonal 1": substep})[0]
    assert counts(record)[0][1] == samples + 5


def test_the_samples_of_a_second_attempt_follow_those_of_the_first():
    record = stage(REFERENCE, 7, {}, {"diagonal 1": 12})[0]
    assert record.goal_index.tolist() == [0] * (7 + 39) + [1] * 29
    parts = [*[0] * 5, 1, 1, *(p for p, n in enumerate(WHOLE[0]) for _ in range(n))]
    assert record.part_index.tolist() == parts + [p for p, n in enumerate(WHOLE[1]) for _ in range(n)]


@pytest.mark.parametrize("worlds", [1, 24])
def test_a_fall_in_the_own_suite_costs_its_own_sub_command(worlds):
    """Samples fall on 6, 11, 16 and 21; penetrations are no events."""
    record = stage(OWN, worlds, {"diagonal 1": 12}, {"diagonal 4": 12})[0]
    assert counts(record) == [[4] * 8, [4] * 6]
    assert (record.falls, record.restarted) == (1, False)
    lost = [not record.samples[i].any() for i in range(len(record.samples))]
    assert [i for i, zero in enumerate(lost) if zero] == [4 + 2, 4 + 3]
    assert record.control_steps == 13 * STEPS + 6


@pytest.mark.parametrize(("name", "restarted", "steps"), [(REFERENCE, True, 7 + 12), (OWN, False, 12)])
def test_a_crossing_starts_again_where_it_is(name, restarted, steps):
    """Substep 14 lies in the seventh control step, 24 in the twelfth; the second penetration has no effect."""
    record = stage(name, 7, {"target": 24}, {"target": 14})[-1]
    assert record.episode.stage == "search"
    assert (record.falls, record.restarted, record.success) == (1, restarted, False)
    assert (record.control_steps, record.physics_steps) == (steps, (14 if restarted else 0) + 24)


EVENTS = [
    ({}, {}),
    ({"maximum 4": 12}, {"diagonal 4": 9}),
    ({"diagonal 1": 12, "target": 24}, {"diagonal 4": 9, "maximum 4": 9, "target": 14}),
]


def assert_equal(records, others):
    assert len(records) == len(others)
    for one, other in zip(records, others, strict=True):
        assert one.summary() == other.summary()
        for field in ("samples", "goal_index", "part_index"):
            assert getattr(one, field).tobytes() == getattr(other, field).tobytes()


CASES = [
    pytest.param((name, events), marks=() if any(events) else pytest.mark.slow)
    for name in (REFERENCE, OWN)
    for events in EVENTS
]


@pytest.fixture(scope="module", params=CASES)
def alone(request):
    """Suite, events, and the records of one world after the other."""
    name, events = request.param
    records = stage(name, 1, *events, count=2)
    assert len(records) == 4
    return name, events, records


@pytest.mark.parametrize("worlds", [7, pytest.param(40, marks=pytest.mark.slow)])
def test_worlds_and_neighbours_change_no_bit_of_a_record(alone, worlds):
    name, events, records = alone
    assert_equal(records, stage(name, worlds, *events, count=2))


@pytest.mark.parametrize("poll_interval", [pytest.param(2, marks=pytest.mark.slow), 10])
def test_the_poll_interval_changes_no_bit_of_a_record(alone, poll_interval):
    """On a GPU reading a value would wait for the device: everything is worked out for every world, and those that end wait."""
    name, events, records = alone
    assert_equal(records, stage(name, 9, *events, count=2, poll_interval=poll_interval))


@pytest.mark.parametrize("poll_interval", [1, 3, 10])
def test_crossings_alone_take_no_samples(poll_interval):
    """A search has no quality episodes, so that the table of samples stays empty."""
    suite = short_suite(REFERENCE)
    backend = fake(suite, worlds=3, terrain=ground((5.0, 0.0, 0.4)))
    crossings = [episode(TARGET, stage="search", seed=seed) for seed in range(4)]
    records = run(suite, backend, crossings, poll_interval=poll_interval)
    assert [(r.success, len(r.samples)) for r in records] == [(False, 0)] * 4


def test_segments_wait_for_free_worlds_and_what_is_finished_is_handed_over_at_once():
    """Thirty segments in four worlds, twelve control steps each."""
    suite = short_suite(OWN)
    rollout = Rollout(suite, ScriptedPolicy(), fake(suite, worlds=4), lambda e: 0)
    assert (rollout.idle, rollout.room) == (True, 4)
    walks = [episode(MAXIMUM, seed=seed) for seed in range(5)]
    rollout.play(walks[:2])
    assert (rollout.idle, rollout.room) == (False, 4 - 2 * 6)
    rollout.play(walks[2:])
    ended, most = [], []
    while not rollout.idle:
        ended += [(r.episode.seed, rollout.control_steps) for r in rollout.advance()]
        active = rollout.at_work()
        assert all(0 <= at.spent <= at.steps <= 6 * STEPS for at in active.values())
        most.append(len(active))
    # six segments an episode, four at a time
    assert ended == [(0, 2 * STEPS), (1, 3 * STEPS), (2, 5 * STEPS), (3, 6 * STEPS), (4, 8 * STEPS)]
    assert max(most) == 2


def test_level_tests_go_before_waiting_segments():
    suite = short_suite(OWN)
    backend = fake(suite, worlds=2, terrain=ground((9.0, 0.0, 0.4)))
    rollout = Rollout(suite, ScriptedPolicy(), backend, lambda e: 0)
    rollout.play([episode(DIAGONAL, MAXIMUM)])
    for _ in range(5):  # in the first of seven rounds of two segments
        rollout.advance()
    crossing = episode(TARGET, stage="search")
    rollout.play([crossing])
    while crossing not in rollout.at_work() or not rollout.at_work()[crossing].steps:
        rollout.advance()
    assert rollout.control_steps == STEPS + 1
    assert [r.episode.stage for r in to_the_end(rollout)] == ["search", "eval"]


@pytest.mark.parametrize("poll_interval", [1, 3, 10])
def test_cancelled_episodes_leave_their_worlds(poll_interval):
    """The first to end makes another needless, of which some segments are at work and others wait; the last one goes on."""
    suite = short_suite(OWN)
    short, long, last = episode(MAXIMUM, seed=0), episode(DIAGONAL, MAXIMUM, seed=1), episode(DIAGONAL, seed=3)
    backend = fake(suite, worlds=8)
    rollout = Rollout(suite, ScriptedPolicy(), backend, lambda e: 0, poll_interval=poll_interval)
    rollout.play([short, long, last])
    (first,) = next(records for records in iter(rollout.advance, None) if records)
    assert first.episode == short
    assert rollout.advance() == []
    assert long in rollout.at_work()
    rollout.drop([long])
    assert long not in rollout.at_work()
    (record,) = to_the_end(rollout)
    assert record.episode == last
    (alone,) = run(suite, fake(suite, worlds=8), [last])
    np.testing.assert_array_equal(record.samples, alone.samples)
