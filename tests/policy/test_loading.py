import json
import os
import pickle
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import import_public_cts
import numpy as np
import pytest
import torch
from gaitgauge.policy import finding
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import ContractError, PolicyContract
from gaitgauge.policy.finding import find_policy
from gaitgauge.policy.foreign.described import described_contract
from gaitgauge.policy.importing import import_policy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import save_policy
from gaitgauge.policy.networks.architectures import CtsNetwork, multilayer_perceptron
from gaitgauge.robots import load_robot
from torch import nn


def refused(path: Path | str, **options: object) -> str:
    """The message with which a file is refused; it must be one sentence on one line."""
    with pytest.raises(PolicyError) as caught:
        load_policy(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 400
    return message


class Hostile:
    """Creates a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize(
    "kind", ["plain pickle", "torch.save", "torch.save, old", "inside a checkpoint", "as TorchScript"]
)
def test_code_in_a_file_is_never_executed(tmp_path, cts_file, kind):
    marker, path = tmp_path / "executed", tmp_path / "policy.pt"
    hostile = Hostile(marker)
    if kind == "plain pickle":
        path.write_bytes(pickle.dumps(hostile))
    elif kind == "torch.save":
        torch.save(hostile, path)
    elif kind == "torch.save, old":
        torch.save(hostile, path, _use_new_zipfile_serialization=False)
    elif kind == "inside a checkpoint":
        torch.save({**torch.load(cts_file, weights_only=True), "infos": hostile}, path)
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickle.dumps(hostile))
            archive.writestr("archive/constants.pkl", pickle.dumps(hostile))
            archive.writestr("archive/code/__torch__.py", "")
            archive.writestr("archive/version", "3\n")
    refused(path)
    assert not marker.exists()
    pickle.loads(pickle.dumps(hostile))
    assert marker.exists(), "the file would not have done anything anyway"


def test_missing_and_unsuitable_paths(tmp_path):
    assert "nowhere.pt" in refused(tmp_path / "nowhere.pt")
    assert "folder" in refused(tmp_path)
    assert "regular" in refused("/dev/null")
    assert "latest" in refused("lastest")


def test_the_part_of_one_process_names_the_checkpoint(tmp_path):
    whole, part = tmp_path / "model_40.pt", tmp_path / "model_40.rank1.pt"
    part.write_bytes(b"")
    assert find_policy(part) == part, "without the checkpoint beside it the name says nothing"
    whole.write_bytes(b"")
    with pytest.raises(PolicyError, match=f"several GPUs adds to its checkpoint; give '{whole}'"):
        find_policy(part)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00" * 100,
        b"just some text, longer than a header",
        b"\x08\x07" + b"\xff" * 100,
        b"PK\x03\x04 not an archive",
        bytes(range(256)) * 10,
    ],
)
def test_files_that_are_no_policies(tmp_path, content):
    path = tmp_path / "policy.pt"
    path.write_bytes(content)
    assert "policy.pt" in refused(path)


def test_other_archives_and_other_contents(tmp_path):
    path = tmp_path / "policy.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("letter.txt", "hello")
    assert "zip" in refused(path)
    for content in ({"weights": torch.ones(3)}, torch.ones(3), [1, 2], {"format": "other"}):
        torch.save(content, path)
        refused(path)
    np.savez(path.with_suffix(".npz"), a=np.ones(3))
    refused(path.with_suffix(".npz"))


def test_truncated_and_damaged_files(tmp_path, cts_file):
    whole = cts_file.read_bytes()
    path = tmp_path / "policy.pt"
    for length in (3, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        refused(path)
    start = whole.index(b"gaitgauge-policy")
    path.write_bytes(whole[:start] + b"\xff" * 40 + whole[start + 40 :])
    refused(path)


def test_robot_is_checked(cts_file, go2, contract, cts_stored, tmp_path):
    assert load_policy(cts_file, go2).contract == contract
    renamed = PolicyContract.from_dict({**contract.to_dict(), "joint_names": ("tail", *contract.joint_names[1:])})
    save_policy(tmp_path / "tail.pt", renamed, cts_stored)
    with pytest.raises(ContractError, match="tail"):
        load_policy(tmp_path / "tail.pt", go2)


def test_latest_and_best(tmp_path, cts_file, monkeypatch):
    monkeypatch.setattr(finding, "LOG_ROOT", tmp_path)

    def put(run: str, name: str) -> Path:
        path = tmp_path / run / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cts_file.read_bytes())
        return path

    assert "model_<iteration>.pt" in refused("latest")
    put("go2_flat/2026-01-01_10-00-00", "model_900.pt")
    put("go2_rough/2026-01-02_10-00-00_first", "model_50.pt")
    last = put("go2_rough/2026-01-02_10-00-00_first", "model_1000.pt")
    put("go2_rough/2026-01-02_10-00-00_first", "model_999.pt")
    (tmp_path / "go2_rough" / "2026-01-03_10-00-00").mkdir()
    assert find_policy("latest") == last
    assert load_policy("latest").path == "latest"
    assert "best.pt" in refused("best")
    best = put("go2_flat/2026-01-01_10-00-00", "best.pt")
    assert find_policy("best") == best


def test_policies_that_ship(monkeypatch, cts_file, tmp_path):
    folder = tmp_path / "shipped"
    folder.mkdir()
    monkeypatch.setattr(finding, "SHIPPED", folder)
    monkeypatch.setattr(finding, "PRETRAINED", folder / "go2.gauge.pt")
    assert finding.policy_names() == ("latest", "best", "pretrained")
    assert "no pretrained policy ships" in refused("pretrained")
    assert "no policy file 'pretrained-go9'" in refused("pretrained-go9")
    for name in ("go2", "go9"):
        shutil.copy(cts_file, folder / f"{name}.gauge.pt")
    assert finding.policy_names() == ("latest", "best", "pretrained", "pretrained-go9")
    assert load_policy("pretrained").contract.observation_width == 45
    assert find_policy("pretrained-go9") == folder / "go9.gauge.pt"
    assert "pretrained-go9" in refused("pretrained-go8")


def checkpoint(path: Path, layers: nn.Module, prefix: str, key: str, **more: torch.Tensor) -> Path:
    weights = {f"{prefix}{k}": v for k, v in layers.state_dict().items()}
    noise = {"std": torch.ones(12), "critic.0.weight": torch.ones(3, 3)}
    torch.save({key: {**weights, **noise, **more}, "optimizer_state_dict": {}, "iter": 5, "infos": None}, path)
    return path


@pytest.mark.parametrize(("prefix", "key"), [("actor.", "model_state_dict"), ("mlp.", "actor_state_dict")])
def test_bare_checkpoints(tmp_path, observations, prefix, key):
    layers = multilayer_perceptron((45, 16, 8, 12))
    policy = load_policy(checkpoint(tmp_path / "model_5.pt", layers, prefix, key))
    with torch.no_grad():
        torch.testing.assert_close(policy.session(4).act(observations[0]), layers(observations[0]))
    assert policy.contract.provenance["adapter"] == "rsl_rl checkpoint"


def test_a_contract_file_says_how_a_bare_checkpoint_is_run(tmp_path, cts_file):
    layers = nn.Sequential(nn.Linear(45, 8), nn.ELU(), nn.Linear(8, 12))
    path = checkpoint(tmp_path / "model_5.pt", layers, "mlp.", "actor_state_dict")
    described = tmp_path / "contract.toml"
    described.write_text("control_period = 0.01")
    contract = load_policy(path, contract_file=described).contract
    assert contract.control_period == 0.01
    assert "assumed" not in contract.provenance
    described.write_text("history = { length = 5 }")
    with pytest.raises(PolicyError, match="model_5"):
        load_policy(path, contract_file=described)
    with pytest.raises(PolicyError, match="has its contract inside; leave out --contract"):
        load_policy(cts_file, contract_file=described)


def test_what_a_contract_file_leaves_out_goes_with_its_joints(tmp_path, go2):
    """With joints in the SDK's order each got the value that stands at its place in the robot's."""
    described = tmp_path / "contract.toml"
    described.write_text(f"joint_names = {json.dumps(go2.sdk_joint_names)}")
    contract = described_contract(described, go2)
    assert contract.joint_names == go2.sdk_joint_names  # right before left
    hips = dict(zip(contract.joint_names, contract.default_joint_position, strict=True))
    assert hips["FR_hip_joint"] == hips["RR_hip_joint"] == -0.1
    assert hips["FL_hip_joint"] == hips["RL_hip_joint"] == 0.1
    described.write_text(described.read_text() + "\ndefault_joint_position = " + json.dumps([0.1] * 12))
    assert described_contract(described, go2).default_joint_position == (0.1,) * 12


def test_a_contract_file_of_another_robot_is_refused(tmp_path, go2):
    """A Go1 has the Go2's joints, and was played with its standard gains and pose."""
    described = tmp_path / "contract.toml"
    described.write_text('robot = "go1"')
    with pytest.raises(PolicyError, match=r"describes a policy for robot 'go1', not for 'go2'; give that robot's"):
        described_contract(described, go2)
    assert described_contract(described, load_robot("go1")).robot == "go1"


@pytest.mark.parametrize("joints", ['["a", "b"]', '["a", 1]', "3", '["FL_hip_joint"]', "{ a = 1 }"])
def test_joints_that_are_not_the_robots_are_refused(tmp_path, go2, joints):
    described = tmp_path / "contract.toml"
    described.write_text(f"joint_names = {joints}")
    with pytest.raises(PolicyError, match="contract file"):
        described_contract(described, go2)


def test_joints_by_kind_take_gains_and_scales_along(tmp_path):
    """The Go2's gains are alike at all joints; a robot with others at its calves, listed by kind."""
    go2 = load_robot("go2")
    motors = go2.parameters[go2.default_parameters]
    per_joint = {"stiffness": (20.0, 20.0, 40.0) * 4, "damping": (0.5, 0.5, 1.0) * 4}
    robot = replace(
        go2,
        action_scale=(0.125, 0.25, 0.25) * 4,
        parameters={**go2.parameters, go2.default_parameters: replace(motors, **per_joint)},
    )
    described = tmp_path / "contract.toml"
    by_kind = [name for kind in range(3) for name in go2.joint_names[kind::3]]
    described.write_text(f"joint_names = {json.dumps(by_kind)}")
    contract = described_contract(described, robot)
    assert contract.stiffness == (20.0,) * 8 + (40.0,) * 4
    assert contract.damping == (0.5,) * 8 + (1.0,) * 4
    assert contract.action_scale == (0.125,) * 4 + (0.25,) * 8


def test_bare_checkpoint_with_normalization_and_activation(tmp_path, observations):
    layers = multilayer_perceptron((45, 16, 12), activation="tanh")
    normalizer = {
        "obs_normalizer._mean": torch.full((1, 45), 0.5),
        "obs_normalizer._std": torch.full((1, 45), 1.99),
        "obs_normalizer._var": torch.full((1, 45), 1.99**2),
        "obs_normalizer.count": torch.tensor(7),
    }
    path = checkpoint(tmp_path / "model_5.pt", layers, "mlp.", "actor_state_dict", **normalizer)
    (tmp_path / "params").mkdir()
    (tmp_path / "params" / "agent.yaml").write_text("actor:\n  hidden_dims: [16]\n  activation: tanh\n")
    with torch.no_grad():
        expected = layers((observations[0] - 0.5) / 2.0)
        torch.testing.assert_close(load_policy(path).session(4).act(observations[0]), expected)
    before = load_policy(path).digest
    (tmp_path / "params" / "agent.yaml").write_text("actor:\n  hidden_dims: [16]\n  activation: relu\n")
    assert load_policy(path).digest != before


def test_bare_checkpoint_of_a_student(tmp_path, cts_network: CtsNetwork, observations, run, cts_file):
    weights = {k.replace("encoder.", "student_encoder."): v for k, v in cts_network.state_dict().items()}
    torch.save({"model_state_dict": {**weights, "teacher_encoder.0.weight": torch.ones(2, 2)}}, tmp_path / "model_5.pt")
    student = load_policy(tmp_path / "model_5.pt")
    assert torch.equal(run(student.session(4), observations), run(load_policy(cts_file).session(4), observations))


@pytest.mark.parametrize(("widths", "named"), [((48, 8, 12), "48"), ((45, 8, 10), "10"), ((225, 8, 12), "225")])
def test_bare_checkpoints_of_other_widths(tmp_path, widths, named):
    path = checkpoint(tmp_path / "model_5.pt", multilayer_perceptron(widths), "actor.", "model_state_dict")
    assert named in refused(path)


def test_bare_checkpoints_of_other_kinds(tmp_path):
    path = checkpoint(tmp_path / "model_5.pt", nn.LSTM(45, 4), "memory_a.rnn.", "model_state_dict")
    assert "memory_a" in refused(path)
    torch.save({"model_state_dict": {}}, path)
    refused(path)


def test_import_makes_a_file_of_our_own(tmp_path, observations):
    layers = multilayer_perceptron((45, 16, 12))
    path = checkpoint(tmp_path / "model_5.pt", layers, "actor.", "model_state_dict")
    contract = import_policy(path, tmp_path / "made" / "own.gauge.pt").contract
    own = load_policy(tmp_path / "made" / "own.gauge.pt")
    assert own.contract == contract
    assert contract.provenance["imported_from"] == "model_5.pt"
    assert torch.equal(own.session(4).act(observations[0]), load_policy(path).session(4).act(observations[0]))


def test_import_leaves_the_destination_alone_if_it_fails(tmp_path, cts_file):
    bad = tmp_path / "bad.pt"
    bad.write_bytes(b"nothing of use in here, really")
    before = cts_file.read_bytes()
    with pytest.raises(PolicyError):
        import_policy(bad, cts_file)
    assert cts_file.read_bytes() == before
    with pytest.raises(PolicyError, match="cannot write"):
        import_policy(cts_file, cts_file / "under_a_file.pt")


def test_published_weights_are_converted_and_checked(tmp_path, observations, monkeypatch):
    torch.manual_seed(1)
    network = CtsNetwork().eval().requires_grad_(False)
    frames = observations[:, 0]
    history = torch.zeros(1, 5, 45)
    actions = []
    for frame in frames:
        history = torch.cat((history[:, 1:], frame.view(1, 1, 45)), dim=1)
        actions.append(network(history)[0].numpy())
    weights = {k.replace("encoder.", "student_encoder."): v.numpy() for k, v in network.state_dict().items()}
    sample = {"sample/observations": frames.numpy(), "sample/actions": np.array(actions)}
    np.savez(tmp_path / "weights.npz", **weights, **sample)
    monkeypatch.setattr(sys, "argv", ["import", str(tmp_path / "weights.npz"), str(tmp_path / "own.pt")])
    import_public_cts.main()
    assert torch.equal(load_policy(tmp_path / "own.pt").session(1).act(frames[:1])[0], torch.from_numpy(actions[0]))
    np.savez(tmp_path / "weights.npz", **weights, **{**sample, "sample/actions": np.array(actions) + 1e-3})
    with pytest.raises(SystemExit, match="published"):
        import_public_cts.main()
