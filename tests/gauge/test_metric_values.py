"""Every metric on motions whose value can be written down."""

import math

import numpy as np
import pytest
import torch
from gaitgauge.gauge.metrics import (
    angular_velocity,
    friction_margin,
    joint_limits,
    joint_power,
    linear_velocity,
    orientation,
    quality,
    torque_smoothness,
    zmp_margin,
)
from gaitgauge.gauge.play.sampling import GRAVITY
from gaitgauge.robots.anatomy.body_plan import total_mass
from gaitgauge.robots.rotation import rotate_inverse
from metric_states import OWN, REFERENCE, evaluate, rows, scalar, turned
from scripted_gauge import GO2, fake, short_suite

# ---- tracking ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.0, 37.0, 90.0, -150.0])
@pytest.mark.parametrize("kind", ["body", "commanded"])
def test_a_velocity_held_in_the_body_frame_is_perfect_under_any_heading(yaw, kind):
    heading = turned(yaw=yaw)
    velocity_w = rotate_inverse(turned(yaw=-yaw), rows(0.8, -0.3, 0.0))
    value = linear_velocity(heading, velocity_w, rows(0.8, -0.3, 5.0), scalar(math.sqrt(2)), kind)
    assert value.item() == pytest.approx(1.0)


def test_linear_error_is_scaled_by_the_norm_of_the_limits():
    # 0.3 and 0.4 m/s off: 0.5 of sqrt 5
    value = linear_velocity(turned(), rows(1.3, 0.6, 0.0), rows(1.0, 1.0, 0.0), scalar(math.sqrt(5)), "body")
    assert value.item() == pytest.approx(1 - 0.5 / math.sqrt(5))


def test_vertical_speed_costs_in_the_reference_alone():
    arguments = turned(), rows(1.0, 0.0, 0.5), rows(1.0, 0.0, 0.0), scalar(math.sqrt(2))
    assert linear_velocity(*arguments, "body").item() == pytest.approx(1 - 0.5 / math.sqrt(2))
    assert linear_velocity(*arguments, "commanded").item() == pytest.approx(1.0)


def test_errors_beyond_the_scale_are_negative_and_not_clamped():
    assert linear_velocity(turned(), rows(-2.0, 0, 0), rows(2.0, 0, 0), scalar(2.0), "body").item() == pytest.approx(-1)


def test_the_reference_turns_the_angular_velocity_twice():
    """Pitch -30°, turning about the body's own z axis with 1 rad/s: it reads (0.5, 0, 0.866)."""
    pose, rate = turned(pitch=-30.0), rows(0.0, 0.0, 1.0)
    error = math.hypot(0.5, math.cos(math.radians(30)) - 1.0)
    value = angular_velocity(pose, rate, rows(0, 0, 1.0), scalar(2.0), "twice-rotated")
    assert value.item() == pytest.approx(1 - error / 2.0)
    for kind in ("body", "commanded"):
        assert angular_velocity(pose, rate, rows(0, 0, 1.0), scalar(2.0), kind).item() == pytest.approx(1.0)


def test_pure_yaw_is_the_same_in_every_reading():
    for kind in ("twice-rotated", "body", "commanded"):
        value = angular_velocity(turned(yaw=80.0), rows(0, 0, 1.2), rows(0, 0, 1.5), scalar(1.5), kind)
        assert value.item() == pytest.approx(1 - 0.3 / 1.5)


def test_roll_and_pitch_rates_cost_unless_only_the_commanded_rate_counts():
    arguments = turned(), rows(0.3, -0.4, 1.0), rows(0, 0, 1.0), scalar(2.0)
    assert angular_velocity(*arguments, "body").item() == pytest.approx(1 - 0.5 / 2)
    assert angular_velocity(*arguments, "commanded").item() == pytest.approx(1.0)


# ---- joints and attitude ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("roll", [0.0, 10.0, -45.0, 90.0])
def test_orientation_falls_with_the_sine_of_the_roll(roll):
    assert orientation(turned(roll=roll)).item() == pytest.approx(1 - abs(math.sin(math.radians(roll))))


@pytest.mark.parametrize("pitch", [20.0, -60.0])
def test_orientation_does_not_see_pitch_or_heading(pitch):
    assert orientation(turned(pitch=pitch, yaw=70.0)).item() == pytest.approx(1.0)


def test_joint_limits_take_the_root_mean_square_over_all_watched_joints():
    low, high, full = rows(-0.4, -0.4)[0], rows(0.4, 0.4)[0], rows(2.0, 1.0)[0]
    # 0.2 over a range of 2, and 0.1 below one of 1: both a tenth
    assert joint_limits(rows(0.6, -0.5), low, high, full).item() == pytest.approx(0.9)
    assert joint_limits(rows(0.6, 0.0), low, high, full).item() == pytest.approx(1 - 0.1 / math.sqrt(2))
    assert joint_limits(rows(0.4, -0.4), low, high, full).item() == pytest.approx(1.0)


def test_power_is_the_root_mean_square_of_products_whatever_their_sign():
    torque, velocity = rows(10.0, -10.0, 0.0, 5.0), rows(3.0, 4.0, 50.0, 0.0)
    assert joint_power(torque, velocity, 100.0).item() == pytest.approx(1 - math.sqrt((30**2 + 40**2) / 4) / 100)


def test_a_step_of_torque_in_one_joint():
    before, now = torch.zeros(1, 12, dtype=torch.float64), torch.zeros(1, 12, dtype=torch.float64)
    now[0, 4] = 6.0
    known = torch.tensor([True])
    assert torque_smoothness(now, before, known, 30.0).item() == pytest.approx(1 - 6 / math.sqrt(12) / 30)
    assert torque_smoothness(now, before, ~known, 30.0).item() == 1.0
    assert torque_smoothness(now, now, known, 30.0).item() == 1.0


# ---- quality ------------------------------------------------------------------------------------------------------------

WEIGHTS = torch.tensor([2.0, 2.0, 1.0, 1.0, 1.0, 1.0], dtype=torch.float64)


def test_quality_is_the_weighted_geometric_mean():
    values = (0.5, 0.8, 0.9, 1.0, 0.7, 0.6)
    expected = (0.5**2 * 0.8**2 * 0.9 * 0.7 * 0.6) ** (1 / 8)
    assert quality(rows(*values), WEIGHTS).item() == pytest.approx(expected)


@pytest.mark.parametrize(("tracking", "floor"), [((0.0, 1.0), 0.0056), ((-3.0, 1.0), 0.0056), ((-1.0, 0.0), 3.2e-5)])
def test_quality_has_a_floor_where_tracking_fails(tracking, floor):
    assert quality(rows(*tracking, 1, 1, 1, 1), WEIGHTS).item() == pytest.approx(floor, rel=0.015)


def test_quality_never_rewards_more_than_perfect():
    assert quality(rows(1, 1, 1.5, 1, 1, 1), WEIGHTS).item() == pytest.approx(1.0)


def test_quality_leaves_out_what_is_not_defined():
    nan = math.nan
    value = quality(rows(0.5, 1.0, nan, 1.0, nan, 1.0), WEIGHTS).item()
    assert value == pytest.approx(0.5 ** (2 / 6))


# ---- the evaluator ------------------------------------------------------------------------------------------------------


def test_the_default_pose_violates_the_soft_limits_as_published():
    state = fake(short_suite()).state
    values = evaluate(REFERENCE, state)
    assert values["dof_limits"] == pytest.approx(0.9694, abs=5e-5)
    assert values["quality"] == pytest.approx(values["dof_limits"] ** (1 / 8))


def test_normalizers_are_those_of_the_terrain():
    state = fake(short_suite()).state
    flat = evaluate(REFERENCE, state, (1.0, 0.0, 1.0), REFERENCE.command_limits("flat"))
    slope = evaluate(REFERENCE, state, (1.0, 0.0, 1.0), REFERENCE.command_limits("slope"))
    assert (flat["lin_vel_err"], flat["ang_vel_err"]) == pytest.approx((1 - 1 / math.sqrt(5), 1 - 1 / 2))
    assert (slope["lin_vel_err"], slope["ang_vel_err"]) == pytest.approx((1 - 1 / math.sqrt(2), 1 - 1 / 1.5))


def test_both_suites_evaluate_what_they_weigh():
    state = fake(short_suite()).state
    six = ["lin_vel_err", "ang_vel_err", "dof_limits", "dof_power", "orientation_stability", "torque_smoothness"]
    assert list(evaluate(REFERENCE, state)) == [*six, "quality"]
    assert list(evaluate(OWN, state)) == [*six, "zmp_margin", "friction_margin", "motion_done", "quality"]


def test_the_motion_that_is_done_is_taken_in_the_body_frame():
    """Heading left (+90° about z), a robot that moves along world +y walks forward."""
    state = fake(short_suite()).state
    state.base_quaternion_w[:] = turned(yaw=90.0)
    state.base_linear_velocity_w[:] = rows(0.0, 0.8, 0.0)
    assert evaluate(OWN, state, (1.0, 0.0, 0.0))["motion_done"] == pytest.approx(0.8)


@pytest.mark.parametrize(("share", "defined"), [(0.049, False), (0.051, True)])
def test_contact_metrics_need_a_twentieth_of_the_weight(share, defined):
    state = fake(short_suite()).state
    weight = GRAVITY * total_mass(GO2)
    state.ground_force_w[:, 2] = share * weight
    state.foot_normal_force[:, 0] = share * weight
    values = evaluate(OWN, state)
    for name in ("zmp_margin", "friction_margin"):
        assert math.isnan(values[name]) is not defined
    assert math.isfinite(values["quality"])


# ---- contacts, by hand ----------------------------------------------------------------------------------------------------


def test_zmp_margin_is_the_distance_of_the_pressure_centre():
    """A force of 100 N that acts at (0.03, -0.04) from the centre of the contacts: 5 cm away."""
    point, force = np.array([0.03, -0.04, 0.0]), np.array([20.0, -10.0, 100.0])
    moment = np.cross(point, force)
    assert zmp_margin(rows(*moment), rows(*force), 0.5).item() == pytest.approx(1 - 0.05 / 0.5)
    assert zmp_margin(rows(*(20 * moment)), rows(*force), 0.5).item() == 0.0


def test_friction_margin_weighs_contacts_by_their_load():
    normal, tangential = rows(30.0, 10.0, 0.0, 0.0), rows(9.0, 6.0, 0.0, 0.0)
    # slack 1 - 9/18 with weight 3/4, and 0 with weight 1/4
    assert friction_margin(normal, tangential, scalar(0.6)).item() == pytest.approx(0.75 * 0.5)
    # a slipping foot beyond its cone counts zero, not less
    assert friction_margin(normal, rows(9.0, 60.0, 0, 0), scalar(0.6)).item() == pytest.approx(0.75 * 0.5)
    assert friction_margin(normal, rows(0, 0, 0, 0), scalar(0.6)).item() == pytest.approx(1.0)


def test_tension_between_the_feet_uses_friction_up():
    """Feet that press outwards, as those of the default pose do, leave less margin than feet of the same load that do not: a robot
    that stands may rank below one that walks (docs/reference/suites.md). Only a margin of the net force would not see it."""
    load = rows(37.0, 37.0, 37.0, 37.0)
    tense = friction_margin(load, rows(12.0, 12.0, 12.0, 12.0), scalar(0.6)).item()
    walking = friction_margin(rows(74.0, 0.0, 0.0, 74.0), rows(15.0, 0.0, 0.0, 15.0), scalar(0.6)).item()
    assert tense == pytest.approx(1 - 12 / (0.6 * 37)) and walking == pytest.approx(1 - 15 / (0.6 * 74))
    assert tense < walking
