"""Descriptions that other projects write, and checkpoints of their trainings: made here, with random weights.

The actions are those of the network on observations made by hand, as the description says.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
import yaml
from foreign_play import (
    DEFAULT,
    EPISODES,
    GO2,
    ISAAC,
    SDK_OF_ISAAC,
    STANDING,
    UNIT,
    Step,
    TwoArguments,
    check,
    deploy,
    described,
    isaac,
    last_frames,
    layers_of,
    network,
    newest,
    save_onnx,
    script,
    simply,
    standard,
    tensors,
    term_major,
)
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.export.files import deploy_settings
from gaitgauge.policy.foreign.adapters import described as described_in_words
from gaitgauge.policy.foreign.deploy_yaml import read_deploy
from gaitgauge.policy.foreign.mjlab import mjlab_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from onnx import helper
from scipy.spatial.transform import Rotation
from torch import nn

pytestmark = pytest.mark.usefixtures("programs_run_here")


def test_a_deploy_file_beside_a_script(tmp_path):
    """With the tag that unitree_rl_lab's exporter leaves in it."""
    module = network(45)
    text = deploy().replace("joint_ids: null", "joint_ids: !!python/object/apply:builtins.slice [null, null, null]")
    (tmp_path / "deploy.yaml").write_text(text)
    policy = load_policy(script(tmp_path / "policy.pt", module))
    assert policy.contract.joint_names == ISAAC
    assert policy.contract.command_limits == (1.0, 0.4, 1.0)
    assert described_in_words(policy.contract) == "is run as 'deploy.yaml' says"
    check(policy, isaac, newest, simply(module))


def test_a_deploy_file_with_a_gait_phase_and_an_offset(tmp_path):
    module = network(47)
    phase = {"gait_phase": {"params": {"period": 0.8}, "clip": None, "scale": 1.0, "history_length": 1}}
    (tmp_path / "deploy.yaml").write_text(deploy(terms=phase, action={"offset": [0.0] * 4 + [0.9] * 4 + [-1.8] * 4}))
    policy = load_policy(script(tmp_path / "policy.pt", module))

    def frame(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
        angle = 2 * np.pi * age * 0.02 / 0.8
        return [*isaac(step, last, age), np.tile([np.sin(angle), np.cos(angle)], (EPISODES, 1))]

    check(policy, frame, newest, simply(module))
    targets = ObservationBuilder(policy.contract, GO2, 1).targets(torch.ones(1, 12))[0]
    np.testing.assert_allclose(targets[:3], [0.25, 1.15, -1.55], atol=1e-6)


def test_a_gait_phase_of_unitree_rl_mjlab_is_zero_at_rest(tmp_path):
    phase = {"gait_phase": {"params": {"period": 0.6}, "clip": None, "scale": 1.0, "history_length": 1}}
    data = yaml.safe_load(deploy(terms=phase))
    found = [read_deploy(data, tmp_path / "deploy.yaml", GO2, of_mjlab=mjlab) for mjlab in (False, True)]
    assert [contract.observation[-1].at_rest for contract in found] == ["runs", "zeros"]
    assert found[1].provenance["assumed"] == "the gait phase is zero at rest, as unitree_rl_mjlab has it"


def test_histories_of_different_lengths_in_a_deploy_file(tmp_path):
    module = network(45 + 2 * 3 + 4 * 12)
    speeds = {"params": {}, "clip": None, "scale": 0.05, "history_length": 5}
    turning = {"params": {}, "clip": None, "scale": 0.2, "history_length": 3}
    (tmp_path / "deploy.yaml").write_text(deploy(terms={"base_ang_vel": turning, "joint_vel_rel": speeds}))
    policy = load_policy(script(tmp_path / "policy.pt", module))

    def stack(frames: list) -> np.ndarray:
        kept = [frames[0]] * (5 - len(frames)) + frames[-5:]  # such a history begins with copies of the first frame
        lengths = [3, 1, 1, 1, 5, 1]
        return np.concatenate([kept[-n + j][i] for i, n in enumerate(lengths) for j in range(n)], axis=1)

    check(policy, isaac, stack, simply(module))


def test_the_only_robot_with_a_descriptions_joints_is_taken():
    g1 = load_robot("g1")
    own = standard_contract(g1)
    contract = read_deploy(deploy_settings(own, g1), Path("deploy.yaml"), None)
    assert contract.joint_names == own.joint_names
    assert contract.provenance["assumed"] == "robot 'g1', the only one with 29 joints"
    metadata = {
        "joint_names": ",".join(own.joint_names),
        "observation_names": "joint_pos,actions",
        "action_scale": "0.5",
    }
    for key, values in (
        ("default_joint_pos", own.default_joint_position),
        ("joint_stiffness", own.stiffness),
        ("joint_damping", own.damping),
    ):
        metadata[key] = ",".join(map(str, values))
    found = mjlab_contract(metadata, None, source="policy.onnx")
    assert found.robot == "g1" and found.provenance["assumed"].startswith(
        "robot 'g1', the only one with its joints, control"
    )


def test_what_a_deploy_file_asks_for_in_vain_is_named(tmp_path):
    (tmp_path / "deploy.yaml").write_text(deploy(terms={"camera": {"params": {}, "scale": 1.0}}))
    with pytest.raises(PolicyError, match="asks for the observation 'camera'; supported are"):
        load_policy(script(tmp_path / "policy.pt", network(45)))


def test_two_descriptions_that_disagree(tmp_path):
    (tmp_path / "params").mkdir()
    (tmp_path / "deploy.yaml").write_text(deploy())
    (tmp_path / "params" / "deploy.yaml").write_text(deploy(action={"scale": 0.5}))
    path = script(tmp_path / "policy.pt", network(45))
    with pytest.raises(
        PolicyError, match=r"that disagree on action_scale of FL_hip_joint \(0.25 and 0.5\); say which is right"
    ):
        load_policy(path)
    assert load_policy(path, contract_file=tmp_path / "params" / "deploy.yaml").contract.action_scale == (0.5,) * 12
    (tmp_path / "contract.toml").write_text("action_scale = 0.4")
    assert load_policy(path).contract.provenance["assumed"] == (
        f"contract.toml is used, and not {tmp_path / 'deploy.yaml'}, which differs in the order of the joints "
        "(FL_hip_joint, FL_thigh_joint, FL_calf_joint … and FL_hip_joint, FR_hip_joint, RL_hip_joint …)"
    )
    (tmp_path / "strange.yaml").write_text("a: 1")
    with pytest.raises(PolicyError, match=r"is no description of a policy that is understood: contract\.toml, "):
        load_policy(path, contract_file=tmp_path / "strange.yaml")


RL_SAR = """{name}:
  model_name: policy.pt
  observations: [commands, ang_vel, gravity_vec, dof_pos, dof_vel, actions]
  observations_history: {frames}
  observations_history_priority: {priority}
  clip_obs: 100.0
  clip_actions_lower: [-100, -100]
  clip_actions_upper: [100, 100]
  rl_kp: [40, 40, 40, 40, 40, 40, 40, 40, 40, 40, 40, 40]
  rl_kd: [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
  action_scale: [0.125, 0.25, 0.25, 0.125, 0.25, 0.25, 0.125, 0.25, 0.25, 0.125, 0.25, 0.25]
  wheel_indices: {wheels}
  ang_vel_scale: 0.25
  dof_pos_scale: 1.0
  dof_vel_scale: 0.05
  commands_scale: [2.0, 2.0, 0.25]
  default_dof_pos: [0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]
  joint_mapping: [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
  dreamwaq_two_inputs: {two}
"""


def rl_sar(folder: Path, *, name="go2/himloco", frames="[0, 1, 2]", priority="time", wheels="[]", two="false") -> None:
    text = RL_SAR.format(name=name, frames=frames, priority=priority, wheels=wheels, two=two)
    (folder / "config.yaml").write_text(text)
    base = {"dt": 0.005, "decimation": 4, "joint_names": list(GO2.sdk_joint_names or ())}
    (folder / "base.yaml").write_text(yaml.safe_dump({name.partition("/")[0]: base}))


def himloco(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
    joints = step.joints - DEFAULT
    return [step.command * [2.0, 2.0, 0.25], 0.25 * step.turning, step.gravity, joints, 0.05 * step.speeds, last]


@pytest.mark.parametrize("priority", ["time", "term"])
def test_rl_sars_settings(tmp_path, priority):
    """Frame 0 is the present one; joints go from the SDK's order into the policy's."""
    module = network(135)
    rl_sar(tmp_path, priority=priority)
    policy = load_policy(script(tmp_path / "himloco.pt", module))
    assert policy.contract.joint_names == GO2.joint_names
    assert policy.contract.action_clip == 100.0
    assert policy.contract.provenance["assumed"] == "command limits of robot 'go2', the history begins with zeros"

    def stack(frames: list) -> np.ndarray:
        if priority == "term":
            return term_major(frames, 3, newest_first=True)
        return np.concatenate([t for frame in last_frames(frames, 3)[::-1] for t in frame], axis=1)

    check(policy, himloco, stack, simply(module))


def test_rl_sars_policy_of_two_inputs(tmp_path):
    module = TwoArguments()
    rl_sar(tmp_path, frames="[4, 3, 2, 1, 0]", priority="term", two="true")
    both = lambda x, first: module(x[:, :45], x[:, 45:])  # noqa: E731
    policy = load_policy(script(tmp_path / "policy.pt", module))
    check(policy, himloco, lambda f: np.concatenate((newest(f), term_major(f, 5)), axis=1), both)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"name": "lite3/himloco"},
            "describes a policy for robot 'lite3', which is not installed (there are anymal_c, g1, go1, go2",
        ),
        ({"wheels": "[3]"}, "drives joints by velocity (FR_hip_joint), as wheels are"),
        (
            {"frames": "[0, 2, 1]"},
            "has observations_history [0, 2, 1]; all frames from 0, in order or reversed, are supported",
        ),
    ],
)
def test_rl_sars_settings_that_cannot_be_played(tmp_path, changes, sentence):
    rl_sar(tmp_path, **changes)
    with pytest.raises(PolicyError) as caught:
        load_policy(script(tmp_path / "policy.pt", network(135)))
    assert sentence in str(caught.value)


def test_a_description_of_another_robot_is_refused(tmp_path):
    """A B2 has the Go2's joints, and a Go2 as which it is asked for would be played with its gains."""
    rl_sar(tmp_path, name="b2/robot_lab")
    with pytest.raises(
        PolicyError, match=r"describes a policy for robot 'b2', not for 'go2'; give that robot's robot\.toml with"
    ):
        load_policy(script(tmp_path / "policy.pt", network(135)), GO2)
    mine = replace(GO2, name="b2_mine")
    assert load_policy(tmp_path / "policy.pt", mine).contract.robot == "b2_mine"


@pytest.mark.parametrize("by_motor", [True, False])
def test_the_settings_of_unitree_rl_gym(tmp_path, by_motor):
    """Default angles in the policy's order, or by motor as one such file has them."""
    module = network(47)
    by_number = [-0.1, 0.8, -1.5, 0.1, 0.8, -1.5, -0.1, 1.0, -1.5, 0.1, 1.0, -1.5]
    settings = {
        "leg_joint2motor_idx": SDK_OF_ISAAC, "default_angles": by_number if by_motor else STANDING,
        "kps": [25.0] * 12, "kds": [0.5] * 12, "control_dt": 0.02, "ang_vel_scale": 0.2, "dof_pos_scale": 1.0,
        "dof_vel_scale": 0.05, "action_scale": 0.25, "cmd_scale": [1.0, 1.0, 1.0], "num_actions": 12, "num_obs": 47,
        "max_cmd": [1.0, 0.4, 1.0],
    }  # fmt: skip
    (tmp_path / "go2_walk.yaml").write_text(yaml.safe_dump(settings))
    policy = load_policy(script(tmp_path / "policy.pt", module))
    assert policy.contract.default_joint_position == tuple(STANDING)

    def frame(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
        angle = 2 * np.pi * age * 0.02 / 0.8
        return [*isaac(step, last, age), np.tile([np.sin(angle), np.cos(angle)], (EPISODES, 1))]

    check(policy, frame, newest, simply(module))
    (tmp_path / "go2_walk.yaml").write_text(yaml.safe_dump(settings | {"num_obs": 52}))
    with pytest.raises(
        PolicyError, match="has num_obs 52; 45 entries a frame, or 47 with a gait clock, are understood"
    ):
        load_policy(tmp_path / "policy.pt")


def test_metadata_of_holosoma(tmp_path):
    module = network(49)
    robot = replace(GO2, name="g1")
    path = save_onnx(
        tmp_path / "p.onnx", layers_of("a", "o", "action"), {"o": [1, 49]}, {"action": [1, 12]}, tensors(module, "a")
    )
    model = onnx.load(path)
    values = {"dof_names": GO2.joint_names, "kp": [30.0] * 12, "kd": [1.0] * 12, "action_scale": 0.25}
    helper.set_model_props(model, {key: json.dumps(value) for key, value in values.items()})
    onnx.save(model, path)
    with pytest.raises(PolicyError, match='describes a policy for robot "holosoma\'s robot", which is not installed'):
        load_policy(path)
    policy = load_policy(path, robot)

    def frame(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
        """The terms in the order of their names; a robot that stands has both clocks at half a cycle."""
        resting = np.linalg.norm(step.command, axis=1) < 0.1
        moving[:] = 0 if age == 0 else moving
        angle = (
            2 * np.pi * (np.where(resting, 0.5, moving * 0.02)[:, None] + np.where(resting[:, None], 0.0, [0.0, 0.5]))
        )
        moving[:] = np.where(resting, 0, moving + 1)
        command = (step.command[:, 2:], step.command[:, :2])
        joints = step.joints - DEFAULT
        waves = np.cos(angle), np.sin(angle)
        return [last, 0.25 * step.turning, *command, waves[0], joints, 0.05 * step.speeds, step.gravity, waves[1]]

    moving = np.zeros(EPISODES)
    check(policy, frame, newest, simply(module), robot=robot)


# ---- checkpoints -----------------------------------------------------------------------------------------------------


def env_yaml() -> str:
    """What Isaac Lab writes of a run, but for what no policy needs."""

    def term(function: str, **more: Any) -> dict[str, Any]:
        return {"func": f"isaaclab.envs.mdp.observations:{function}", "params": {}, "scale": None, "clip": None} | more

    terms = {
        "concatenate_terms": True, "history_length": None, "base_lin_vel": term("base_lin_vel"),
        "base_ang_vel": term("base_ang_vel", scale=0.2, clip=[-50.0, 50.0]), "projected_gravity": term("projected_gravity"),
        "velocity_commands": term("generated_commands"), "joint_pos": term("joint_pos_rel"),
        "joint_vel": term("joint_vel_rel", scale=0.05), "actions": term("last_action"), "height_scan": None,
    }  # fmt: skip
    pose = {
        ".*L_hip_joint": 0.1,
        ".*R_hip_joint": -0.1,
        "F[L,R]_thigh_joint": 0.8,
        "R[L,R]_thigh_joint": 1.0,
        ".*_calf_joint": -1.5,
    }
    motors = {
        "joint_names_expr": [".*"],
        "stiffness": 25.0,
        "damping": {".*_calf_joint": 0.6, ".*_(hip|thigh)_joint": 0.5},
    }
    action = {
        "class_type": "isaaclab.envs.mdp.actions.joint_actions:JointPositionAction", "joint_names": [".*"],
        "scale": {".*_hip_joint": 0.125, ".*_(thigh|calf)_joint": 0.25}, "use_default_offset": True, "clip": None,
    }  # fmt: skip
    data = {
        "sim": {"dt": 0.005},
        "decimation": 4,
        "scene": {
            "robot": {
                "spawn": {"usd_path": "https://server/Unitree/Go2/go2.usd"},
                "init_state": {"joint_pos": pose},
                "actuators": {"base_legs": motors},
            }
        },
        "observations": {"policy": terms},
        "actions": {"joint_pos": action},
        "commands": {
            "base_velocity": {"ranges": {"lin_vel_x": "X", "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-1.0, 1.0]}}
        },
    }
    return yaml.safe_dump(data, sort_keys=False).replace("lin_vel_x: X", "lin_vel_x: !!python/tuple [-1.5, 1.5]")


def isaac_48(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
    turn = Rotation.from_quat(step.state.base_quaternion_w.numpy(), scalar_first=True)
    return [turn.inv().apply(step.state.base_linear_velocity_w.numpy()), *isaac(step, last, age)]


def actor_state(module: nn.Sequential, prefix: str = "actor.") -> dict[str, torch.Tensor]:
    return {prefix + name: value for name, value in module.state_dict().items()}


def save(path: Path, weights: dict, *, key: str = "model_state_dict", **more: Any) -> Path:
    torch.save(
        {key: weights | {"std": torch.ones(12)}, "optimizer_state_dict": {}, "iter": 5, "infos": None, **more}, path
    )
    return path


STATISTICS = {
    "_mean": torch.linspace(-1, 1, 48)[None],
    "_std": torch.linspace(0.5, 2.0, 48)[None],
    "_var": torch.ones(1, 48),
}


def normalised(module: nn.Module) -> Callable:
    """rsl_rl divides by the standard deviation and 0.01."""
    return lambda x, first: module((x - STATISTICS["_mean"]) / (STATISTICS["_std"] + 0.01))


@pytest.mark.parametrize(
    ("key", "prefix", "inside"),
    [
        ("model_state_dict", "actor.", None),
        ("model_state_dict", "actor.", "actor_obs_normalizer."),
        ("model_state_dict", "student.", "student_obs_normalizer."),
        ("actor_state_dict", "mlp.", "obs_normalizer."),
        ("student_state_dict", "mlp.", "obs_normalizer."),
    ],
)
def test_a_checkpoint_in_isaac_labs_run(tmp_path, key, prefix, inside):
    """48 inputs as env.yaml says, the activation and the clip of agent.yaml, the normaliser inside or apart as rsl_rl 2 has it."""
    module = network(48)
    module[1] = nn.SiLU()
    (tmp_path / "params").mkdir()
    (tmp_path / "params" / "env.yaml").write_text(env_yaml())
    (tmp_path / "params" / "agent.yaml").write_text("clip_actions: 2.0\npolicy: {activation: swish}\n")
    state = actor_state(module, prefix) | ({} if inside is None else {inside + k: v for k, v in STATISTICS.items()})
    apart = {"obs_norm_state_dict": STATISTICS} if inside is None else {}
    policy = load_policy(save(tmp_path / "model_5.pt", state, key=key, **apart))
    contract = policy.contract
    assert contract.joint_names == ISAAC
    assert contract.command_limits == (1.5, 0.5, 1.0)
    assert contract.action_scale == (0.125,) * 4 + (0.25,) * 8
    assert contract.damping == (0.5,) * 8 + (0.6,) * 4
    assert (contract.stiffness, contract.action_clip) == ((25.0,) * 12, 2.0)
    assert "assumed: joints nearest to the base first" in str(described_in_words(contract))
    check(policy, isaac_48, newest, normalised(module), clip=2.0)


def test_a_checkpoint_that_a_contract_describes(tmp_path):
    """Order and scales of the contract count, and its width."""
    module = network(45)
    described(
        tmp_path,
        f"joint_names = {json.dumps(ISAAC)}\n"
        + UNIT.replace('"joint_velocity"', '"joint_velocity", scale = 0.05').replace(
            '"base_angular_velocity_b"', '"base_angular_velocity_b", scale = 0.2'
        ),
    )
    policy = load_policy(save(tmp_path / "model_300.pt", actor_state(module)))
    check(policy, isaac, newest, simply(module))
    assert described_in_words(policy.contract) == "is run as 'contract.toml' says"
    save(tmp_path / "model_300.pt", actor_state(network(48)))
    with pytest.raises(
        PolicyError, match="has an actor of 48 inputs and 12 outputs; but its contract's observation has 45"
    ):
        load_policy(tmp_path / "model_300.pt")
    (tmp_path / "contract.toml").unlink()
    with pytest.raises(PolicyError, match="without a contract only 45 and 12 are understood; give one with --contract"):
        load_policy(tmp_path / "model_300.pt")


def test_a_checkpoint_with_the_deploy_file_of_its_run(tmp_path):
    module = network(45)
    (tmp_path / "params").mkdir()
    (tmp_path / "params" / "deploy.yaml").write_text(deploy())
    policy = load_policy(save(tmp_path / "model_300.pt", actor_state(module)))
    assert policy.contract.provenance["adapter"] == "deploy.yaml"
    check(policy, isaac, newest, simply(module))


@pytest.mark.parametrize("prefix", ["memory_a.rnn.", "memory_s.rnn.", "rnn.rnn."])
@pytest.mark.parametrize("cell", [nn.LSTM, nn.GRU])
def test_a_recurrent_checkpoint(tmp_path, cell, prefix):
    """Its state is carried from step to step, and reset with the episode."""
    torch.manual_seed(1)
    rnn, actor = cell(45, 8, 2).requires_grad_(False), network(8)
    described(tmp_path, UNIT)
    name = "mlp." if prefix == "rnn.rnn." else "actor."
    weights = actor_state(actor, name) | {prefix + k: v for k, v in rnn.state_dict().items()}
    policy, memory = load_policy(save(tmp_path / "model_5.pt", weights)), [None]

    def run(x: torch.Tensor, first: bool) -> torch.Tensor:
        out, memory[0] = rnn(x[None], None if first else memory[0])
        return actor(out[0])

    check(policy, standard, newest, run)


def test_files_that_are_no_policy_say_what_to_give(tmp_path):
    torch.save(network(45).state_dict(), tmp_path / "actor.pt")
    with pytest.raises(
        PolicyError, match=r"holds weights alone \('0.weight' …\), not the network that they belong to; give"
    ):
        load_policy(tmp_path / "actor.pt")
    torch.save(network(45), tmp_path / "whole.pt")
    with pytest.raises(
        PolicyError, match=r"holds more than tensors and plain data .* export the policy as TorchScript or ONNX"
    ):
        load_policy(tmp_path / "whole.pt")
    (tmp_path / "params").mkdir()
    (tmp_path / "params" / "agent.yaml").write_text("policy: {activation: crelu}")
    with pytest.raises(PolicyError, match="names the activation 'crelu'; understood are elu, relu, "):
        load_policy(save(tmp_path / "model_1.pt", actor_state(network(45))))
