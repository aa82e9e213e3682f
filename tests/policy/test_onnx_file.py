import io
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import yaml
from gaitgauge.policy.base import Interface, PolicyError, RowwiseSession
from gaitgauge.policy.contract import History, PolicyContract
from gaitgauge.policy.foreign.fenced_policy import FencedPolicy
from gaitgauge.policy.foreign.onnx_session import GraphProgram, OnnxSession
from gaitgauge.policy.importing import import_policy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import first_line
from onnx import TensorProto, helper, numpy_helper
from torch import nn

pytestmark = pytest.mark.usefixtures("programs_run_here")

EPISODES = 5
TERM_WIDTHS = (3, 3, 3, 12, 12, 12)


class TermMajor(nn.Module):
    """A CTS policy as exported for the robot's own software: five frames, term by term, re-ordered inside; batch of
    one.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.encoder, self.actor = network.encoder, network.actor

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        terms = observation.split([5 * w for w in TERM_WIDTHS], dim=1)
        history = torch.cat([t.view(1, 5, w) for t, w in zip(terms, TERM_WIDTHS, strict=True)], dim=2)
        latent = nn.functional.normalize(self.encoder(history.reshape(1, 225)), dim=-1)
        return latent, self.actor(torch.cat((latent, history[:, -1]), dim=1))


@pytest.fixture(scope="session")
def term_major(cts_network) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            TermMajor(cts_network),
            (torch.zeros(1, 225),),
            buffer,
            dynamo=False,
            opset_version=11,
            input_names=["obs"],
            output_names=["latent", "actions"],
        )
    return buffer.getvalue()


def linear(
    path: Path, width: int = 45, outputs: int = 12, *, batch: int | str = 1, over_batch: bool = False, **metadata: str
):
    """A file with one linear layer; with ``over_batch`` the mean of the whole batch enters every row."""
    weight = np.random.default_rng(0).standard_normal((width, outputs)).astype(np.float32)
    nodes = [helper.make_node("MatMul", ["obs", "weight"], ["raw"])]
    if over_batch:
        nodes += [
            helper.make_node("ReduceMean", ["obs"], ["mean"], axes=[0, 1], keepdims=1),
            helper.make_node("Mul", ["raw", "mean"], ["actions"]),
        ]
    else:
        nodes += [helper.make_node("Tanh", ["raw"], ["actions"])]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [batch, width])],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, [batch, outputs])],
        [numpy_helper.from_array(weight, "weight")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, metadata)
    path.write_bytes(model.SerializeToString())
    return path


def unfenced(path: Path, contract: PolicyContract) -> GraphProgram:
    """Return the program of a file in this process."""
    program = GraphProgram(path.read_bytes(), "policy.onnx")
    program.prepare(Interface.of(contract))
    return program


def deploy_settings(**changes: object) -> dict:
    """Settings as the makers' exporters write them; the joints interleaved, as Isaac Lab orders them."""
    interleaved = [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
    terms = {
        "base_ang_vel": [0.25] * 3,
        "projected_gravity": [1.0] * 3,
        "velocity_commands": [2.0, 2.0, 0.25],
        "joint_pos_rel": [1.0] * 12,
        "joint_vel_rel": [0.05] * 12,
        "last_action": [1.0] * 12,
    }
    pose = [0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.5, -1.5]
    settings = {
        "joint_ids_map": interleaved,
        "step_dt": 0.02,
        "stiffness": [20.0 + i for i in range(12)],
        "damping": [0.5 + 0.1 * i for i in range(12)],
        "default_joint_pos": pose,
        "commands": {
            "base_velocity": {
                "ranges": {
                    "lin_vel_x": [-0.5, 1.5],
                    "lin_vel_y": [-1.0, 1.0],
                    "ang_vel_z": [-2.0, 2.0],
                    "heading": None,
                }
            }
        },
        "actions": {
            "JointPositionAction": {
                "clip": [[-100.0, 100.0]] * 12,
                "joint_names": [".*"],
                "scale": [0.25] * 12,
                "offset": pose,
                "joint_ids": None,
            }
        },
        "observations": {
            name: {"params": {}, "clip": [-100, 100], "scale": scale, "history_length": 5}
            for name, scale in terms.items()
        },
    }
    return {**settings, **changes}


def test_fixed_batch_and_history_are_opened(tmp_path, term_major, cts_network):
    path = tmp_path / "policy.onnx"
    path.write_bytes(term_major)
    policy = load_policy(path)
    assert policy.contract.history == History(length=5, order="term-major", start="zeros")
    history = torch.randn(EPISODES, 5, 45, generator=torch.Generator().manual_seed(2))
    observation = torch.cat([block.flatten(1) for block in history.split(TERM_WIDTHS, dim=2)], dim=1)
    opened = unfenced(path, policy.contract).session(EPISODES)
    assert isinstance(opened, OnnxSession)
    for session in (policy.session(EPISODES), opened):
        np.testing.assert_allclose(session.act(observation), cts_network(history), atol=1e-5)
        session.reset()
        session.reset(torch.ones(EPISODES, dtype=torch.bool))
        np.testing.assert_allclose(session.act(observation), cts_network(history), atol=1e-5)


@pytest.mark.parametrize(("batch", "over_batch"), [(1, False), ("n", False), (1, True)])
def test_batch_equals_rows(tmp_path, batch, over_batch):
    path = linear(tmp_path / "policy.onnx", batch=batch, over_batch=over_batch)
    policy = load_policy(path)
    single, own = policy.session(1), unfenced(path, policy.contract).session(EPISODES)
    assert isinstance(policy, FencedPolicy) and policy.row_by_row == over_batch
    assert isinstance(own, RowwiseSession if over_batch else OnnxSession)
    observation = torch.randn(EPISODES, 45, generator=torch.Generator().manual_seed(2))
    rows = torch.cat([single.act(observation[i : i + 1]) for i in range(EPISODES)])
    poisoned = observation.clone()
    poisoned[1] = float("nan")
    others = torch.arange(EPISODES) != 1
    for session in (policy.session(EPISODES), own):
        np.testing.assert_allclose(session.act(observation), rows, atol=1e-6)
        assert torch.equal(session.act(poisoned)[others], session.act(observation)[others])
        assert session.act(poisoned)[1].isnan().all()


def test_deploy_file_gives_the_contract(tmp_path, term_major, go2):
    (tmp_path / "exported").mkdir()
    (tmp_path / "params").mkdir()
    path = tmp_path / "exported" / "policy.onnx"
    path.write_bytes(term_major)
    (tmp_path / "params" / "deploy.yaml").write_text(yaml.safe_dump(deploy_settings(), sort_keys=False))
    contract = load_policy(path, go2).contract
    legs = ("FL", "FR", "RL", "RR")
    assert contract.joint_names == tuple(f"{leg}_{joint}_joint" for joint in ("hip", "thigh", "calf") for leg in legs)
    # Gains are listed in the order of the robot's SDK (FR, FL, RR, RL), poses in the policy's.
    assert contract.stiffness[:5] == (23.0, 20.0, 29.0, 26.0, 24.0)
    assert contract.damping[8] == pytest.approx(1.0)
    assert contract.default_joint_position[:5] == (0.1, -0.1, 0.1, -0.1, 0.8)
    assert contract.control_period == 0.02
    assert contract.command_limits == (1.5, 1.0, 2.0)
    assert contract.history == History(length=5, order="term-major", start="repeat")
    assert contract.target_range == ((-100.0, 100.0),) * 12
    names = [t.name for t in contract.observation]
    assert names[:3] == ["base_angular_velocity_b", "projected_gravity_b", "command"]
    # These files clip before they scale.
    assert contract.observation[2].clip == (200.0, 200.0, 25.0)


def test_deploy_file_switches(tmp_path):
    path = linear(tmp_path / "policy.onnx", 225)
    settings = deploy_settings()
    settings["observations"] = {"use_gym_history": True, "scale_first": True, **settings["observations"]}
    (tmp_path / "deploy.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    contract = load_policy(path).contract
    assert contract.history.order == "frame-major"
    assert contract.observation[2].clip == (100.0,)


def changed_term(**changes: object) -> dict:
    observations = deploy_settings()["observations"]
    return {**observations, "base_ang_vel": {**observations["base_ang_vel"], **changes}}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"joint_ids_map": [0] * 12}, "joint_ids_map"),
        ({"joint_ids_map": list(range(29))}, "has 12 values of default_joint_pos; 29 are needed"),
        ({"stiffness": [20.0] * 3}, "has 3 values of stiffness; 12 are needed"),
        ({"actions": {}}, "lacks 'JointPositionAction' of deploy.yaml"),
        ({"actions": {"JointPositionAction": {"scale": 0.25, "offset": [0.0] * 11}}}, "deploy.yaml"),
        ({"default_joint_pos": [0.0] * 11}, "has 11 values of default_joint_pos"),
        ({"step_dt": "fast"}, "fast"),
        ({"step_dt": -0.02}, "control_period"),
        ({"observations": changed_term(history_length=3)}, "takes 225 values"),
        ({"observations": {"use_gym_history": True, **changed_term(history_length=3)}}, "different lengths"),
        ({"observations": changed_term(clip=[-1, 2])}, "symmetric"),
        ({"observations": {**changed_term(), "gait_phase": {"scale": [1.0, 1.0]}}}, "period"),
        ({"observations": {"base_ang_vel": {"history_length": 5, "scale": None}}}, "15"),
    ],
)
def test_malformed_deploy_files_end_in_one_sentence(tmp_path, changes, named):
    path = linear(tmp_path / "policy.onnx", 225)
    (tmp_path / "deploy.yaml").write_text(yaml.safe_dump(deploy_settings(**changes), sort_keys=False))
    with pytest.raises(PolicyError, match=named) as caught:
        load_policy(path)
    assert "\n" not in str(caught.value)


def test_unreadable_deploy_files(tmp_path):
    path = linear(tmp_path / "policy.onnx")
    for text in ("a: [", "just words", "!!python/object/apply:os.system ['true']"):
        (tmp_path / "deploy.yaml").write_text(text)
        with pytest.raises(PolicyError, match=r"deploy\.yaml"):
            load_policy(path)


def test_contract_in_the_metadata_wins_over_the_deploy_file(tmp_path, contract):
    described = replace(contract, control_period=0.01)
    path = linear(tmp_path / "policy.onnx", contract=described.to_json())
    (tmp_path / "deploy.yaml").write_text(yaml.safe_dump(deploy_settings()))
    assert load_policy(path).contract == described
    sidecar = replace(contract, control_period=0.005)
    (tmp_path / "policy.contract.json").write_text(sidecar.to_json())
    found = load_policy(path).contract
    assert replace(found, provenance=sidecar.provenance) == sidecar
    assert "policy.contract.json is used, and not " in found.provenance["assumed"]


def mjlab_metadata(go2, **changes: str) -> dict[str, str]:
    metadata = {
        "run_path": "none",
        "joint_names": ",".join(go2.joint_names),
        "joint_stiffness": ",".join(["20.000"] * 12),
        "joint_damping": ",".join(["0.500"] * 12),
        "default_joint_pos": ",".join(f"{q:.3f}" for q in go2.default_joint_position),
        "command_names": "twist",
        "observation_names": "base_lin_vel,base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command",
        "observation_terms_scale": "1.0,0.25,1.0,1.0,0.05,1.0,1.0",
        "observation_terms_clip": "-inf;inf,-18.0;18.0,-inf;inf,-inf;inf,-inf;inf,-inf;inf,-inf;inf",
        "observation_terms_history_length": "0,0,0,0,0,0,0",
        "action_scale": "0.5",
    }
    return {**metadata, **changes}


SCANNED = {
    "observation_names": "height_scan",
    "observation_terms_scale": "0.2",
    "observation_terms_clip": "-1;1",
    "observation_terms_history_length": "0",
}


def test_mjlab_metadata(tmp_path, go2):
    policy = load_policy(linear(tmp_path / "policy.onnx", 48, **mjlab_metadata(go2)), go2)
    assert policy.contract.action_scale == (0.5,) * 12
    assert policy.contract.observation[0].name == "base_linear_velocity_b"
    assert policy.contract.observation[1].clip == 4.5
    assert policy.contract.history == History(length=1, start="repeat")
    lengths = mjlab_metadata(go2, observation_terms_history_length=",".join("4" * 7))
    scan = {key: f"{mjlab_metadata(go2)[key]},{own}" for key, own in SCANNED.items()}
    seeing = load_policy(linear(tmp_path / "policy.onnx", 235, **mjlab_metadata(go2, **scan))).contract
    assert (seeing.observation[-1].name, seeing.observation[-1].clip) == ("height_scan", 0.2)
    assert "usual grid, 1.6 by 1 m, 0.1 m apart, x first, less 0 m" in seeing.provenance["assumed"]
    stacked = load_policy(linear(tmp_path / "policy.onnx", 192, **lengths))
    assert stacked.contract.history == History(length=4, order="term-major", start="repeat")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"observation_names": "camera"}, "camera"),
        ({"action_scale": "big"}, "big"),
        ({"joint_stiffness": "20"}, "stiffness"),
        ({"observation_terms_scale": "1.0"}, "metadata"),
    ],
)
def test_malformed_mjlab_metadata(tmp_path, go2, changes, named):
    path = linear(tmp_path / "policy.onnx", 48, **mjlab_metadata(go2, **changes))
    with pytest.raises(PolicyError, match=named):
        load_policy(path)


def test_width_without_a_contract(tmp_path):
    assert load_policy(linear(tmp_path / "policy.onnx", 45)).contract.history == History()
    with pytest.raises(PolicyError, match="44"):
        load_policy(linear(tmp_path / "policy.onnx", 44))
    with pytest.raises(PolicyError, match=r"\(1, 11\)"):
        load_policy(linear(tmp_path / "policy.onnx", 45, 11))


def test_width_against_the_contract(tmp_path, contract):
    path = linear(tmp_path / "policy.onnx", 45, contract=replace(contract, history=History(length=5)).to_json())
    with pytest.raises(PolicyError, match=r"45.*225"):
        load_policy(path)


def test_damaged_files(tmp_path, term_major):
    path = tmp_path / "policy.onnx"
    for length in (20, 200, len(term_major) // 2, len(term_major) - 10):
        path.write_bytes(term_major[:length])
        with pytest.raises(PolicyError) as caught:
            load_policy(path)
        assert "\n" not in str(caught.value)


def test_two_inputs_are_refused(tmp_path):
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 45]) for n in ("obs", "state")]
    output = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, 45])
    graph = helper.make_graph([helper.make_node("Add", ["obs", "state"], ["actions"])], "policy", inputs, [output])
    path = tmp_path / "policy.onnx"
    path.write_bytes(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8).SerializeToString()
    )
    with pytest.raises(PolicyError, match="state"):
        load_policy(path)


def test_weights_beside_the_file_and_import(tmp_path):
    (tmp_path / "source").mkdir()
    path = tmp_path / "source" / "policy.onnx"
    model = onnx.load(linear(tmp_path / "inside.onnx"))
    onnx.save(model, path, save_as_external_data=True, location="policy.onnx.data", size_threshold=0)
    observation = torch.randn(EPISODES, 45)
    expected = load_policy(tmp_path / "inside.onnx").session(EPISODES).act(observation)
    assert torch.equal(load_policy(path).session(EPISODES).act(observation), expected)
    stored = import_policy(path, tmp_path / "own.gauge.pt").contract
    digest = load_policy(path).digest
    assert digest == load_policy(path).digest
    weights = tmp_path / "source" / "policy.onnx.data"
    weights.write_bytes(bytes([weights.read_bytes()[0] ^ 1]) + weights.read_bytes()[1:])
    assert load_policy(path).digest != digest
    (tmp_path / "source" / "policy.onnx.data").unlink()
    own = load_policy(tmp_path / "own.gauge.pt", trust=True)
    assert own.contract == stored
    assert torch.equal(own.session(EPISODES).act(observation), expected)
    with pytest.raises(PolicyError):
        load_policy(path)


def test_import_keeps_the_deploy_files_contract(tmp_path, term_major):
    (tmp_path / "source").mkdir()
    path = tmp_path / "source" / "policy.onnx"
    path.write_bytes(term_major)
    (tmp_path / "source" / "deploy.yaml").write_text(yaml.safe_dump(deploy_settings(), sort_keys=False))
    import_policy(path, tmp_path / "own.gauge.pt")
    assert load_policy(tmp_path / "own.gauge.pt", trust=True).contract.hash == load_policy(path).contract.hash


def test_messages_stay_on_one_line():
    assert first_line(RuntimeError("\n  first thing.\nsecond")) == "first thing"
    assert first_line(KeyError()) == "KeyError"
