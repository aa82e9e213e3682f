"""Legs, mirror images and sizes are read off the model, whatever things are called and however axes point."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends.base import TRAINING_PHYSICS, Scene
from gaitgauge.backends.mujoco.model import build_models
from gaitgauge.gauge.metrics import MetricEvaluator
from gaitgauge.gauge.suite import load_suite
from gaitgauge.robots import RobotError, check_robot, load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan, mirror_image
from gaitgauge.robots.loading import robot_digest
from gaitgauge.terrains.registry import make_terrain
from unseen_robot import LEGS, LOWER, MASS, UPPER


def test_the_unseen_robot_is_sound(unseen):
    check_robot(unseen)


def test_plan(unseen):
    plan = body_plan(unseen)
    # joints: four bends, four spreads, four swings
    assert plan.legs == tuple((4 + i, 8 + i, i) for i in range(4))
    assert plan.abduction == (4, 5, 6, 7)
    assert plan.limb_bodies == (1, 2, 3, 4)
    assert plan.leg_length == pytest.approx(UPPER + LOWER)
    assert plan.standing_height == pytest.approx((UPPER + LOWER) * np.cos(0.5) + 0.03)
    assert plan.mass == pytest.approx(MASS)


def test_mirror_image(unseen):
    image = mirror_image(unseen)
    names = [leg[0] for leg in LEGS]
    other = [names.index("hind_left"), 2, 1, 0]
    assert image.foot == tuple(other)
    assert image.joint == tuple(4 * kind + i for kind in range(3) for i in other)
    signs = {name: tuple(leg) for name, *leg in LEGS}
    for i, joint in enumerate(unseen.joint_names):
        kind, _, leg = joint.partition(".")
        column = {"spread": 2, "swing": 3, "bend": 4}[kind]
        same_way = signs[leg][column] == signs[names[other[i % 4]]][column]
        # about x a mirrored turn goes the other way, about y the same way
        assert image.sign[i] == (-1.0 if same_way == (kind == "spread") else 1.0)


def test_mirrored_joints_give_mirrored_feet(unseen):
    """The image of any pose is the mirror image of its feet."""
    image = mirror_image(unseen)
    deviation = np.random.default_rng(3).uniform(-0.2, 0.2, 12)
    mirrored = deviation[list(image.joint)] * image.sign

    def feet(change):
        pose = tuple(np.add(unseen.default_joint_position, change))
        return body_plan(replace(unseen, default_joint_position=pose)).foot_position

    expected = feet(deviation)[list(image.foot)] * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(feet(mirrored), expected, atol=1e-12)


def test_a_lopsided_pose_has_no_image(unseen):
    pose = (*unseen.default_joint_position[:-1], 0.3)
    with pytest.raises(RobotError, match=r"has no counterpart at its mirror image .*symmetry=none"):
        mirror_image(replace(unseen, default_joint_position=pose))


def test_go2_is_as_its_names_say():
    go2 = load_robot("go2")
    plan, image = body_plan(go2), mirror_image(go2)
    assert [go2.joint_names[i] for i in plan.abduction] == [f"{leg}_hip_joint" for leg in go2.foot_names]
    limbs = {go2.collision_bodies[i] for i in plan.limb_bodies}
    assert limbs == {f"{leg}_{part}" for leg in go2.foot_names for part in ("thigh", "calf")}
    for i, name in enumerate(go2.joint_names):
        pair = name[0] + ("R" if name[1] == "L" else "L") + name[2:]
        assert go2.joint_names[image.joint[i]] == pair
        assert image.sign[i] == (-1.0 if "hip" in name else 1.0)


def test_what_is_seen_weighs_where_nothing_else_says_so(unseen):
    """The coxae have no colliding shape and no inertia of their own: the engine must not take their mass away."""
    terrain = make_terrain("flat")
    scene = Scene(
        robot=unseen,
        parameters=unseen.parameters["gauge"],
        terrains=(terrain,),
        terrain_index=(0,),
        physics=TRAINING_PHYSICS,
    )
    (model,) = build_models(scene)
    assert model.body_mass.sum() == pytest.approx(MASS)
    feet = [model.site(f"centre of {name}").pos for name in unseen.foot_names]
    np.testing.assert_allclose(feet, [[0, 0, -LOWER]] * 4)


def test_fields_of_later_versions_leave_older_digests_alone(unseen):
    plain = replace(unseen, foot_shapes=None)
    assert robot_digest(plain) != robot_digest(unseen)
    # as before these fields were there
    assert robot_digest(load_robot("go2")).startswith("5a519c5a7b5e67b73264c3be485e2699")


def test_the_base_is_among_the_bodies(unseen):
    with pytest.raises(RobotError, match="collision_bodies lacks the base_body 'corpus'"):
        check_robot(replace(unseen, collision_bodies=unseen.collision_bodies[1:]))


def test_a_suite_watches_the_same_joints_of_any_robot(unseen):
    suite = load_suite("robogauge-1.1")

    def watched(robot):
        weight = 9.81 * body_plan(robot).mass
        found = MetricEvaluator(suite.metrics, robot, weight, torch.device("cpu"), torch.float64).constants.limits[0]
        return [robot.joint_names[i] for i in found]

    assert watched(load_robot("go2")) == [n for n in load_robot("go2").joint_names if "calf" not in n]
    assert watched(unseen) == [n for n in unseen.joint_names if "bend" not in n]
