"""How long an evaluation still takes: quality episodes walk for minutes, level tests for seconds."""

import pytest
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.plan import Plan
from gaitgauge.gauge.play.progress import ProgressMeter
from gaitgauge.gauge.suite import load_suite

SUITE = load_suite("robogauge-1.1")
TEST_STEPS = (0.4 * 30.0 + 0.1) / 0.02
QUALITY_STEPS = (8 * (6.0 + 0.1) + 6 * (7.0 + 0.1)) / 0.02
"""Eight diagonals of 3 s and 3 s, six single axes of 5 s and 2 s, each with the shortest settling."""


def episode(stage, seed):
    goals = ("target_pos_velocity",) if stage == "search" else ("diagonal_velocity", "max_velocity")
    return Episode(terrain="wave", level=3, friction=0.6, payload=0.0, seed=seed, stage=stage, goals=goals)


TESTS, QUALITY = [episode("search", s) for s in range(5)], [episode("eval", s) for s in range(3)]


def found(required, possible=None):
    return Plan(level=3, counted=(*TESTS, *QUALITY), required=tuple(required), possible=possible or {})


def test_an_episode_counts_as_long_as_it_usually_takes():
    meter = ProgressMeter(SUITE, 0.0)
    assert meter.usual_steps(TESTS[0]) == pytest.approx(TEST_STEPS)
    assert meter.usual_steps(QUALITY[0]) == pytest.approx(QUALITY_STEPS)


def test_what_is_left_is_told_by_the_work_and_not_by_the_number_of_episodes():
    meter = ProgressMeter(SUITE, began=0.0)
    start = meter.look([found((*TESTS, *QUALITY))], {}, now=0.0)
    assert (start.remaining_work, start.seconds_left) == (1.0, None)
    # all level tests have ended, after 10 s; no quality episode has
    status = meter.look([found(QUALITY)], {}, now=10.0)
    assert (status.done, status.expected) == (5, 8)
    assert status.seconds_left == pytest.approx(10.0 * 3 * QUALITY_STEPS / (5 * TEST_STEPS))
    assert status.remaining_work == pytest.approx(3 * QUALITY_STEPS / (3 * QUALITY_STEPS + 5 * TEST_STEPS))


def test_episodes_at_work_count_as_far_as_they_are():
    meter = ProgressMeter(SUITE, began=0.0)
    meter.look([found(QUALITY)], {}, now=0.0)
    half = {QUALITY[0]: int(QUALITY_STEPS / 2), episode("search", 9): 500}  # the second one is played ahead of time
    status = meter.look([found(QUALITY)], half, now=20.0)
    assert status.seconds_left == pytest.approx(20.0 * 5.0, rel=1e-3)
    assert set(status.active) == set(half)


def test_what_an_earlier_run_did_took_no_time_of_this_one():
    meter = ProgressMeter(SUITE, began=100.0)
    meter.look([found(QUALITY)], {}, now=100.0)
    status = meter.look([found(QUALITY[1:])], {}, now=160.0)
    assert status.seconds_left == pytest.approx(2 * 60.0)
    assert status.done == 6


def test_what_an_earlier_run_played_ahead_took_no_time_of_this_one_either():
    """Its records count from when the search asks for them: the first estimate was a second, of a quarter of an hour."""
    meter = ProgressMeter(SUITE, began=0.0)
    searching = Plan(level=None, counted=tuple(TESTS), required=tuple(TESTS), possible={QUALITY[2]: 1.0})
    meter.look([searching], {}, now=0.0)
    status = meter.look([found(QUALITY[2:])], {}, now=10.0)  # two of three were there
    assert status.done == 7
    assert status.seconds_left == pytest.approx(10.0 * QUALITY_STEPS / (5 * TEST_STEPS))


def test_nothing_is_estimated_from_the_first_moments():
    meter = ProgressMeter(SUITE, began=0.0)
    meter.look([found((*TESTS, *QUALITY))], {}, now=0.0)
    assert meter.look([found(QUALITY)], {}, now=0.5).seconds_left is None
    assert meter.look([found(QUALITY)], {}, now=6.0).seconds_left is not None


def test_episodes_that_may_be_required_count_by_their_probability():
    searching = Plan(level=None, counted=tuple(TESTS), required=tuple(TESTS), possible=dict.fromkeys(QUALITY, 0.4))
    half_done = {TESTS[0]: round(TEST_STEPS / 2)}
    status = ProgressMeter(SUITE, began=0.0).look([searching], half_done, now=1.0)
    assert status.expected == 6
    total = 5 * TEST_STEPS + 1.2 * QUALITY_STEPS
    assert status.remaining_work == pytest.approx(1.0 - 0.5 * TEST_STEPS / total, rel=1e-3)
