"""Policies with wheels as other projects describe them: targets of velocity, angles that the network does not see."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import ContractError, check_robot, standard_contract
from gaitgauge.policy.export.files import ExportError, deploy_settings
from gaitgauge.policy.foreign.deploy_yaml import read_deploy
from gaitgauge.policy.foreign.described import described_contract, template
from gaitgauge.policy.foreign.isaac_lab import read_env
from gaitgauge.policy.foreign.rl_sar import read_rl_sar
from gaitgauge.robots import load_robot

GO2W, GO2 = load_robot("go2w"), load_robot("go2")
LEGS, WHEELS = list(GO2W.joint_names[:12]), list(GO2W.joint_names[12:])
ISAAC = "isaaclab.envs.mdp.actions.joint_actions:"


def test_a_deploy_file_keeps_legs_and_wheels():
    contract = standard_contract(GO2W)
    settings = deploy_settings(contract, GO2W)
    wheels = settings["actions"]["JointVelocityAction"]
    assert wheels["joint_ids"] == [12, 13, 14, 15] and wheels["scale"] == [5.0] * 4 and wheels["offset"] == [0.0] * 4
    again = read_deploy(settings, Path("deploy.yaml"), GO2W)
    for name in ("joint_names", "velocity_joints", "action_scale", "stiffness", "damping", "target_range"):
        assert getattr(again, name) == getattr(contract, name), name
    assert next(t for t in again.observation if t.name == "joint_position").scale == (1.0,) * 12 + (0.0,) * 4
    settings["actions"] = dict(reversed(settings["actions"].items()))
    with pytest.raises(
        PolicyError, match=r"has actions for FL_foot_joint, .*, in this order; its joint_ids_map has FL_hip"
    ):
        read_deploy(settings, Path("deploy.yaml"), GO2W)
    again = deploy_settings(contract, GO2W)
    again["actions"]["JointVelocityAction"]["joint_ids"] = [12, 13, 14, 16]
    with pytest.raises(
        PolicyError, match=r"drives the joints \[12, 13, 14, 16\]; its joint_ids_map has 16, from 0 to 15"
    ):
        read_deploy(again, Path("deploy.yaml"), GO2W)
    with pytest.raises(
        PolicyError, match="as wheels are, and robot 'go2' takes targets of angle alone; choose another"
    ):
        read_deploy(
            deploy_settings(standard_contract(GO2), GO2) | {"actions": {"JointVelocityAction": {}}}, Path("d"), GO2
        )
    mixed = replace(contract, joint_names=(*WHEELS, *LEGS), default_joint_position=(0.0,) * 4 + (0.1,) * 12)
    with pytest.raises(ExportError, match="drives legs first and wheels last"):
        deploy_settings(mixed, GO2W)


def test_lists_of_the_legs_alone_get_the_robots_own_wheels():
    """The wheels' action numbers four joints behind the twelve of all lists; no list says their gains."""
    settings = deploy_settings(standard_contract(GO2), GO2)
    settings["actions"]["JointVelocityAction"] = {
        "joint_names": [".*_wheel_joint"], "joint_ids": [12, 13, 14, 15], "scale": 5.0, "offset": 0.0, "clip": None
    }  # fmt: skip
    for term in settings["observations"].values():
        if len(term["scale"]) == 12:
            term["scale"] = term["scale"][:1]
    contract = read_deploy(settings, Path("deploy.yaml"), None)
    assert contract.joint_names == (*LEGS, "FR_foot_joint", "FL_foot_joint", "RR_foot_joint", "RL_foot_joint")
    assert set(contract.velocity_joints) == set(WHEELS) and contract.action_scale == (0.25,) * 12 + (5.0,) * 4
    assert contract.stiffness == (20.0,) * 12 + (0.0,) * 4 and contract.damping == (0.5,) * 16
    assert contract.default_joint_position[12:] == (0.0,) * 4
    assert contract.provenance["assumed"] == (
        "robot 'go2w', the only one with wheels; gains of the wheels of robot 'go2w', because its lists hold 12 joints"
    )
    with pytest.raises(PolicyError, match="as wheels are, and robot 'go2' takes targets of angle alone"):
        read_deploy(settings, Path("deploy.yaml"), GO2)
    settings["actions"]["JointVelocityAction"]["joint_ids"] = [12, 13, 14]
    with pytest.raises(PolicyError, match=r"every number from 0 to 15 is needed once for robot 'go2w'"):
        read_deploy(settings, Path("deploy.yaml"), GO2W)


def test_wheels_that_are_taken_for_legs_are_refused():
    """Other projects give wheels a stiffness of zero; as targets of angle their actions would move nothing."""
    legs = replace(standard_contract(GO2), stiffness=(0.0, *(20.0,) * 11))
    with pytest.raises(
        ContractError, match="stiffness of 'FL_hip_joint' is 0, so that its target of angle moves nothing"
    ):
        check_robot(legs, GO2)
    check_robot(standard_contract(GO2W), GO2W)


def test_a_contract_that_is_written_for_a_robot_with_wheels_names_them(tmp_path):
    path = tmp_path / "contract.toml"
    path.write_text(template(GO2W))
    assert 'velocity_joints = ["FL_foot_joint", "FR_foot_joint"' in path.read_text()
    assert described_contract(path, None).hash == standard_contract(GO2W).hash


def settings_of_rl_sar(folder):
    numbered = [*LEGS[3:6], *LEGS[:3], *LEGS[9:], *LEGS[6:9], WHEELS[1], WHEELS[0], WHEELS[3], WHEELS[2]]
    base = {"dt": 0.005, "decimation": 4, "joint_names": numbered, "joint_mapping": list(range(16))}
    (folder / "base.yaml").write_text(yaml.safe_dump({"go2w": base}))
    settings = {
        "observations": ["ang_vel", "gravity_vec", "commands", "dof_pos", "dof_vel", "actions"],
        "ang_vel_scale": 0.25, "dof_pos_scale": 1.0, "dof_vel_scale": 0.05, "commands_scale": [1.0, 1.0, 1.0],
        "clip_obs": 100.0, "rl_kp": [20.0] * 12 + [0.0] * 4, "rl_kd": [0.5] * 16, "action_scale": [0.25] * 12 + [5.0] * 4,
        "default_dof_pos": [0.0, 0.8, -1.5] * 4 + [0.0] * 4, "wheel_indices": [12, 13, 14, 15],
    }  # fmt: skip
    return settings, tuple(numbered)


def test_rl_sar_shows_no_angles_of_wheels(tmp_path):
    settings, numbered = settings_of_rl_sar(tmp_path)
    contract = read_rl_sar({"go2w/robot_lab": settings}, tmp_path / "config.yaml", None)
    assert contract.joint_names == numbered and set(contract.velocity_joints) == set(WHEELS)
    assert contract.action_scale[12:] == (5.0,) * 4 and contract.observation_width == 57
    assert next(t for t in contract.observation if t.name == "joint_position").scale == (1.0,) * 12 + (0.0,) * 4
    with pytest.raises(PolicyError, match=r"and robot 'go2w' takes such targets for FL_foot_joint, .*; choose another"):
        read_rl_sar({"go2w/robot_lab": settings | {"wheel_indices": [12]}}, tmp_path / "config.yaml", None)


def run_of_isaac_lab(**changes):
    """Settings as robot_lab leaves them: right legs first, wheels last, and terms by joint in that order."""
    order = [*LEGS[3:6], *LEGS[:3], *LEGS[9:], *LEGS[6:9], WHEELS[1], WHEELS[0], WHEELS[3], WHEELS[2]]
    mine = {"joint_names": order, "preserve_order": True}

    def term(function, **params):
        return {"func": f"mdp.observations:{function}", "params": params, "scale": None, "clip": None}

    terms = {"base_ang_vel": term("base_ang_vel"), "joint_pos": term("joint_pos_rel_without_wheel", asset_cfg=mine)}
    terms |= {"joint_vel": term("joint_vel_rel", asset_cfg=mine), "actions": term("last_action")} | changes
    motors = {
        "joint_names_expr": [".*"],
        "stiffness": {".*_(hip|thigh|calf)_joint": 25.0, ".*_foot_joint": 0.0},
        "damping": 0.5,
    }
    leg = {
        "class_type": f"{ISAAC}JointPositionAction",
        "joint_names": order[:12],
        "preserve_order": True,
        "scale": 0.25,
    }
    wheel = {
        "class_type": f"{ISAAC}JointVelocityAction",
        "joint_names": order[12:],
        "preserve_order": True,
        "scale": 5.0,
    }
    data = {
        "sim": {"dt": 0.005}, "decimation": 4, "observations": {"policy": terms}, "commands": {},
        "actions": {"joint_pos": leg, "joint_vel": wheel},
        "scene": {"robot": {
            "spawn": {"asset_path": "robots/go2w.urdf"}, "actuators": {"legs": motors},
            "init_state": {"joint_pos": {".*_thigh_joint": 0.8, ".*_calf_joint": -1.5}},
        }},
    }  # fmt: skip
    return data, tuple(order)


def test_isaac_labs_runs_keep_their_own_order_of_joints():
    data, order = run_of_isaac_lab()
    contract = read_env(data, Path("env.yaml"), None)
    assert contract.joint_names == order and contract.velocity_joints == tuple(WHEELS)
    assert contract.action_scale == (0.25,) * 12 + (5.0,) * 4 and contract.stiffness == (25.0,) * 12 + (0.0,) * 4
    assert contract.default_joint_position == (0.0, 0.8, -1.5) * 4 + (0.0,) * 4
    assert contract.observation[1].scale == (1.0,) * 12 + (0.0,) * 4
    bare = {"func": "mdp.observations:joint_vel_rel", "params": {}, "scale": None}
    with pytest.raises(PolicyError, match="order of its own, and the observation 'joint_vel' does not have it"):
        read_env(run_of_isaac_lab(joint_vel=bare)[0], Path("env.yaml"), None)
