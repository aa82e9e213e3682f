"""Plans, legs and roles of joints are told from the tree: the names in these models say nothing."""

from dataclasses import replace

import mujoco
import pytest
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan
from gaitgauge.robots.anatomy.limbs import joint_chain, joint_roles, moving_tips
from gaitgauge.robots.anatomy.roles import anatomy, plan_of
from stick_biped import write_biped

GO2 = load_robot("go2")
LEG = ["hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll"]
ARM = ["shoulder_pitch", "shoulder_roll", "elbow", "wrist_yaw"]


@pytest.mark.parametrize("name", ["go2", "go1", "anymal_c"])
def test_four_legs(name):
    robot = load_robot(name)
    build = anatomy(robot)
    assert build.plan == "quadruped" and robot.held == ()
    assert {leg.name for leg in build.legs} == {"front left", "front right", "rear left", "rear right"}
    for leg in build.legs:
        assert [build.roles[i] for i in leg.joints] == ["hip_roll", "hip_pitch", "knee"]
        letters = robot.foot_names[leg.foot][:2]
        assert leg.name.split() == ["front" if "F" in letters else "rear", leg.side]
        assert (leg.side == "left") == ("L" in letters)


@pytest.mark.parametrize("arms", [False, True])
def test_two_legs(tmp_path, arms):
    model = mujoco.MjModel.from_xml_path(str(write_biped(tmp_path, arms=arms)))
    base, tips = model.body("pelvis").id, [model.body(f"{side}_f").id for side in "lr"]
    feet = [int(model.body_geomadr[tip]) + 1 for tip in tips]
    roles = joint_roles(model, base, [joint_chain(model, tip, base) for tip in tips], feet)
    assert [roles[model.joint(f"l_{x}").id] for x in "abcdef"] == LEG
    assert [roles[model.joint(f"r_{x}").id] for x in "abcdef"] == LEG
    assert len(moving_tips(model, base)) == (5 if arms else 2)
    if arms:
        assert [roles[model.joint(f"r_{x}").id] for x in "ghij"] == ARM
        assert roles[model.joint("turn").id] == "waist_yaw" and roles[model.joint("nod").id] == "head_pitch"
    assert plan_of(2, roles.values(), "it") == ("humanoid" if arms else "biped")


@pytest.mark.parametrize(("legs", "words"), [(3, "it has 3 legs; 2, 4 or 6 are possible"), (1, "it has 1 leg;")])
def test_other_numbers_of_legs_have_no_plan(legs, words):
    with pytest.raises(RobotError, match=words):
        plan_of(legs, ["hip_pitch", "knee"], "it")


def test_wheels_make_a_plan():
    build = anatomy(load_robot("go2w"))
    assert build.plan == "wheeled"
    assert all(build.roles[leg.joints[-1]] == "wheel" and build.roles[leg.joints[-2]] == "knee" for leg in build.legs)


def test_joints_that_are_not_driven_are_held():
    robot = replace(GO2, driven_joints=tuple(n for n in GO2.joint_names if "hip" not in n))
    assert [(j.name, j.position, j.stiffness, j.damping) for j in robot.held] == [
        (f"{leg}_hip_joint", angle, 20.0, 0.5) for leg, angle in (("FL", 0.1), ("FR", -0.1), ("RL", 0.1), ("RR", -0.1))
    ]


def test_the_g1_is_the_makers():
    """Mass of the maker's model of 29 joints, rev 1.0; length of the stretched leg from its link lengths, by hand."""
    g1 = load_robot("g1")
    build = anatomy(g1)
    assert build.plan == "humanoid" and [leg.name for leg in build.legs] == ["left", "right"]
    assert [build.roles[i] for i in build.legs[0].joints] == [
        n.removeprefix("left_").removesuffix("_joint") for n in g1.joint_names[:6]
    ]
    assert all(role in name for role, name in zip(build.roles, g1.joint_names, strict=True))
    assert body_plan(g1).mass == pytest.approx(33.341, abs=1e-3)
    assert build.leg_length == pytest.approx(0.69, abs=0.01)
    assert g1.sdk_joint_names == g1.joint_names
