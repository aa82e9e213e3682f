"""What the feet of a biped do, against MuJoCo's kinematics and by hand; its policy drives the legs and sees a clock."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.policy.export.files import ExportError, deploy_settings
from gaitgauge.policy.robot_of import REMEMBERED
from gaitgauge.robots import load_robot
from gaitgauge.robots.anatomy.body_plan import default_pose
from gaitgauge.robots.loading import robot_digest
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment.configuration import GaitConfiguration
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.feet import FootReader
from gaitgauge.training.environment.gait_rewards import pose_weights
from gaitgauge.training.environment.policy_interface import driven_robot, joints_of, training_contract
from gaitgauge.training.environment.reward_configuration import PoseWeights, RewardConfiguration
from gaitgauge.training.environment.terminations import TERMINATIONS
from gaitgauge.training.tasks import find_task

G1 = load_robot("g1")
CPU = torch.device("cpu")
QUIET = ["environment.push.interval=0", "environment.reset.joint_scale=1,1", "environment.reset.velocity=0"]


def reader(**gait):
    return FootReader(RewardConfiguration(), GaitConfiguration(**gait), robot=G1, period=0.02, device=CPU)


def turned(quaternion):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def test_tilt_is_the_angle_of_the_soles():
    random = np.random.default_rng(3)
    pose = np.array(G1.default_joint_position) + random.uniform(-0.4, 0.4, G1.num_joints)
    base = random.normal(size=4) * 0.2 + [1.0, 0.0, 0.0, 0.0]
    base /= np.linalg.norm(base)
    model, data = default_pose(G1)
    level = [data.body(f"{side}_ankle_roll_link").xmat.reshape(3, 3).T @ [0, 0, 1] for side in ("left", "right")]
    data.qpos[3:7] = base
    for name, angle in zip(G1.joint_names, pose, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    feet = [data.body(f"{side}_ankle_roll_link").xmat.reshape(3, 3) for side in ("left", "right")]
    sines = [1.0 - (foot @ up)[2] ** 2 for foot, up in zip(feet, level, strict=True)]
    state = SimpleNamespace(
        joint_position=torch.tensor(pose)[None].float(), base_quaternion_w=torch.tensor(base)[None].float()
    )
    assert reader()._soles.tilt(state)[0].tolist() == pytest.approx(sines, abs=1e-5)
    assert max(sines) > 0.05


def test_distance_across_the_heading():
    """Feet 0.3 m apart to the left of a heading of 30 degrees, one 0.2 m ahead; then crossed."""
    forward, left = torch.tensor([0.75**0.5, 0.5]), torch.tensor([-0.5, 0.75**0.5])
    places = torch.stack((0.2 * forward + 0.3 * left, torch.zeros(2)))[None]
    places = torch.cat((places, places.flip(1)))
    state = SimpleNamespace(
        foot_contact_force_w=torch.tensor([[[0.0, 0.0, 9.0], [0.0, 0.0, 1.0]]] * 2),
        foot_position_w=torch.cat((places, torch.zeros(2, 2, 1)), dim=2),
        joint_position=torch.tensor([G1.default_joint_position] * 2),
        base_quaternion_w=torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
    )
    memory = SimpleNamespace(foot_air_time=torch.full((2, 2), 0.1), foot_contact_time=torch.full((2, 2), 0.2))
    feet = reader()(state, memory, torch.full((2, 2), 0.05), forward.expand(2, 2))
    assert feet.apart.tolist() == pytest.approx([0.3, -0.3])
    assert feet.contact.tolist() == [[True, False]] * 2
    assert feet.air_time[0].tolist() == pytest.approx([0.0, 0.12])
    assert feet.contact_time[0].tolist() == pytest.approx([0.22, 0.0])
    assert feet.tilt.abs().max() < 1e-6
    # a standing foot's centre, between two bars of 12 mm radius, is 12 mm up
    assert feet.clearance.flatten().tolist() == pytest.approx([0.038] * 4, abs=1e-3)


@pytest.mark.parametrize(
    ("steps", "command", "swing", "heights"),
    [
        (0, 0.5, [False, False], [0.0, 0.0]),
        (10, 0.5, [False, True], [0.0, 0.1]),  # a quarter: the right foot's step is half done
        (15, 0.5, [False, True], [0.0, 0.05]),
        (30, 0.5, [True, False], [0.1, 0.0]),
        (10, 0.05, [False, False], [0.0, 0.0]),
    ],
)
def test_a_clock_asks_for_steps_in_turn(steps, command, swing, heights):
    memory = SimpleNamespace(clocks=torch.tensor([[0.0, steps, 0.0]]), command=torch.tensor([[command, 0.0, 0.0]]))
    found, wanted = reader(period=0.8, swing_share=0.5, swing_height=0.1)._steps(memory)
    assert found.tolist() == [swing] and wanted[0].tolist() == pytest.approx(heights, abs=1e-6)


def test_weights_go_by_role():
    weights = dict(
        zip(G1.joint_names, pose_weights(PoseWeights(hip_yaw=3.0, ankle=0.5, arm=2.0), G1, CPU).tolist(), strict=True)
    )
    assert weights["left_hip_yaw_joint"] == 3.0 and weights["right_ankle_roll_joint"] == 0.5
    assert weights["left_elbow_joint"] == weights["right_wrist_yaw_joint"] == 2.0
    assert weights["left_knee_joint"] == 0.0 and weights["waist_pitch_joint"] == 1.0


@pytest.mark.parametrize(
    ("settings", "joints"), [("rigid=True", 12), ("rigid=False", 29), ("moving=waist", 15), ("moving=waist_yaw", 13)]
)
def test_the_walk_holds_arms_and_sees_its_clock(settings, joints):
    task = find_task("g1-walk", ["environment.num_envs=2", f"environment.joints.{settings}", *QUIET])
    env = TrainingEnvironment(task.environment, backend="mujoco", device="cpu")
    try:
        assert env.backend.state.joint_position.shape == (2, joints)
        assert env.num_actions == 12 and env.contract.joint_names == G1.joint_names[:12]
        assert [joint.name for joint in env.contract.held] == list(G1.joint_names[12:])
        with pytest.raises(ExportError, match="this policy leaves 17 to be held, as 'waist_yaw_joint'"):
            deploy_settings(env.contract, G1)
        env.parts.memory.command.copy_(torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]))
        env.parts.memory.command_steps.fill_(1000)
        env.parts.memory.clocks.zero_()
        for _ in range(11):
            seen = env.step(torch.zeros(2, 12))[0]["policy"][:, -4:]
        # after a quarter of 0.8 s the first robot's phases are a half and zero; the second one stands
        assert torch.allclose(seen[:1], torch.tensor([[0.0, 0.0, -1.0, 1.0]]), atol=1e-5)
        assert torch.allclose(seen[1:], torch.tensor([[0.0, 0.0, -1.0, -1.0]]), atol=1e-5)
        saved = env.state_dict()
        assert saved["memory"]["clocks"].amax() > 0
        env.parts.memory.begin_episode(torch.tensor([True, False]))
        assert env.parts.memory.clocks[0].amax() == 0
        env.load_state_dict(saved)
        assert torch.equal(env.parts.memory.clocks, saved["memory"]["clocks"])
    finally:
        env.close()


def test_a_low_base_ends_an_episode():
    settings = find_task("g1-walk").environment.termination
    inputs = SimpleNamespace(base_height=torch.tensor([0.44, 0.46]))
    assert TERMINATIONS["low"](inputs, settings).tolist() == [True, False]


def test_wrong_settings():
    walk = find_task("g1-walk").environment
    with pytest.raises(
        ConfigurationError, match=r"driven has 'tail', a role of no joint of robot 'g1'; its joints are: hip_"
    ):
        driven_robot(G1, find_task("g1-walk", ["environment.joints.driven=hip,tail"]).environment)
    with pytest.raises(ConfigurationError, match=r"moving has 'tail', a role of no joint of robot 'g1'"):
        joints_of(G1, ("waist", "tail"), "moving")
    with pytest.raises(ConfigurationError, match="offsets has 3 entries; robot 'g1' has 2 feet"):
        reader(period=0.5, offsets=(0.0, 0.2, 0.4))
    assert driven_robot(G1, walk).driven_joints == G1.joint_names[:12]


def test_a_policy_for_driven_legs_remembers_the_robot_as_it_is_described():
    contract = training_contract(G1, G1.parameters["training"], find_task("g1-walk").environment)
    assert contract.joint_names == G1.joint_names[:12]
    assert contract.provenance[REMEMBERED]["digest"] == robot_digest(G1)
