"""The loop of episodes on an engine without physics: settling, the grid of samples, and everything that ends something."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.gauge.play import noise
from gaitgauge.policy.base import PolicyError
from gaitgauge_fake_engine import FakeScript
from scripted_gauge import (
    DIAGONAL,
    GO2,
    MAXIMUM,
    TARGET,
    ScriptedPolicy,
    at,
    beginning,
    episode,
    fake,
    ground,
    moving,
    play,
    run,
    short_suite,
    tipping,
)

REFERENCE, OWN = "robogauge-1.1", "gaitgauge-1"
CYCLE = 12  # control steps of a sub-command, two of settling included


def column(record, name):
    return record.samples[:, record.columns.index(name)]


# ---- settling -----------------------------------------------------------------------------------------------------


def first_command(script=None, **settling):
    suite = short_suite()
    commands = beginning(replace(suite, settling=replace(suite.settling, **settling)), script, steps=30)
    return int((commands.abs().sum(1) > 0).nonzero()[0])


def test_a_robot_that_stands_is_commanded_after_a_tenth_of_a_second():
    """0.01 s limp and five steps are the first time after more than 0.1 s; that step still has a zero command."""
    assert first_command(shortest=0.1, longest=3.0) == 6


@pytest.mark.parametrize(("velocity", "settled"), [((0.049, 0, 0), 2), ((0.051, 0, 0), 26), ((0, 0, -0.2), 26)])
def test_a_robot_that_moves_in_any_direction_is_commanded_when_patience_ends(velocity, settled):
    assert first_command(FakeScript(motion=moving(velocity)), shortest=0.02, longest=0.5) == settled


def test_the_last_action_is_forgotten_at_every_reset():
    policy = ScriptedPolicy(lambda o: torch.ones(len(o), 12))
    play(short_suite(), [episode(MAXIMUM)], policy=policy)
    last = torch.stack([o[0, 33:] for o in policy.seen])
    assert (last[::CYCLE] == 0).all()
    assert (last[1:CYCLE] == 1).all()


# ---- samples --------------------------------------------------------------------------------------------------------


def test_the_reference_samples_on_a_grid_that_runs_through_resets():
    suite = short_suite(REFERENCE)
    backend = fake(suite)
    (record,) = run(suite, backend, [episode(MAXIMUM)])
    # every sub-command takes 12 control steps of two substeps and a limp substep, which is offered to nobody
    length = 2 * CYCLE + 1
    numbers = [(resets - 1) * length + since for _, resets, since in backend.sampled]
    # the goal's clock ends the last sub-command one step early
    assert record.physics_steps == 6 * length - 2
    assert numbers == [n for n in range(5, record.physics_steps + 1, 5) if n % length != 1]
    assert len(record.samples) == len(numbers)
    assert record.part_index.tolist() == [(n - 1) // length for n in numbers]


def test_the_own_suite_samples_on_a_grid_that_starts_at_every_reset_and_leaves_settling_out():
    suite = short_suite(OWN)
    suite = replace(suite, settling=replace(suite.settling, shortest=0.1))
    backend = fake(suite)
    (record,) = run(suite, backend, [episode(MAXIMUM)])
    # counted after the limp substep: 2 x 6 of settling, 2 x 10 of the sub-command
    assert backend.sampled == [(0, reset, tick + 1) for reset in range(1, 7) for tick in (5, 10, 15, 20, 25, 30)]
    assert len(record.samples) == 6 * 4
    assert record.part_index.tolist() == [p for p in range(6) for _ in range(4)]
    assert record.control_steps == 6 * 16


def test_samples_of_a_search_are_not_kept():
    records = play(short_suite(), [episode(TARGET, stage="search")], terrain=ground((9.0, 0.0, 0.4)))
    assert len(records[0].samples) == 0
    assert records[0].columns == ()


@pytest.mark.parametrize("name", [REFERENCE, OWN])
def test_a_dense_grid_loses_no_sample(name):
    """A penetration 0.2 s after the reset ends the first try of the reference at substep 20, with ten samples: 2, 4, … 20."""
    suite = short_suite(name)
    suite = replace(suite, metrics=replace(suite.metrics, interval=2))
    backend = fake(suite)
    (quiet,) = run(suite, backend, [episode(MAXIMUM)])
    assert len(quiet.samples) == (len(backend.sampled) if suite.settling.sampled else 6 * 10)
    record = play(suite, [episode(MAXIMUM)], FakeScript(penetration_time=at(0.2)))[0]
    assert len(record.samples) == len(quiet.samples) + (10 if name == REFERENCE else 0)
    for r in (quiet, record):
        assert (column(r, "dof_limits") > 0.9).all()


def test_room_for_samples_grows_with_the_suite():
    """A sample in every control step, through the longest settling, and nearly all of the first sub-command twice."""
    suite = short_suite(REFERENCE, maximum=(0.6, 0.4))
    suite = replace(
        suite,
        metrics=replace(suite.metrics, interval=2),
        settling=replace(suite.settling, longest=1.0),
        commands=replace(suite.commands, clock_offset=0.5),
    )
    script = FakeScript(motion=moving((1.0, 0, 0)), penetration_time=at(2.0))
    record = play(suite, [episode(MAXIMUM)], script)[0]
    # after 50 steps and the limp substep the time is beyond 1 s: 51 steps of settling, then 50
    assert record.control_steps == len(record.samples) == 100 + 6 * (51 + 50)


# ---- falls ----------------------------------------------------------------------------------------------------------


def test_a_fall_closes_the_goal_in_the_reference():
    record = play(short_suite(REFERENCE), [episode(DIAGONAL, MAXIMUM)], FakeScript(motion=tipping(16)))[0]
    assert record.falls == 2
    # the limp substep and 15 more make 8 control steps, the last of them cut short
    assert record.control_steps == 2 * 8
    assert record.physics_steps == 2 * 16
    assert record.goal_index.tolist() == [0] * 3 + [1] * 3
    assert (column(record, "dof_limits") > 0.9).all()


@pytest.mark.parametrize("substep", [2, 5, 6, 11, 16, 25])
def test_a_fall_costs_exactly_the_rest_of_the_sub_command_in_the_own_suite(substep):
    """Substeps since the reset: 1 limp, then 2 x 2 of settling, then 2 x 10 of the sub-command; samples at 6, 11, … 21."""
    record = play(short_suite(OWN), [episode(MAXIMUM)], FakeScript(motion=tipping(substep)))[0]
    earned = sum(sampled <= substep for sampled in (6, 11, 16, 21)) if substep > 5 else 0
    assert record.falls == 6
    assert record.part_index.tolist() == [p for p in range(6) for _ in range(4)]
    scored = column(record, "dof_limits").reshape(6, 4) > 0
    assert (scored == (np.arange(4) < earned)).all()
    assert (record.samples[~scored.ravel()] == 0).all()


@pytest.mark.parametrize(("suite", "falls"), [(REFERENCE, 2), (OWN, 14)])
def test_a_robot_that_falls_whenever_it_settles_ends_its_episode(suite, falls):
    record = play(short_suite(suite), [episode(DIAGONAL, MAXIMUM)], FakeScript(motion=tipping(3)))[0]
    assert record.falls == falls
    if suite == OWN:
        assert len(record.samples) == 8 * 4 + 6 * 4
        assert not record.samples.any()


@pytest.mark.parametrize("suite", [REFERENCE, OWN])
def test_a_fall_on_the_way_to_the_target_is_no_success(suite):
    search = [episode(TARGET, stage="search")]
    record = play(short_suite(suite), search, FakeScript(motion=tipping(20)), terrain=ground((5.0, 0.0, 0.4)))[0]
    assert record.success is False
    assert record.falls == 1


# ---- invalid physics --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suite", "falls"), [(REFERENCE, 1), (OWN, 6)])
def test_a_diverged_world_is_a_fall_and_costs_the_step_in_which_it_happened(suite, falls):
    """Invalid from substep 16 on, on which a sample falls; steps end at 15 and 17."""
    record = play(short_suite(suite), [episode(MAXIMUM)], FakeScript(diverge_time=at(0.16)))[0]
    assert record.diverged
    assert record.falls == falls
    if suite == OWN:
        assert ((column(record, "dof_limits").reshape(6, 4) > 0) == (np.arange(4) < 2)).all()
    else:
        assert len(record.samples) == 3  # of substeps 5, 10 and 15; that of the step that went wrong is none
    assert np.isfinite(column(record, "quality")).all()


@pytest.mark.parametrize("name", [REFERENCE, OWN])
def test_worlds_that_are_invalid_from_the_start_end_as_results(name):
    """Their observations are no numbers: what a policy makes of them is no error of the policy's."""
    policy = ScriptedPolicy(lambda observation: observation[:, 9:21])
    script = FakeScript(diverge_time=at(0.0))
    episodes = [episode(DIAGONAL, MAXIMUM), episode(TARGET, stage="search")]
    records = play(short_suite(name), episodes, script, terrain=ground((5.0, 0.0, 0.4)), policy=policy)
    crossing, walk = records
    assert (crossing.diverged, walk.diverged) == (True, True)
    assert crossing.success is False
    assert not walk.samples.any()
    assert len(walk.samples) == (14 * 4 if name == OWN else 0)


def test_an_overflow_is_recorded_and_interrupts_nothing():
    quiet = play(short_suite(OWN), [episode(MAXIMUM)])[0]
    record = play(short_suite(OWN), [episode(MAXIMUM)], FakeScript(overflow_time=at(0.2)))[0]
    assert record.overflowed
    assert record.falls == 0
    assert np.array_equal(record.samples, quiet.samples, equal_nan=True)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_policy_that_answers_with_no_number_is_an_error(value):
    def act(observation):
        action = torch.zeros(len(observation), 12)
        action[:, 3] = torch.where(observation[:, 6].abs() > 0, value, 0.0)
        return action

    with pytest.raises(
        PolicyError, match=rf"returned {value} for a finite observation at control step 2 of diagonal_velocity"
    ):
        play(short_suite(), [episode(DIAGONAL)], policy=ScriptedPolicy(act))


def test_what_a_policy_answers_for_empty_worlds_does_not_matter():
    def act(observation):
        action = torch.zeros(len(observation), 12)
        action[8:] = math.nan
        return action

    # eight sub-commands side by side
    assert len(play(short_suite(), [episode(DIAGONAL)], worlds=10, policy=ScriptedPolicy(act))) == 1


# ---- penetration ------------------------------------------------------------------------------------------------------


def test_a_penetration_starts_the_goal_again_once_and_keeps_the_samples():
    """0.2 s after a reset, in the tenth control step; and again, without effect, in every later sub-command."""
    suite, policy = short_suite(REFERENCE), ScriptedPolicy()
    record = play(suite, [episode(MAXIMUM)], FakeScript(penetration_time=at(0.2)), policy=policy, worlds=1)[0]
    quiet = play(suite, [episode(MAXIMUM)])[0]
    assert record.restarted
    assert record.falls == 0
    again = record.control_steps - quiet.control_steps
    assert again == 10
    # what had begun is played to its end, what would have followed is not; then come all sub-commands once more
    assert torch.equal(policy.commands()[:CYCLE], policy.commands()[CYCLE : 2 * CYCLE])
    assert len(policy.seen) == CYCLE + quiet.control_steps
    assert (record.part_index == 0).sum() == 4 + (quiet.part_index == 0).sum()


def test_a_penetration_after_the_target_was_reached_takes_the_success_back():
    """The robot walks after the first reset alone, and reaches the target then."""
    suite, spot = short_suite(REFERENCE), ground((0.2, 0.0, GO2.stand_height))

    def motion(backend):
        linear = torch.zeros(backend.num_worlds, 3, dtype=torch.float64)
        linear[:, 0] = backend.resets.le(1) * backend.state.time.ge(0.05)
        return linear, torch.zeros_like(linear)

    script = FakeScript(motion=motion)
    search = [episode(TARGET, stage="search")]
    assert play(suite, search, script, terrain=spot)[0].success is True
    backend = fake(suite, script, terrain=spot)

    def watch(rollout):
        if int(backend.resets[0]) == 2:
            backend.script = replace(script, penetration_time=at(0.02))

    (record,) = run(suite, backend, search, watch=watch)
    assert record.restarted
    assert record.success is False


def test_the_own_suite_knows_no_penetration():
    record = play(short_suite(OWN), [episode(MAXIMUM)], FakeScript(penetration_time=at(0.2)))[0]
    assert not record.restarted


# ---- the target -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suite", "steps"), [(REFERENCE, 2 + 20 + 2), (OWN, 2 + 20)])
def test_time_runs_out_after_its_steps(suite, steps):
    """0.4 s are 20 steps; the reference settles once more before it closes the goal."""
    record = play(short_suite(suite), [episode(TARGET, stage="search")], terrain=ground((5.0, 0.0, 0.4)))[0]
    assert record.success is False
    assert record.control_steps == steps


@pytest.mark.parametrize("name", [REFERENCE, OWN])
def test_the_target_is_reached_within_a_tenth_of_a_metre(name):
    """At 1 m/s from 0.05 s on, 0.2501 m to go but for 0.1: within reach after 16 substeps, which is 8 control steps."""
    suite = short_suite(name)
    search, spot = [episode(TARGET, stage="search")], ground((0.2501, 0.0, GO2.stand_height))
    record = play(suite, search, FakeScript(motion=moving((1.0, 0, 0), since=0.05)), terrain=spot)[0]
    assert record.success is True
    assert record.control_steps == 2 + 8 + (2 if name == REFERENCE else 0)


@pytest.mark.parametrize(("limit", "seen"), [(1.0, 0.8), (0.5, 0.5)])
def test_a_policy_is_asked_for_no_more_than_the_limits(limit, seen):
    """On the way to the target too, where a suite allows less than the way's usual speed."""
    suite = short_suite(OWN)
    suite = replace(suite, commands=replace(suite.commands, levelled=(limit, 1.0, 1.5)))
    suite = replace(suite, commands=replace(suite.commands, target_speed={"slope": 0.8}))
    policy = ScriptedPolicy()
    play(suite, [episode(TARGET, stage="search")], terrain=ground((5.0, 0.0, 0.4)), policy=policy)
    assert policy.commands().amax(0).tolist() == pytest.approx([seen, 0.0, 0.0])


def test_velocity_goals_alone_have_no_success():
    assert play(short_suite(), [episode(MAXIMUM)])[0].success is None


# ---- worlds -------------------------------------------------------------------------------------------------------------


def swaying(backend):
    """A motion that depends on the episode's friction and time alone; the slippery one falls."""
    friction, time = backend.randomized.friction, backend.state.time
    linear = torch.stack((torch.sin(9.0 * friction * time), 0.1 * time, 0.0 * time), dim=1)
    angular = torch.stack((40.0 * (friction < 0.3) * time.ge(0.06), 0.0 * time, friction), dim=1)
    return linear * time.ge(0.05)[:, None], angular


@pytest.mark.parametrize("name", [REFERENCE, OWN])
def test_an_episode_does_not_depend_on_worlds_order_or_neighbours(name):
    suite = short_suite(name, maximum=(0.06, 0.04))
    episodes = [
        episode(MAXIMUM, seed=seed, friction=friction) for seed, friction in [(0, 0.6), (1, 0.2), (0, 0.9), (2, 0.4)]
    ]

    def outcome(order, worlds):
        policy = ScriptedPolicy(lambda o: torch.tanh(o[:, 9:21] + 0.5 * o[:, 21:33] + 0.1 * o[:, 33:45]))
        script = FakeScript(motion=swaying)
        return {r.episode: r for r in play(suite, [episodes[i] for i in order], script, worlds=worlds, policy=policy)}

    alone = outcome([0, 1, 2, 3], 1)
    assert len({r.samples.tobytes() for r in alone.values()}) == 4
    assert alone[episodes[1]].falls > 0
    for order, worlds in [([2, 0, 3, 1], 3)]:
        other = outcome(order, worlds)
        for e, record in alone.items():
            assert record.summary() == other[e].summary()
            for name in ("samples", "goal_index", "part_index"):
                assert getattr(record, name).tobytes() == getattr(other[e], name).tobytes()


def test_an_episode_may_be_longer_than_the_table_of_noise(monkeypatch):
    suite = short_suite()
    policy = ScriptedPolicy()
    play(suite, [episode(MAXIMUM)] * 2, policy=policy, worlds=1)
    monkeypatch.setattr(noise, "TABLE_STEPS", 16)
    short = ScriptedPolicy()
    play(suite, [episode(MAXIMUM)] * 2, policy=short, worlds=1)
    assert len(policy.seen) > 2 * 60
    assert torch.equal(torch.stack(policy.seen), torch.stack(short.seen))
