"""Every reward term against a value worked out by hand, and how they are weighted."""

import math
from dataclasses import fields, replace

import pytest
import torch
from gaitgauge.training.configuration import Ramp
from gaitgauge.training.environment.reward_configuration import (
    RewardConfiguration,
    RewardLimits,
    RewardShapes,
    RewardWeights,
)
from gaitgauge.training.environment.rewards import PAID_BY_TILE, REWARD_TERMS, RewardFunction
from gaitgauge.training.environment.step_inputs import FootInputs, StepInputs
from gaitgauge.training.environment.terrain_configuration import FLAT_TILE

FEET = FootInputs(
    contact=torch.ones(2, 4, dtype=torch.bool),
    air_time=torch.zeros(2, 4),
    contact_time=torch.full((2, 4), 0.3),
    clearance=torch.zeros(2, 4),
    tilt=torch.zeros(2, 4),
    apart=torch.full((2,), 0.2),
    swing=torch.zeros(2, 4, dtype=torch.bool),
    wanted_clearance=torch.zeros(2, 4),
)
STEP = torch.tensor([[True, False, False, True], [True] * 4])


@pytest.fixture
def quiet():
    """Two worlds in which nothing happens: every penalty is zero and tracking is perfect."""
    joints = torch.zeros(2, 12)
    return StepInputs(
        base_linear_velocity_b=torch.zeros(2, 3),
        base_angular_velocity_b=torch.zeros(2, 3),
        base_quaternion_w=torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        base_height=torch.full((2,), 0.38),
        command=torch.zeros(2, 3),
        turn_error=torch.zeros(2),
        sigma=torch.full((2, 3), 0.25),
        joint_position=joints,
        joint_velocity=joints,
        joint_acceleration=joints,
        joint_torque=joints,
        previous_joint_torque=joints,
        default_joint_position=torch.zeros(12),
        soft_lower=torch.full((12,), -1.0),
        soft_upper=torch.full((12,), 1.0),
        soft_speed=torch.full((12,), 10.0),
        hip_joints=torch.tensor([0, 3, 6, 9]),
        hip_pairs=torch.tensor([[0, 3], [6, 9]]),
        hip_signs=torch.tensor([-1.0, -1.0]),
        action=joints,
        previous_action=joints,
        second_previous_action=joints,
        foot_height=torch.ones(2, 4),
        foot_velocity_w=torch.zeros(2, 4, 3),
        touching_bodies=torch.zeros(2),
        base_touching=torch.zeros(2),
        upright=torch.ones(2),
        trunk_contact_force_w=torch.zeros(2, 3),
        distance=torch.zeros(2),
        leave_distance=torch.full((2,), math.inf),
        episode_length=torch.ones(2, dtype=torch.int64),
        max_episode_length=1250,
        can_be_stuck=torch.ones(2, dtype=torch.bool),
        shortfall=torch.zeros(2),
        diverged=torch.zeros(2, dtype=torch.bool),
        progress=torch.tensor(0.5),
        heading_xy=torch.tensor([[1.0, 0.0]] * 2),
        commanded_heading_xy=torch.tensor([[1.0, 0.0]] * 2),
        period=0.02,
        state=None,
        failed=torch.zeros(2, dtype=torch.bool),
        base_height_target=0.38,
        foot_height_length=0.0095,
        feet=FEET,
        pose_weight=torch.tensor([2.0, 0.5] * 6),
        least_apart=0.15,
        longest_step=0.4,
        clock_sigma=0.008,
    )


def one_world(values, width):
    """Row 0 holds ``values`` in its first entries, everything else is zero."""
    tensor = torch.zeros(2, width)
    tensor[0, : len(values)] = torch.tensor(values)
    return tensor


def joints(*values):
    return one_world(values, 12)


def at(index, *values):
    tensor = torch.zeros(2, 12)
    tensor[0, list(index)] = torch.tensor(values)
    return tensor


def feet(speeds):
    tensor = torch.zeros(2, 4, 3)
    tensor[0] = torch.tensor(speeds)
    return tensor


HEIGHTS = torch.tensor([[0.0095, 0.0, -0.3, 5.0], [1.0] * 4])

CASES = {
    "linear_tracking": (
        {
            "command": one_world([1.0, -0.5, 9.0], 3),
            "base_linear_velocity_b": one_world([0.5, 0.0, 9.0], 3),
            "sigma": torch.tensor([[0.25, 0.5, 1.0], [0.25] * 3]),
        },
        math.exp(-(0.25 / 0.25 + 0.25 / 0.5)),
        1.0,
    ),
    "yaw_tracking": (
        {
            "command": one_world([9.0, 9.0, 1.0], 3),
            "base_angular_velocity_b": one_world([9.0, 9.0, 0.4], 3),
            "sigma": torch.tensor([[1.0, 1.0, 0.36], [0.25] * 3]),
        },
        math.exp(-1.0),
        1.0,
    ),
    "turn_error": (
        {"command": one_world([0.0, 0.05, -1.0], 3), "turn_error": torch.tensor([-0.6, 9.0])},
        0.6,
        0.0,
    ),
    "progress": (
        {"command": one_world([0.6, -0.8, 9.0], 3), "base_linear_velocity_b": one_world([0.5, 0.0, 9.0], 3)},
        0.3,
        0.0,
    ),
    "vertical_velocity": ({"base_linear_velocity_b": one_world([9.0, 9.0, -0.5], 3)}, 0.25, 0.0),
    "roll_pitch_rate": ({"base_angular_velocity_b": one_world([1.0, -2.0, 9.0], 3)}, 5.0, 0.0),
    "joint_acceleration": ({"joint_acceleration": joints(3.0, -4.0)}, 25.0, 0.0),
    "joint_power": ({"joint_torque": joints(2.0, -3.0), "joint_velocity": joints(-5.0, -1.0)}, 13.0, 0.0),
    "torque": ({"joint_torque": joints(2.0, -3.0)}, 13.0, 0.0),
    "base_height": ({"base_height": torch.tensor([0.28, 0.38])}, 0.01, 0.0),
    "action_rate": ({"action": joints(1.0, 1.0), "previous_action": joints(0.0, 3.0)}, 5.0, 0.0),
    "action_smoothness": (
        {"action": joints(1.0, 2.0), "previous_action": joints(2.0, 1.0), "second_previous_action": joints(5.0, 0.0)},
        4.0,
        0.0,
    ),
    "collision": ({"touching_bodies": torch.tensor([3.0, 0.0])}, 3.0, 0.0),
    "base_collision": ({"base_touching": torch.tensor([1.0, 0.0])}, 1.0, 0.0),
    "joint_limits": ({"joint_position": joints(1.25, -1.5, 0.9)}, 0.75, 0.0),
    "joint_speed_limits": ({"joint_velocity": joints(11.0, -12.5, 9.9)}, 3.5, 0.0),
    "foot_regulation": (
        {
            "foot_velocity_w": feet([[1.0, 1.0, 9.0], [3.0, 0.0, 0.0], [0.0, 2.0, 0.0], [9.0, 0.0, 0.0]]),
            "foot_height": HEIGHTS,
        },
        2.0 * math.exp(-1.0) + 9.0 + 4.0,
        0.0,
    ),
    "hip_regulation": ({"joint_position": at((0, 3, 4, 9), 0.2, -0.3, 5.0, 0.1)}, 0.6, 0.0),
    "hip_symmetry": (
        {"joint_position": at((0, 3, 6, 9), 0.2, -0.3, 0.1, 0.1), "command": one_world([-3.0, 0.0, 4.0], 3)},
        0.6 * 0.3,
        0.0,
    ),
    "roll": ({"base_quaternion_w": one_world([0.8, 0.6, 0.0, 0.0], 4)}, 0.96**2, 0.0),
    # the other world's episode has just begun: no torque is known before its first
    "torque_change": (
        {"joint_torque": joints(2.0, 1.0) + torch.tensor([[0.0], [3.0]]), "previous_joint_torque": joints(0.0, 4.0)},
        13.0,
        0.0,
    ),
    "stand_still": ({"joint_position": joints(0.5, -0.25)}, 0.75, 0.0),
    "termination": ({"failed": torch.tensor([True, False])}, 1.0, 0.0),
    "alive": ({"failed": torch.tensor([True, False])}, 0.0, 1.0),
    "orientation": ({"base_quaternion_w": one_world([0.8, 0.0, 0.6, 0.0], 4)}, 0.96**2, 0.0),
    "pose": ({"joint_position": joints(0.2, -0.3)}, 2.0 * 0.04 + 0.5 * 0.09, 0.0),
    "foot_tilt": ({"feet": replace(FEET, tilt=torch.tensor([[0.1, 0.2, 0.0, 0.0], [0.0] * 4]))}, 0.3, 0.0),
    "foot_slip": (
        {
            "feet": replace(FEET, contact=STEP),
            "foot_velocity_w": feet([[1.0, 2.0, 9.0], [3.0, 3.0, 3.0], [0.0] * 3, [0.0, 1.0, 0.0]]),
        },
        6.0,
        0.0,
    ),
    "feet_apart": ({"feet": replace(FEET, apart=torch.tensor([0.05, 0.2]))}, 0.1, 0.0),
    "air_time": (
        {
            "feet": replace(FEET, contact=STEP, air_time=torch.tensor([[0.0, 0.25, 0.9, 0.0], [0.0] * 4])),
            "command": torch.tensor([[0.0, 0.0, 0.5]] * 2),
        },
        0.25,
        0.0,
    ),
    "clock_height": (
        {"feet": replace(FEET, clearance=one_world([0.05, 0.0], 4), wanted_clearance=one_world([0.09, 0.04], 4))},
        math.exp(-0.0032 / 0.008),
        1.0,
    ),
    "clock_contact": (
        {"feet": replace(FEET, contact=STEP, swing=torch.tensor([[False, True, False, True], [False] * 4]))},
        0.5,
        1.0,
    ),
}


def test_every_term_has_a_case():
    assert set(CASES) == set(REWARD_TERMS)


@pytest.mark.parametrize("name", CASES)
def test_term(quiet, name):
    changes, expected, undisturbed = CASES[name]
    value = REWARD_TERMS[name](replace(quiet, **changes))
    assert value.tolist() == pytest.approx([expected, undisturbed], rel=1e-5, abs=1e-6)


def test_stand_still_counts_under_the_zero_command_only(quiet):
    moved = replace(quiet, joint_position=joints(0.5), command=one_world([0.0, 0.0, 0.1], 3))
    assert REWARD_TERMS["stand_still"](moved).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("contact", "command", "expected"),
    [([True] * 4, 0.5, 0.0), ([False] * 4, 0.5, 0.0), (STEP[0].tolist(), 0.05, 0.0), (STEP[0].tolist(), 0.5, 0.4)],
)
def test_only_steps_under_a_command_are_paid_and_no_longer_than_the_longest(quiet, contact, command, expected):
    feet = replace(
        FEET,
        contact=torch.tensor([contact] * 2),
        air_time=torch.full((2, 4), 0.9),
        contact_time=torch.full((2, 4), 0.9),
    )
    inputs = replace(quiet, feet=feet, command=one_world([command], 3))
    assert float(REWARD_TERMS["air_time"](inputs)[0]) == pytest.approx(expected)


def test_weights_are_per_second_but_for_falls(quiet):
    settings = RewardConfiguration(termination=-5.0)
    rewards = RewardFunction(settings, 0.02, torch.zeros(2, dtype=torch.int64), [FLAT_TILE])
    inputs = replace(quiet, failed=torch.tensor([True, False]), base_height=torch.tensor([0.48, 0.38]))
    values = dict(zip(rewards.names, rewards(inputs, torch.tensor(0.0))[0].tolist(), strict=True))
    assert values["linear_tracking"] == pytest.approx(0.02)
    assert values["termination"] == pytest.approx(-5.0)
    assert values["base_height"] == pytest.approx(-1.0 * 0.01 * 0.02, rel=1e-4)
    assert "hip_symmetry" not in values, "terms without weight are not computed"


def test_weights_follow_progress(quiet):
    settings = RewardConfiguration(vertical_velocity=Ramp(start=-2.0, end=0.0, begin=0.25, until=0.75))
    rewards = RewardFunction(settings, 1.0, torch.zeros(2, dtype=torch.int64), [FLAT_TILE])
    inputs = replace(quiet, base_linear_velocity_b=one_world([0.0, 0.0, 1.0], 3))
    column = rewards.names.index("vertical_velocity")
    found = [float(rewards(inputs, torch.tensor(p))[0, column]) for p in (0.0, 0.25, 0.5, 0.75, 2.0)]
    assert found == pytest.approx([-2.0, -2.0, -1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("command", "error", "expected"),
    [
        ([0.0, 0.0, 1.0], 0.6, 0.6),
        ([0.0, 0.0, 1.0], -0.6, 0.6),
        ([0.0, 0.05, -2.0], -2.0, 1.0),
        ([0.0, 0.0, 0.1], 0.5, 0.0),
        ([0.5, 0.0, 1.0], 0.6, 0.0),
    ],
)
def test_the_error_of_turns_on_the_spot_counts_alike_below_and_above(quiet, command, error, expected):
    turning = replace(quiet, command=one_world(command, 3), turn_error=torch.tensor([error, 0.0]))
    assert float(REWARD_TERMS["turn_error"](turning)[0]) == pytest.approx(expected)


def test_a_tile_pays_by_its_factors(quiet):
    factors = dict(zip(PAID_BY_TILE, (0.5, 1.5, 0.0, 4.0, 2.0), strict=True))
    settings = replace(RewardConfiguration(), **dict.fromkeys(factors, 1.0))
    rewards = RewardFunction(settings, 1.0, torch.tensor([0, 1]), [FLAT_TILE, replace(FLAT_TILE, **factors)])
    ahead = replace(
        quiet,
        command=torch.tensor([[1.0, 0.0, 0.0]] * 2),
        base_linear_velocity_b=torch.tensor([[1.0, 0.0, 2.0]] * 2),
        base_angular_velocity_b=torch.tensor([[1.0, 2.0, 0.0]] * 2),
    )
    paid = dict(zip(rewards.names, rewards(ahead, torch.tensor(0.0)).T.tolist(), strict=True))
    for (name, factor), plain in zip(factors.items(), (1.0, 1.0, 1.0, 4.0, 5.0), strict=True):
        assert paid[name] == [plain, plain * factor]


def test_every_weight_names_a_term():
    assert {f.name for f in fields(RewardWeights)} - {"own"} == set(REWARD_TERMS)
    parts = [{f.name for f in fields(part)} for part in (RewardWeights, RewardShapes, RewardLimits)]
    assert {f.name for f in fields(RewardConfiguration)} == set.union(*parts) and sum(map(len, parts)) == 51


@pytest.mark.parametrize(
    ("command", "velocity", "expected"),
    [
        ([0.5, 0.0], [2.0, 0.0], 1.0),
        ([0.5, 0.0], [-2.0, 0.0], -1.0),
        ([0.5, 0.0], [0.0, 1.0], 0.0),
        ([0.0, -1.0], [0.3, -0.25], 0.25),
        ([0.05, 0.05], [1.0, 1.0], 0.0),
    ],
)
def test_progress_is_the_share_of_the_commanded_speed(quiet, command, velocity, expected):
    inputs = replace(quiet, command=one_world(command, 3), base_linear_velocity_b=one_world(velocity, 3))
    assert float(REWARD_TERMS["progress"](inputs)[0]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("turned", "velocity", "expected"),
    [
        (0.0, [0.5, 0.0], 1.0),
        (math.pi / 2, [0.5, 0.0], 0.0),
        (math.pi / 2, [0.0, -0.5], 1.0),
        (math.pi, [0.5, 0.0], -1.0),
        (-math.pi / 3, [0.5, 0.0], 0.5),
    ],
)
@pytest.mark.parametrize("wanted", [0.0, 2.0])
def test_who_turns_away_makes_no_progress(quiet, turned, velocity, expected, wanted):
    """A robot commanded straight ahead at 0.5 m/s whose heading is ``turned`` from the commanded one, whichever that is."""
    inputs = replace(
        quiet,
        command=one_world([0.5, 0.0], 3),
        base_linear_velocity_b=one_world(velocity, 3),
        heading_xy=torch.tensor([[math.cos(wanted + turned), math.sin(wanted + turned)]] * 2),
        commanded_heading_xy=torch.tensor([[math.cos(wanted), math.sin(wanted)]] * 2),
    )
    assert float(REWARD_TERMS["progress"](inputs)[0]) == pytest.approx(expected, abs=1e-6)
