"""Suite robogauge-1.1.8: its metrics on motions with a known answer, and what it shares with robogauge-1.1."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gaitgauge.backends import make_backend
from gaitgauge.gauge.evaluate import evaluate as evaluate_policy
from gaitgauge.gauge.motors import gains_note, joint_parameters
from gaitgauge.gauge.play.rollout import Rollout
from gaitgauge.gauge.request import Request
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation_table import observation
from gaitgauge.robots.anatomy.body_plan import joint_ranges, stance_span
from metric_states import evaluate, rows, turned
from scripted_gauge import DIAGONAL, GO2, MAXIMUM, episode, scene, short_suite, to_the_end

OLD, NEW = load_suite("robogauge-1.1"), load_suite("robogauge-1.1.8")
SIX = tuple(OLD.metrics.weights)


def instant(
    *, normal=(0.0,) * 4, tangential=(0.0,) * 4, force=(0.0,) * 3, moment=(0.0,) * 3, quaternion=None, **columns
):
    """A robot that stands still, its joints in the middle of their ranges, with these forces of the ground."""
    values = {
        "base_quaternion_w": rows(1, 0, 0, 0) if quaternion is None else quaternion,
        "base_linear_velocity_w": rows(0, 0, 0),
        "base_angular_velocity_b": rows(0, 0, 0),
        "joint_position": rows(*joint_ranges(GO2).mean(1)),
        "joint_velocity": rows(*(0.0,) * 12),
        "joint_torque": rows(*(0.0,) * 12),
        "foot_normal_force": rows(*normal),
        "foot_tangential_force": rows(*tangential),
        "ground_force_w": rows(*force),
        "ground_moment_w": rows(*moment),
    }
    return SimpleNamespace(**(values | columns))


def test_the_suite_differs_from_the_older_one_in_what_1_1_8_changed():
    assert NEW.metrics.weights == {**OLD.metrics.weights, "zmp_margin": 1.0, "friction_margin": 1.0}
    assert sum(NEW.metrics.weights.values()) == 10
    assert (NEW.commands.flat, OLD.commands.flat) == ((1.0, 1.0, 2.0), (2.0, 1.0, 2.0))
    assert (
        replace(
            OLD,
            **{name: getattr(NEW, name) for name in ("name", "version", "title", "families")},
            commands=replace(OLD.commands, flat=(1.0, 1.0, 2.0)),
            metrics=replace(
                OLD.metrics, weights=NEW.metrics.weights, contact_share=0.0, foot_force=5.0, flight="perfect"
            ),
            scoring=replace(OLD.scoring, groups=NEW.scoring.groups),
        )
        == NEW
    )


def test_the_zmp_margin_falls_with_the_distance_over_the_stance():
    """A moment of 15 N·m on 150 N puts the zero moment point 0.1 m beside the contacts."""
    values = evaluate(NEW, instant(force=(0, 0, 150), moment=(0, 15, 0)))
    assert values["zmp_margin"] == pytest.approx(1 - 0.1 / stance_span(GO2))
    assert evaluate(NEW, instant(force=(0, 0, 150), moment=(90, 120, 0)))["zmp_margin"] == 0.0
    # a tenth of a newton is a contact: 5 % of the weight are not needed here
    assert evaluate(NEW, instant(force=(0, 0, 0.1), moment=(0, 0.01, 0)))["zmp_margin"] < 0.9


def test_the_friction_margin_weighs_feet_by_their_load_and_skips_light_ones():
    """Slack 0.5 at 100 N; a sliding foot at 50 N; 8 N, where μN is under 5 N: zero; 4 N: not counted."""
    values = evaluate(NEW, instant(normal=(100, 50, 8, 4), tangential=(30, 40, 1, 0)), friction=0.6)
    assert values["friction_margin"] == pytest.approx(100 * 0.5 / 158)
    # 25 N at a friction of 0.2 are at the threshold, 26 N are above it
    at, above = (evaluate(NEW, instant(normal=(n, 0, 0, 0)), friction=0.2)["friction_margin"] for n in (25, 26))
    assert (at, above) == (0.0, pytest.approx(1.0))
    assert evaluate(NEW, instant(normal=(4, 4, 4, 4), tangential=(4, 4, 4, 4)))["friction_margin"] == 1.0


def test_flight_counts_as_perfect():
    values = evaluate(NEW, instant())
    assert all(value == pytest.approx(1.0) for value in values.values())


def test_the_quality_is_the_tenth_root_of_the_weighted_product():
    """Half of the linear scale wrong, a roll of 30° (1 - sin 30° = 0.5), a friction margin of 0.5."""
    state = instant(
        force=(0, 0, 150),
        normal=(150, 0, 0, 0),
        tangential=(45, 0, 0, 0),
        base_linear_velocity_w=rows(math.sqrt(0.5), 0, 0),
        quaternion=turned(roll=30.0),
    )
    values = evaluate(NEW, state, limits=(1.0, 1.0, 2.0))
    assert [values[n] for n in ("lin_vel_err", "orientation_stability", "friction_margin")] == pytest.approx([0.5] * 3)
    assert values["quality"] == pytest.approx((0.5**2 * 0.5 * 0.5) ** 0.1)


def short(suite):
    return replace(short_suite(suite.name), metrics=replace(suite.metrics, interval=5))


def test_episodes_have_the_six_metrics_of_the_older_suite_bit_for_bit():
    """At equal commands, those of a slope: a search with the target goal, and quality episodes."""
    found = []
    for suite in (short(OLD), short(NEW)):
        policy = load_policy("pretrained")
        backend = make_backend("mujoco", scene(suite, 7, None))
        equal = replace(suite, commands=replace(suite.commands, flat=suite.commands.levelled))
        rollout = Rollout(equal, policy, backend, lambda e: 0)
        rollout.play([episode(DIAGONAL, MAXIMUM)])
        found.append(to_the_end(rollout))
        backend.close()
    for old, new in zip(*found, strict=True):
        assert (old.falls, old.physics_steps, len(old.samples)) == (new.falls, new.physics_steps, len(new.samples))
        assert len(old.samples) > 20
        assert np.array_equal(old.samples[:, :6], new.samples[:, :6])
        assert new.samples.shape[1] == 9 and np.isfinite(new.samples).all()


@pytest.mark.slow
def test_levels_and_six_metrics_of_a_whole_environment_are_those_of_the_older_suite(tmp_path):
    results = []
    for name in (OLD.name, NEW.name):
        request = Request(policy="pretrained", suite=name, terrains=("stairs_fd",), frictions=(0.4,), seeds=(0,))
        results.append(evaluate_policy(request, tmp_path / name))
    old, new = (result.environments[0] for result in results)
    assert (old.level, old.trials) == (new.level, new.trials) and old.level > 0
    for name in SIX:
        assert old.metrics[name] == new.metrics[name]
    assert set(new.metrics) - set(old.metrics) == {"zmp_margin", "friction_margin"}


# ---- task families ------------------------------------------------------------------------------------------------------


def with_command(name, scale):
    usual = standard_contract(GO2)
    terms = [replace(t, name=name, scale=scale) if t.name == "command" else t for t in usual.observation]
    return replace(usual, observation=tuple(terms), stiffness=(25.0,) * 12)


@pytest.mark.parametrize(("name", "scale"), [("command", (1.0,)), ("command", (1.0,) * 3), ("pose_command", (1.0,))])
def test_a_policy_that_sees_its_command_unscaled_is_played_with_the_gains_of_its_family(name, scale):
    contract = with_command(name, scale)
    assert set(joint_parameters(NEW, GO2, contract).stiffness) == {25.0}
    assert gains_note(NEW, GO2, contract) == (
        "played with kp 25 N·m/rad and kd 0.5 N·m·s/rad, as robogauge-1.1.8 plays the family go2_lab"
    )
    softer = replace(contract, stiffness=(20.0,) * 12)
    assert gains_note(NEW, GO2, softer).endswith(
        "the family go2_lab; this one was made for kp 20 N·m/rad and kd 0.5 N·m·s/rad"
    )
    assert set(joint_parameters(OLD, GO2, contract).stiffness) == {20.0}


def test_every_other_policy_keeps_the_gains_of_the_suite():
    usual = standard_contract(GO2)
    assert joint_parameters(NEW, GO2, usual) == GO2.parameters["gauge"] and gains_note(NEW, GO2, usual) is None
    assert joint_parameters(NEW, GO2, with_command("command", (1.0, 1.0, 0.25))) == GO2.parameters["gauge"]


def pose(command, **turn):
    state = SimpleNamespace(base_quaternion_w=turned(**turn))
    return observation("pose_command").build(state, rows(*command), rows(*(0.0,) * 12))[0].tolist()


def test_a_pose_command_is_where_a_second_of_the_command_leads():
    assert pose((0.8, -0.2, 0.0), yaw=40.0) == pytest.approx([0.8, -0.2, 0.0])
    # a quarter turn at 1 m/s: an arc of radius 2/π, at the end both ahead and to the left
    assert pose((1.0, 0.0, math.pi / 2), yaw=-70.0) == pytest.approx([2 / math.pi, 2 / math.pi, math.pi / 2])
    assert pose((0.0, 1.0, math.pi / 2)) == pytest.approx([-2 / math.pi, 2 / math.pi, math.pi / 2])
    # under pitch the horizontal part of the speed and the vertical part of the turning count
    half = math.pi / 2 * math.cos(math.radians(60))
    expected = [math.sin(half) / half * 0.5, (1 - math.cos(half)) / half * 0.5, half]
    assert pose((1.0, 0.0, math.pi / 2), pitch=60.0, yaw=25.0) == pytest.approx(expected)
    # the series for slow turning joins on
    assert pose((1.0, 0.5, 0.999e-3)) == pytest.approx(pose((1.0, 0.5, 1.001e-3)), abs=2e-6)
