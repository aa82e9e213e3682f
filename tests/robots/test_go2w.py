"""The Go2-W: sizes by hand, wheels driven by velocity, a policy's targets through the contract, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends import BackendError, PhysicsOptions, Scene, make_backend
from gaitgauge.backends.base import ResetState
from gaitgauge.policy.contract import ContractError, check_robot, standard_contract
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan, mirror_image
from gaitgauge.robots.checks.examining import examine
from gaitgauge.robots.loading import checked_fields
from gaitgauge.terrains.base import Terrain

GO2W, GO2 = load_robot("go2w"), load_robot("go2")
RADIUS = 0.086


def test_it_is_a_go2_on_wheels():
    """Legs of 0.213 and 0.2264 m at 0.8 and -0.7 rad from the vertical; the Go2's links, and four wheels of 0.98 kg."""
    plan = body_plan(GO2W)
    assert plan.mass == pytest.approx(body_plan(GO2).mass + 4 * 0.98, abs=1e-6)
    assert plan.leg_length == pytest.approx(0.213 + 0.2264, abs=1e-6)
    assert plan.standing_height == pytest.approx(0.213 * np.cos(0.8) + 0.2264 * np.cos(0.7) + RADIUS, abs=1e-3)
    assert [len(leg) for leg in plan.legs] == [3, 3, 3, 3] and plan.part(GO2W.num_joints - 1) == ""
    assert mirror_image(GO2W).joint[-4:] == (13, 12, 15, 14)
    assert not [f.sentence for f in examine(GO2W) if not f.passed]


def test_it_rolls_as_fast_as_its_wheels_turn():
    stiff = {"stiffness": (200.0,) * 12 + (0.0,) * 4, "damping": (4.0,) * 12 + (0.5,) * 4}
    scene = Scene(
        robot=GO2W,
        parameters=replace(GO2W.parameters["gauge"], **stiff),
        terrains=(Terrain(name="flat", family="flat"),),
        terrain_index=(0, 0),
        physics=PhysicsOptions(torque_limits=True, torque_speed_limit=True),
    )
    backend = make_backend("mujoco", scene)
    start = torch.tensor([[0.0, 0.0, 0.42]] * 2, dtype=backend.dtype)
    backend.reset(ResetState(base_position=start, base_quaternion=torch.eye(4, dtype=backend.dtype)[:1].repeat(2, 1)))
    target = torch.tensor([GO2W.default_joint_position] * 2, dtype=backend.dtype)
    target[:, 12:] = torch.tensor([[6.0], [-6.0]])
    begin: list[torch.Tensor] = []
    for step in range(50):
        backend.step(target)
        if step == 24:  # legs sway while the robot gains speed
            begin = [backend.state.joint_position.clone(), backend.state.base_position_w.clone()]
    turned = (backend.state.joint_position - begin[0])[:, 12:].mean(1) / 0.5
    # kd 0.5 against damping of 0.1, dry friction of 0.2 N·m and 0.001 m under a quarter of 188 N: (3 − 0.25) / 0.6 = 4.59 rad/s
    torch.testing.assert_close(turned, torch.tensor([4.59, -4.59], dtype=backend.dtype), atol=0.1, rtol=0.0)
    way = (backend.state.base_position_w - begin[1])[:, 0] / 0.5
    torch.testing.assert_close(way, RADIUS * turned, atol=0.02, rtol=0.0)


def test_a_policy_sees_no_angle_of_a_wheel_and_gives_its_speed():
    contract = standard_contract(GO2W)
    assert contract.velocity_joints == GO2W.velocity_joints and contract.observation_width == 57
    (positions,) = (term for term in contract.observation if term.name == "joint_position")
    assert positions.scale == (1.0,) * 12 + (0.0,) * 4
    builder = ObservationBuilder(contract, GO2W, 1)
    assert builder.targets(torch.ones(1, 16))[0, 12:].tolist() == [5.0] * 4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"velocity_joints": ("FL_foot_joint",)},
            "gives targets of velocity to FL_foot_joint, robot 'go2w' takes them",
        ),
        ({"velocity_joints": ("wheel",)}, "velocity_joints names 'wheel', which is none of joint_names"),
        ({"default_joint_position": (0.1,) * 16}, "default_joint_position of 'FL_foot_joint' is 0.1; of velocity"),
    ],
)
def test_contracts_with_other_wheels_are_refused(change, said):
    with pytest.raises(ContractError, match=said):
        check_robot(replace(standard_contract(GO2W), **change), GO2W)


def test_robots_with_wrong_wheels_are_refused():
    with pytest.raises(RobotError, match="velocity_joints names 'wheel', which is none of joint_names"):
        checked_fields(replace(GO2W, velocity_joints=("wheel",)), "here")
    with pytest.raises(
        RobotError, match=r"default_joint_position of 'FL_hip_joint' is 0.1; of velocity_joints it is 0"
    ):
        checked_fields(replace(GO2, velocity_joints=("FL_hip_joint",)), "here")


def test_an_engine_without_targets_of_velocity_says_so():
    scene = Scene(
        robot=GO2W,
        parameters=GO2W.parameters["gauge"],
        terrains=(Terrain(name="flat", family="flat"),),
        terrain_index=(0,),
    )
    with pytest.raises(BackendError, match=r"engine 'fake' has no targets of velocity, which FL_foot_joint.*--backend"):
        make_backend("fake", scene)
