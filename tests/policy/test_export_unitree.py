"""The folder of the published C++ controller, and its files in the onnxruntime that runs on the robot."""

import subprocess
import venv
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
import yaml
from gaitgauge.cli.play_session import PlaySession
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.base import Policy, PolicySession
from gaitgauge.policy.contract import History, ObservationTerm, standard_contract
from gaitgauge.policy.export.files import deploy_settings, export_deploy, export_unitree, first_steps, term_major_order
from gaitgauge.policy.foreign.deploy_yaml import deploy_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import NativePolicy
from gaitgauge.robots import load_robot
from gaitgauge.terrains.registry import make_terrain

pytestmark = pytest.mark.usefixtures("programs_run_here")

STEPS = 50
RUNTIME = "onnxruntime==1.16.0"
RUN = """
import sys, numpy, onnxruntime
assert onnxruntime.__version__ == "1.16.0"
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
observations = numpy.load(sys.argv[2])
numpy.save(sys.argv[3], numpy.concatenate([session.run(["actions"], {"obs": o[None]})[0] for o in observations]))
"""
ROBOT = load_robot("go2")
torch.set_num_threads(1)


class Recorded(Policy):
    """The pretrained policy, told observations as the controller makes them; it remembers them and its actions."""

    def __init__(self, contract):
        own = load_policy("pretrained")
        start = replace(own.contract, history=History(start="repeat"))
        self.policy = NativePolicy(start, own.stored, path="pretrained")
        self.contract, self.path = contract, "pretrained"
        self.observations, self.actions = [], []

    def session(self, num_episodes, *, device="cpu"):
        return RecordedSession(self)


class RecordedSession(PolicySession):
    def __init__(self, recorded):
        self.recorded, self.own = recorded, recorded.policy.session(1)
        self.order = term_major_order(recorded.contract, recorded.contract.history.length)

    def reset(self, episodes=None):
        self.own.reset()

    def act(self, observation, rows=None):
        newest = observation[:, self.order][:, -self.recorded.contract.frame_width :]
        action = self.own.act(newest)
        self.recorded.observations.append(observation[0].numpy().copy())
        self.recorded.actions.append(action[0].numpy().copy())
        return action


def closed_loop(contract):
    """Observations (``STEPS``, 225) and actions (``STEPS``, 12) of the pretrained policy walking over waves in MuJoCo."""
    policy = Recorded(contract)
    suite = load_suite("gaitgauge-1")
    settings = {"backend": "mujoco", "device": "cpu", "friction": 0.6, "seed": 0, "suite": suite}
    session = PlaySession(policy, ROBOT, make_terrain("wave", 3), **settings)
    for step in range(STEPS):
        session.step((0.8, 0.0, 0.5 if step > STEPS // 2 else 0.0))
    session.close()
    assert session.falls == 0
    return np.array(policy.observations), np.array(policy.actions)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unitree")
    written = export_unitree(load_policy("pretrained"), folder, ROBOT)
    assert max(written.values()) <= 1e-5
    return folder


def test_layout(bundle):
    files = sorted(str(p.relative_to(bundle)) for p in bundle.rglob("*") if p.is_file())
    assert files == ["exported/policy.onnx", "params/deploy.yaml"]
    model = onnx.load(bundle / "exported" / "policy.onnx")
    assert model.ir_version == 8 and [(o.domain, 11 <= o.version <= 17) for o in model.opset_import] == [("", True)]
    text = (bundle / "params" / "deploy.yaml").read_text()
    assert "&" not in text and "*id" not in text
    data = yaml.safe_load(text)
    assert data["joint_ids_map"] == [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    assert data["actions"]["JointPositionAction"]["clip"] == [[-100.0, 100.0]] * 12
    assert all(term["clip"] == [-100.0, 100.0] for term in data["observations"].values())


def test_wide_clips_change_nothing(bundle, tmp_path):
    export_deploy(load_policy("pretrained"), tmp_path / "deploy.yaml", ROBOT)
    plain, clipped = (deploy_contract(f, ROBOT) for f in (tmp_path / "deploy.yaml", bundle / "params" / "deploy.yaml"))
    assert plain.target_range is None and clipped.target_range == ((-100.0, 100.0),) * 12
    for left, right in zip(closed_loop(plain), closed_loop(clipped), strict=True):
        assert np.array_equal(left, right)


def test_clips_of_the_contract_stay():
    terms = [ObservationTerm(name=t.name, scale=t.scale, clip=None) for t in standard_contract(ROBOT).observation]
    terms[4] = replace(terms[4], clip=5.0)
    contract = replace(standard_contract(ROBOT), observation=tuple(terms), target_range=((-1.0, 2.0),) * 12)
    settings = deploy_settings(contract, ROBOT, finite_clips=True)
    assert settings["actions"]["JointPositionAction"]["clip"] == [[-1.0, 2.0]] * 12
    assert settings["observations"]["joint_vel_rel"]["clip"] == [-5.0, 5.0]
    assert settings["observations"]["base_ang_vel"]["clip"] == [-100.0, 100.0]


def test_what_the_controller_does_otherwise_at_first_is_said():
    own = load_policy("pretrained")
    zeros, repeating = (replace(own.contract, history=History(start=start)) for start in ("zeros", "repeat"))
    assert "its first 4 actions differ" in first_steps(NativePolicy(zeros, own.stored, path="pretrained"))
    assert first_steps(NativePolicy(repeating, own.stored, path="pretrained")) is None


@pytest.mark.slow
def test_the_robot_s_onnxruntime_gives_the_same_actions(bundle, tmp_path):
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    install = [python, "-m", "pip", "install", "--quiet", RUNTIME, "numpy<2"]
    installed = subprocess.run(install, capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"{RUNTIME} cannot be installed here: {installed.stderr.strip().splitlines()[-1]}")
    observations, actions = closed_loop(deploy_contract(bundle / "params" / "deploy.yaml", ROBOT))
    assert observations.shape == (STEPS, 225)
    np.save(tmp_path / "observations.npy", observations)
    files = [bundle / "exported" / "policy.onnx", tmp_path / "observations.npy", tmp_path / "actions.npy"]
    subprocess.run([python, "-c", RUN, *files], check=True)
    largest = np.abs(np.load(tmp_path / "actions.npy") - actions).max()
    print(f"largest difference of an action over {STEPS} steps: {largest:.2g}")
    assert largest <= 1e-5
