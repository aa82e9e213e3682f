"""Joints that a policy does not drive: its contract or its robot holds them at a pose, with gains."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.backends.base import PhysicsState
from gaitgauge.backends.conformance.soles import two_soles
from gaitgauge.gauge.motors import joint_parameters
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import ContractError, PolicyContract, held_joints, reordered, standard_contract
from gaitgauge.policy.foreign.legged_gym import read_legged_gym
from gaitgauge.policy.foreign.zoo import known_contract, zoo
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots.base import HeldJoint

ROBOT = two_soles()
KNEES = tuple(HeldJoint(name=f"{side}_knee", position=0.5, stiffness=90.0, damping=3.0) for side in ("left", "right"))
DRIVEN = ("right_ankle", "left_hip", "left_ankle", "right_hip")


def without_knees(**changes) -> PolicyContract:
    """Return the standard contract for hips and ankles alone, in an order of its own."""
    data = reordered(standard_contract(ROBOT), (*DRIVEN, "left_knee", "right_knee")).to_dict()
    for name in ("joint_names", "default_joint_position", "action_scale", "stiffness", "damping"):
        data[name] = data[name][: len(DRIVEN)]
    return replace(PolicyContract.from_dict(data | {"stiffness": [50.0] * 4}), **{"held": KNEES, **changes})


def test_held_joints_keep_their_targets_and_the_network_does_not_see_them():
    contract = without_knees()
    assert contract.frame_width == 9 + 3 * len(DRIVEN)
    builder = ObservationBuilder(contract, ROBOT, 2)
    pose = dict(zip(contract.joint_names, contract.default_joint_position, strict=True))
    targets = builder.targets(torch.tensor([[0.4, 0.0, 0.8, 0.0], [0.0, -0.4, 0.0, 0.0]]))
    moved = dict(zip(ROBOT.joint_names, targets.T.tolist(), strict=True))
    assert moved["left_knee"] == moved["right_knee"] == [0.5, 0.5]
    assert moved["right_ankle"] == pytest.approx([pose["right_ankle"] + 0.1, pose["right_ankle"]])
    assert moved["left_hip"] == pytest.approx([pose["left_hip"], pose["left_hip"] - 0.1])
    six = torch.arange(6.0).expand(2, -1)
    upright, none = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, -1), torch.zeros(2, 3)
    fields = dict.fromkeys(PhysicsState.__dataclass_fields__, torch.zeros(2))
    seen = {"base_quaternion_w": upright, "base_angular_velocity_b": none, "joint_position": six, "joint_velocity": six}
    frame = builder.build(PhysicsState(**(fields | seen)), none, torch.zeros(2, 4))
    order = [ROBOT.joint_names.index(name) for name in DRIVEN]
    assert frame[0, 9:13].tolist() == pytest.approx([i - pose[n] for i, n in zip(order, DRIVEN, strict=True)])


def test_motors_of_held_joints_have_gains_of_their_own():
    motors = joint_parameters(replace(load_suite("gaitgauge-1"), gains="contract"), ROBOT, without_knees())
    assert motors.stiffness == (50.0, 90.0, 50.0) * 2 and motors.damping == (4.0, 3.0, 4.0) * 2


def test_the_robot_holds_joints_too_and_a_variant_without_them_does_no_harm():
    robot = replace(ROBOT, driven_joints=DRIVEN)
    assert [(j.name, j.position, j.stiffness) for j in held_joints(without_knees(held=()), robot)] == [
        ("left_knee", 0.6, 200.0),
        ("right_knee", 0.6, 200.0),
    ]
    arm = HeldJoint(name="left_elbow", position=0.0, stiffness=20.0, damping=1.0)
    assert held_joints(without_knees(held=(*KNEES, arm)), ROBOT) == KNEES


def test_hashes_of_contracts_without_held_joints_stay():
    assert "held" not in standard_contract(ROBOT).to_dict()
    assert without_knees(held=()).hash != without_knees().hash
    assert PolicyContract.from_json(without_knees().to_json()) == without_knees()


def test_wrong_joints_are_refused():
    with pytest.raises(ContractError, match="joints that the policy does not drive belong into held of its contract"):
        ObservationBuilder(without_knees(held=KNEES[:1]), ROBOT, 1)
    with pytest.raises(ContractError, match="held names 'left_hip', which is in joint_names too or held twice"):
        without_knees(held=(*KNEES, replace(KNEES[0], name="left_hip")))


def test_unitree_rl_gyms_g1_is_run_as_the_zoo_says():
    """Its ``g1.yaml`` drives the legs of a robot with arms; the zoo's contract of the same policy was written by hand."""
    known = next(each for each in zoo().values() if each.name == "unitree_rl_gym-g1")
    settings = {
        "default_angles": [-0.1, 0.0, 0.0, 0.3, -0.2, 0.0] * 2, "kps": [100, 100, 100, 150, 40, 40] * 2,
        "kds": [2, 2, 2, 4, 2, 2] * 2, "simulation_dt": 0.002, "control_decimation": 10, "ang_vel_scale": 0.25,
        "dof_pos_scale": 1.0, "dof_vel_scale": 0.05, "action_scale": 0.25, "cmd_scale": [2.0, 2.0, 0.25],
        "num_actions": 12, "num_obs": 47, "max_cmd": [0.8, 0.5, 1.0],
    }  # fmt: skip
    found = read_legged_gym(settings, Path("g1.yaml"), None)
    by_hand = known_contract(known, None)
    assert sorted(each.name for each in found.held) == sorted(each.name for each in by_hand.held)
    assert replace(found, held=by_hand.held).hash == by_hand.hash
    assert "the 17 joints of robot 'g1' beside its legs are held" in found.provenance["assumed"]
    with pytest.raises(
        PolicyError, match="has 11 actions and robot 'g1' 29 joints, 12 of them in its legs; give another"
    ):
        read_legged_gym(settings | {"num_actions": 11}, Path("g1.yaml"), None)
