"""Doing less than is asked never scores more: motions whose score can be written down, by the rules of gaitgauge-1."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from gaitgauge.gauge.episodes import QUALITY, Episode, Record
from gaitgauge.gauge.instants import Instants, SampledState
from gaitgauge.gauge.metric_rules import GO2_LEG, GO2_MASS
from gaitgauge.gauge.metrics import METRICS, motion_done
from gaitgauge.gauge.play.feet import foot_torsion
from gaitgauge.gauge.play.segments import Segment
from gaitgauge.gauge.scoring import run_statistics
from gaitgauge.robots import load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan
from metric_states import OWN, REFERENCE, evaluator
from scripted_gauge import GO2

NAMES = (*OWN.metrics.weights, QUALITY)
EPISODE = Episode(
    terrain="flat",
    level=0,
    friction=0.6,
    payload=0.0,
    seed=0,
    stage="eval",
    goals=("max_velocity", "diagonal_velocity"),
)
LIMITS = torch.tensor([2.0, 1.0, 2.0], dtype=torch.float64)
AXES = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0.5, -1, 0], [0, 0, 0]]).double() * LIMITS
"""Commands: ahead, back, sideways, turning, two at once, and standing."""
STEPS = 8
"""Samples of each command."""


METRICS_OF_GO2 = cache(lambda: evaluator(OWN))


def quality(share, generator):
    """Score a walker that does ``share`` of each command, (T, 1) or (T, 3), on all axes.

    Its economy is drawn, and gets better in proportion as it does less: torque changes, roll and slip with the share, power with
    its square, down to nothing at rest. At full speed every metric has 0.4 at least.
    """
    command = AXES.repeat_interleave(STEPS, 0)
    share = torch.as_tensor(share, dtype=torch.float64) * torch.ones(len(command), 3, dtype=torch.float64)
    effort = share.mean(1) * (command.abs().sum(1) > 0)
    count = len(command)
    worst = torch.tensor(generator.uniform(0.0, 0.6, 6))  # what each economy metric loses at full speed
    velocity = share * command * 0.95
    torque = 100.0 * worst[1] * effort[:, None] ** 2 * torch.ones(count, 12, dtype=torch.float64)
    roll = torch.asin(worst[2] * effort) / 2
    pose = torch.zeros(count, 4, dtype=torch.float64)
    pose[:, 0], pose[:, 1] = torch.cos(roll), torch.sin(roll)
    metrics = METRICS_OF_GO2()
    weight = metrics.constants.weight
    default = torch.tensor(GO2.default_joint_position, dtype=torch.float64)
    state = SampledState(
        {
            "base_quaternion_w": pose,
            "base_linear_velocity_w": _world(pose, velocity),
            "base_angular_velocity_b": torch.cat((torch.zeros(count, 2), velocity[:, 2:]), 1),
            "joint_position": default.expand(count, -1) * (1 + worst[0] * effort[:, None]),
            "joint_torque": torque,
            "joint_velocity": torch.ones(count, 12, dtype=torch.float64),
            "ground_force_w": torch.tensor([[0.0, 0.0, weight]]).double().expand(count, -1),
            "ground_moment_w": torch.stack((worst[4] * effort * weight * 0.5656, 0 * effort, 0 * effort), 1),
            "foot_normal_force": torch.full((count, 4), weight / 4, dtype=torch.float64),
            "foot_tangential_force": 0.6 * worst[5] * effort[:, None] * weight / 4 * torch.ones(1, 4).double(),
        }
    )
    instants = Instants(
        state=state,
        command=command,
        limits=LIMITS.expand(count, -1),
        friction=torch.full((count,), 0.6, dtype=torch.float64),
        torque_before=torque - 30.0 * worst[3] * effort[:, None],
        torque_known=torch.ones(count, dtype=torch.bool),
        constants=metrics.constants,
    )
    keep = torch.ones(count, dtype=torch.bool)
    samples = metrics.with_quality(metrics.evaluate(instants), keep, [count]).numpy()
    assert samples[:, :8].min() >= 0.399 or share.min() < 0.9
    goal = np.arange(count) // STEPS % 2
    record = Record(
        episode=EPISODE,
        columns=NAMES,
        samples=samples,
        goal_index=goal.astype(np.int16),
        part_index=goal.astype(np.int16),
    )
    return run_statistics(record, NAMES.index(QUALITY))


def _world(pose, velocity):
    """Turn forward and lateral velocity by the roll of the base: what the metrics turn back."""
    roll = 2 * torch.atan2(pose[:, 1], pose[:, 0])
    return torch.stack((velocity[:, 0], velocity[:, 1] * torch.cos(roll), velocity[:, 1] * torch.sin(roll)), 1)


@pytest.mark.parametrize("seed", range(8))
def test_a_slower_robot_never_scores_more(seed):
    scores = [quality(share, np.random.default_rng(seed)) for share in np.linspace(1.0, 0.1, 10)]
    assert (np.diff(scores, axis=0) < 0.0).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("seed", range(2))
def test_nor_does_one_that_is_slower_along_one_axis(axis, seed):
    share = np.ones(3)
    scores = []
    for share[axis] in np.linspace(1.0, 0.0, 6):
        scores.append(quality(share, np.random.default_rng(seed)))
    assert (np.diff(scores, axis=0) <= 1e-12).all()
    assert (scores[-1] < scores[0]).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("still", [1, 3])
def test_nor_does_one_that_begins_later_or_stands_between(still, seed):
    """Of the eight samples of each command it stands in the first ones."""
    share = (torch.arange(len(AXES) * STEPS) % STEPS >= still).double()[:, None]
    assert (quality(share, np.random.default_rng(seed)) < quality(1.0, np.random.default_rng(seed))).all()


def test_without_the_factor_a_slower_robot_scores_more():
    """The property that version 1.0.0 lacked: it is the factor that holds it, not the walker that is drawn."""
    whole, slow = (quality(share, np.random.default_rng(3))[0] / (0.95 * share) ** 2 for share in (1.0, 0.7))
    assert slow > whole


def test_the_share_of_a_motion_is_its_part_along_the_command():
    limits = torch.tensor([[2.0, 1.0, 2.0]])
    ask = torch.tensor([[1.0, 0.0, 0.0]])
    for velocity, expected in (((0.5, 0, 0), 0.5), ((1.0, 0.7, 1.0), 1.0), ((-0.2, 0, 0), -0.2), ((1.3, 0, 0), 1.3)):
        assert motion_done(torch.tensor([velocity]), ask, limits).item() == pytest.approx(expected)
    turn = torch.tensor([[9.0, 9.0, -1.7]]), torch.tensor([[0.0, 0.0, -1.0]])
    assert motion_done(*turn, limits).item() == pytest.approx(1.7)
    # as shares of the limits: 0.5 and 1 asked, 0.5 and 0.4 done, (0.25 + 0.4) / 1.25
    both = motion_done(torch.tensor([[1.0, 0.4, 0.0]]), torch.tensor([[1.0, 1.0, 0.0]]), limits)
    assert both.item() == pytest.approx(0.65 / 1.25)
    assert math.isnan(motion_done(torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1, 3), limits).item())


def test_the_quality_of_a_goal_counts_for_the_square_of_the_motion_that_is_done():
    samples = np.zeros((4, len(NAMES)), np.float32)
    samples[:, -1] = 0.8
    samples[:, -2] = [0.5, 1.5, np.nan, np.nan]  # a share above one is one; standing has none
    goals = np.array([0, 0, 0, 1], np.int16)
    record = Record(episode=EPISODE, columns=NAMES, samples=samples, goal_index=goals, part_index=goals)
    # the first goal did three quarters, the second was not asked to move
    assert run_statistics(record, NAMES.index(QUALITY)) == pytest.approx([(0.75**2 * 0.8 + 0.8) / 2] * 3)


# ---- the robot's own measure, and its feet ----------------------------------------------------------------------------


def test_the_go2_has_scale_one_and_a_heavier_robot_larger_scales():
    plan = body_plan(GO2)
    assert (plan.mass, plan.leg_length) == pytest.approx((GO2_MASS, GO2_LEG), rel=1e-3)
    assert evaluator(OWN).constants.scales == pytest.approx((1.0, 1.0, 1.0), rel=1e-3)
    large = load_robot("anymal_c")
    heavier, longer = body_plan(large).mass / GO2_MASS, body_plan(large).leg_length / GO2_LEG
    assert heavier > 2 and longer > 1.2
    expected = (heavier, heavier * longer, heavier * math.sqrt(longer))
    assert evaluator(OWN, large).constants.scales == pytest.approx(expected)
    assert evaluator(REFERENCE, large).constants.scales == (1.0, 1.0, 1.0)


def test_feet_with_and_without_torsion_take_turns():
    """Each of two seeds has half of the sub-commands with either, and the other half with the other."""

    def feet(seed, sub_command, stage="eval", level=3):
        episode = replace(EPISODE, seed=seed, stage=stage, level=level)
        return foot_torsion(OWN, Segment(episode=episode, goal="max_velocity", goal_index=0, sub_command=sub_command))

    for seed in (0, 1):
        assert sorted(feet(seed, part) for part in range(6)) == [0.0] * 3 + [1.0] * 3
    assert all(feet(0, part) != feet(1, part) for part in range(6))
    first = {feet(100, 0, "search", level) for level in range(1, 11)}
    assert first == {0.0, 1.0}, "the first trials of ten levels have one kind of feet"
    assert METRICS["motion_done"].state
