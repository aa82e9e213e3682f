"""A robot with rigid joints is the same robot in its pose, with fewer degrees of freedom."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.anatomy.body_plan import default_pose, total_mass
from gaitgauge.robots.welding import welded

G1 = load_robot("g1")


def test_rigid_arms_are_where_the_held_ones_are(tmp_path):
    pose = tuple(angle + 0.1 for angle in G1.default_joint_position)
    whole = replace(G1, default_joint_position=pose, driven_joints=G1.joint_names[:12])
    rigid = welded(whole, tmp_path)
    (before, held), (after, fixed) = default_pose(whole), default_pose(rigid)
    assert (before.nv, after.nv) == (35, 18)
    for name in ("xpos", "xipos", "xmat", "geom_xpos"):
        np.testing.assert_allclose(getattr(fixed, name), getattr(held, name), atol=1e-5)
    assert total_mass(rigid) == pytest.approx(total_mass(G1))
    assert rigid.joint_names == G1.joint_names[:12] and rigid.default_joint_position == pose[:12]
    assert rigid.parameters["gauge"].stiffness == G1.parameters["gauge"].stiffness[:12]
    assert rigid.held == () and rigid.parameters["gauge"].stiffness_factor is None


def test_a_robot_of_which_all_is_driven_stays(tmp_path):
    assert welded(G1, tmp_path) is G1 and not list(tmp_path.iterdir())


def test_half_of_a_body_cannot_be_rigid(tmp_path):
    model = (
        '<mujoco><worldbody><body name="trunk"><freejoint/><geom size=".1"/><body name="leg" pos="0 0 -.3"><joint name="a" axis="1 0 0"/>'
        '<joint name="b" axis="0 1 0"/><geom name="foot" size=".02"/></body></body></worldbody></mujoco>'
    )
    (tmp_path / "model.xml").write_text(model)
    robot = replace(
        G1,
        mjcf=tmp_path / "model.xml",
        base_body="trunk",
        joint_names=("a", "b"),
        default_joint_position=(0.0, 0.0),
        driven_joints=("a",),
    )
    with pytest.raises(
        RobotError, match="the joint 'b' cannot be made rigid, since a driven joint moves the same body 'leg'"
    ):
        welded(robot, tmp_path)


@pytest.mark.parametrize(("driven", "ties"), [(("a", "b"), 0), (("a", "b", "c"), None)])
def test_an_equality_of_rigid_joints_goes_and_one_that_ties_a_driven_joint_is_refused(tmp_path, driven, ties):
    legs = "".join(
        f'<body name="{n}_leg" pos="0 {i} -.3"><joint name="{n}" axis="1 0 0"/><geom name="{n}_foot" size=".02"/></body>'
        for i, n in enumerate("abcd")
    )
    (tmp_path / "model.xml").write_text(
        f'<mujoco><worldbody><body name="trunk"><freejoint/><geom size=".1"/>{legs}</body></worldbody>'
        '<equality><joint joint1="c" joint2="d"/></equality></mujoco>'
    )
    robot = replace(
        G1,
        mjcf=tmp_path / "model.xml",
        base_body="trunk",
        joint_names=tuple("abcd"),
        default_joint_position=(0.0,) * 4,
        action_scale=(1.0,) * 4,
        parameters={},
        driven_joints=driven,
    )
    (tmp_path / "out").mkdir()
    if ties is None:
        with pytest.raises(RobotError, match="'d' cannot be made rigid, since an equality ties it to 'c'"):
            welded(robot, tmp_path / "out")
    else:
        assert mujoco.MjModel.from_xml_path(str(welded(robot, tmp_path / "out").mjcf)).neq == ties
