"""A policy may drive some of a robot's joints: the others are held, with the robot's own gains."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.gauge.motors import joint_parameters
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import ContractError, check_robot, standard_contract
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import Robot, RobotError, load_robot

G1 = load_robot("g1")
LEGS = tuple(name for name in G1.joint_names if any(word in name for word in ("hip", "knee", "ankle")))


def variant(joints=LEGS) -> Robot:
    found = G1.driving(joints)
    assert found is not None
    return found


def test_the_variants_of_the_g1():
    assert len(LEGS) == 12
    assert {name: len(each.driven_joints) for name, each in (G1.variants or {}).items()} == {"12": 12, "23": 23}
    assert G1.driving(LEGS[1:]) is None and G1.driving(G1.joint_names) is G1
    assert [j.name for j in variant().held] == [n for n in G1.joint_names if n not in LEGS]
    assert not variant().driving(G1.joint_names).held  # type: ignore[union-attr]


def test_joints_that_a_policy_does_not_drive_are_held():
    """Targets in the robot's order: the policy's, turned round here, for its joints, and the pose for the others."""
    contract = replace(standard_contract(variant()), joint_names=LEGS[::-1])
    contract = replace(contract, default_joint_position=contract.default_joint_position[::-1])
    builder = ObservationBuilder(contract, G1, 3)
    action = torch.arange(12.0).expand(3, -1)
    targets = builder.targets(action)
    pose = torch.tensor(G1.default_joint_position)
    assert torch.equal(targets[:, 12:], pose[12:].expand(3, -1))
    torch.testing.assert_close(targets[0, :12], pose[:12] + 0.25 * torch.arange(11.0, -1.0, -1.0))
    assert contract.observation_width == 9 + 3 * 12


def test_a_variant_may_hold_another_pose(tmp_path):
    text = (G1.mjcf.parent / "robot.toml").read_text().replace('mjcf = "g1.xml"', f'mjcf = "{G1.mjcf}"')
    own = "[variants.12]\ndefault_joint_position = { elbow = 1.2, left_elbow = 1.0 }\n"
    (tmp_path / "robot.toml").write_text(text.replace("[variants.12]\n", own))
    robot = load_robot(tmp_path / "robot.toml")
    found = robot.driving(LEGS)
    assert found is not None
    held = {joint.name: joint.position for joint in found.held}
    assert (held["left_elbow_joint"], held["right_elbow_joint"]) == (1.0, 1.2)
    assert held["left_shoulder_pitch_joint"] == 0.2
    (tmp_path / "robot.toml").write_text(text.replace('"waist_yaw", "shoulder"', '"waist_yaw", "neck"'))
    with pytest.raises(RobotError, match=r"variants\.23\.driven_joints has 'neck', neither a joint nor words"):
        load_robot(tmp_path / "robot.toml")


def test_gains_of_a_policy_stand_beside_those_of_held_joints():
    contract = replace(standard_contract(variant()), stiffness=(33.0,) * 12)
    played = joint_parameters(replace(load_suite("demo"), gains="contract"), G1, contract)
    assert played.stiffness == (33.0,) * 12 + G1.parameters["gauge"].stiffness[12:]


def test_other_joints_are_refused_with_the_variants():
    contract = standard_contract(variant())
    check_robot(contract, G1)
    fewer = standard_contract(replace(G1, driven_joints=LEGS[:6]))
    with pytest.raises(ContractError, match="or the 12 of its variant '12', or the 23 of its variant '23'"):
        check_robot(fewer, G1)
