import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
import yaml
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import History, PolicyContract, standard_contract
from gaitgauge.policy.export import files as export
from gaitgauge.policy.export.files import (
    ExportError,
    export_deploy,
    export_onnx,
    export_policy,
    export_torchscript,
    mjlab_metadata,
    term_major_order,
)
from gaitgauge.policy.foreign.deploy_yaml import deploy_contract
from gaitgauge.policy.foreign.fenced_policy import FencedPolicy
from gaitgauge.policy.foreign.mjlab import mjlab_contract
from gaitgauge.policy.importing import import_policy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import NativePolicy, StoredNetwork
from gaitgauge.policy.networks.architectures import ARCHITECTURES
from gaitgauge.robots import load_robot

pytestmark = pytest.mark.usefixtures("programs_run_here")

torch.set_num_threads(1)

SMALL = {"actor_hidden": [32], "latent_width": 8}
COMPOSED = {"latent_width": 8, "encoder_hidden": [32], "num_experts": 4, "expert_width": 8}
COMPOSED |= {"trunk_hidden": [32], "gate_hidden": [16]}
NETWORKS = {
    "mlp": ("mlp", {"frame_width": 45, "num_actions": 12, "hidden": [32]}),
    "normalized mlp with history": (
        "mlp",
        {"frame_width": 45, "num_actions": 12, "hidden": [32], "history_length": 3, "normalize": True},
    ),
    "cts": ("cts", SMALL | {"encoder_hidden": [32]}),
    "moe": ("moe_cts", SMALL | {"num_experts": 4, "expert_width": 8, "trunk_hidden": [32], "gate_hidden": [16]}),
    "blind moe": (
        "moe_cts",
        SMALL
        | {"num_experts": 4, "expert_width": 8, "trunk_hidden": [32], "gate_hidden": [16]}
        | {"expert_blind_to": [6, 7, 8], "shared_head": True},
    ),
    "ac moe": ("ac_moe", COMPOSED),
    "mcp": ("mcp", COMPOSED | {"primitives_blind_to": [6, 7, 8]}),
    "him": ("him", SMALL | {"encoder_hidden": [32]}),
    "dreamwaq": ("dreamwaq", SMALL | {"encoder_hidden": [32]}),
}


def make_policy(kind: str, contract: PolicyContract | None = None) -> NativePolicy:
    torch.manual_seed(1)
    architecture, arguments = NETWORKS[kind]
    network = ARCHITECTURES[architecture](**arguments)
    if "mean" in dict(network.named_buffers()):
        network.mean.normal_()
        network.deviation.uniform_(0.5, 2.0)
    stored = StoredNetwork(architecture=architecture, arguments=arguments, state_dict=network.state_dict())
    contract = contract or standard_contract(load_robot("go2"), provenance={"run": "2026-01-01_00-00-00"})
    return NativePolicy(contract, stored, path=f"{kind}.pt")


def starting_with(start: str) -> PolicyContract:
    provenance = {"run": "2026-01-01_00-00-00"}
    return standard_contract(load_robot("go2"), history=History(start=start), provenance=provenance)


def test_a_history_that_starts_with_copies_of_the_first_frame(tmp_path):
    """The same network: its first action is that of a history full of the first frame, in every export and session."""
    policy = make_policy("moe", starting_with("repeat"))
    first, second = torch.randn(1, 45), torch.randn(1, 45)
    full, next_full = first[:, None].expand(1, 5, 45), torch.cat((first[:, None].expand(1, 4, 45), second[:, None]), 1)
    export_torchscript(policy, tmp_path / "policy.pt")
    script = torch.jit.load(tmp_path / "policy.pt")
    sessions = [policy.session(1), load_policy(tmp_path / "policy.pt").session(1)]
    for again in range(2):
        for history, frame in ((full, first), (next_full, second)):
            expected = policy.network(history)
            assert torch.allclose(script(frame)[0], expected, atol=1e-6), again
            for session in sessions:
                assert torch.allclose(session.act(frame), expected, atol=1e-6), again
        script.reset()
        for session in sessions:
            session.reset(torch.tensor([True]))
    zeros = make_policy("moe", starting_with("zeros")).session(1).act(first)
    assert not torch.allclose(zeros, policy.network(full), atol=1e-3)


def test_rows_start_their_history_each_for_itself():
    policy = make_policy("moe", starting_with("repeat"))
    frames = torch.randn(4, 3, 45)
    batch, alone = policy.session(3), policy.session(1)
    for step, frame in enumerate(frames):
        if step == 2:
            batch.reset(torch.tensor([False, True, False]))
            alone.reset()
        actions, single = batch.act(frame), alone.act(frame[1:2])
        assert torch.allclose(actions[1:2], single, atol=1e-6), step


def test_deploy_file_is_exact_for_a_history_that_starts_with_copies(tmp_path):
    policy = make_policy("moe", starting_with("repeat"))
    export_policy(policy, tmp_path, load_robot("go2"))
    runtime = deploy_contract(tmp_path / "deploy.yaml", load_robot("go2"))
    assert (runtime.history.length, runtime.history.start) == (5, "repeat")
    assert load_policy(tmp_path / "policy.onnx").contract.history == runtime.history


@pytest.fixture(scope="module")
def scripted(tmp_path_factory):
    """A policy and its TorchScript file, by network and start of the history; each is exported once."""
    folder = tmp_path_factory.mktemp("scripted")

    @cache
    def export(kind, start="zeros"):
        policy, path = make_policy(kind, starting_with(start)), folder / f"{kind} {start}.pt"
        assert export_torchscript(policy, path) <= 1e-5
        return policy, path

    return export


QUICK = [("normalized mlp with history", "zeros"), ("blind moe", "zeros"), ("mcp", "zeros"), ("him", "repeat")]


@pytest.mark.parametrize(
    ("kind", "start"),
    [
        pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow)
        for case in (*((kind, "zeros") for kind in NETWORKS), ("moe", "repeat"), ("him", "repeat"))
    ],
)
def test_torchscript_runs_step_by_step_like_the_policy(kind, start, scripted):
    policy, path = scripted(kind, start)
    module = torch.jit.load(path)
    session = policy.session(1)
    for episode in range(2):
        module.reset()
        session.reset()
        for _ in range(7):
            observation = torch.randn(1, 45)
            output = module(observation)
            actions = output if isinstance(output, torch.Tensor) else output[0]
            assert torch.allclose(actions, session.act(observation), atol=1e-6), episode
    reloaded = load_policy(path)
    assert reloaded.contract == policy.contract and reloaded.contract.provenance == policy.contract.provenance
    assert isinstance(reloaded, FencedPolicy)


def test_torchscript_output_is_the_published_one(scripted):
    outputs = {}
    for kind in ("mlp", "cts", "moe"):
        module = torch.jit.load(scripted(kind)[1])
        assert module.history.shape == (1, 1 if kind == "mlp" else 5, 45)
        outputs[kind] = module(torch.zeros(1, 45))
    assert outputs["mlp"].shape == (1, 12)
    actions, (weights, latent) = outputs["cts"]
    assert actions.shape == (1, 12) and weights is None and latent.shape == (1, 8)
    actions, (weights, latent) = outputs["moe"]
    assert actions.shape == (1, 12) and weights.shape == (1, 4) and float(weights.sum()) == pytest.approx(1.0)
    assert float(latent.norm()) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("kind", "experts", "width"), [("ac moe", 4, 8), ("mcp", 4, 8), ("him", 0, 11)])
def test_torchscript_gives_latent_and_weights_of_experts(kind, experts, width, scripted):
    actions, (weights, latent) = torch.jit.load(scripted(kind)[1])(torch.zeros(1, 45))
    assert actions.shape == (1, 12) and latent.shape == (1, width)
    assert weights is None if experts == 0 else weights.shape == (1, experts)


@pytest.fixture(scope="module")
def moe_onnx(tmp_path_factory):
    """An exporter's run takes seconds, so that the fast tests share one."""
    path = tmp_path_factory.mktemp("export") / "policy.onnx"
    third = 1.0 / 3.0
    policy = make_policy("moe", replace(standard_contract(load_robot("go2")), action_scale=(third,) * 12))
    assert export_onnx(policy, path) <= 1e-5
    return policy, path


def test_onnx_takes_a_term_major_history(moe_onnx):
    check_onnx(*moe_onnx)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(NETWORKS))
def test_every_network_exports_to_onnx(kind, tmp_path):
    policy = make_policy(kind)
    export_onnx(policy, tmp_path / "policy.onnx")
    check_onnx(policy, tmp_path / "policy.onnx")


def check_onnx(policy: NativePolicy, path: Path) -> None:
    runtime = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (given,), (output,) = runtime.get_inputs(), runtime.get_outputs()
    frames = policy.network.history_length
    assert (given.name, output.name) == ("obs", "actions") and given.shape == [1, 45 * frames]
    history = np.random.default_rng(0).standard_normal((frames, 45)).astype(np.float32)
    blocks = np.split(history, [3, 6, 9, 21, 33], axis=1)
    stacked = np.concatenate([b.ravel() for b in blocks])[None]
    session = policy.session(1)
    for frame in history:
        expected = session.act(torch.from_numpy(frame[None]))
    (actions,) = runtime.run(None, {"obs": stacked})
    assert np.allclose(actions, expected.numpy(), atol=1e-5)


def test_onnx_metadata(moe_onnx):
    (policy, path), third = moe_onnx, 1.0 / 3.0
    contract = policy.contract
    metadata = {p.key: p.value for p in onnx.load(path).metadata_props}
    stored = PolicyContract.from_dict(json.loads(metadata["contract"]))
    assert stored.action_scale == (third,) * 12
    assert (stored.history.length, stored.history.order, stored.history.start) == (5, "term-major", "zeros")
    assert [float(v) for v in metadata["action_scale"].split(",")] == [third] * 12
    assert metadata["joint_names"].split(",") == list(contract.joint_names)
    assert metadata["observation_names"].split(",")[0] == "base_ang_vel"
    assert metadata["observation_terms_history_length"] == "5,5,5,5,5,5"
    assert metadata == {"contract": metadata["contract"], **mjlab_metadata(stored)}
    assert load_policy(path).contract == stored


def clipped(clips: dict[str, float | tuple[float, ...]], scales: dict[str, tuple[float, ...]] | None = None):
    """The standard contract with clips, and other scales, of some terms."""
    contract = standard_contract(load_robot("go2"), history=History(start="repeat"))
    changed = (
        replace(t, clip=clips.get(t.name), scale=(scales or {}).get(t.name, t.scale)) for t in contract.observation
    )
    return replace(contract, observation=tuple(changed))


def test_mjlab_clips_before_it_scales():
    """Entries of 100 after a factor of 0.25 are those of 400 before it."""
    contract = clipped({"base_angular_velocity_b": 100.0, "joint_velocity": (50.0,), "joint_position": (3.0,) * 12})
    metadata = mjlab_metadata(contract)
    unclipped = "-inf;inf"
    assert metadata["observation_terms_clip"].split(",") == [
        "-400.0;400.0",
        unclipped,
        unclipped,
        "-3.0;3.0",
        "-1000.0;1000.0",
        unclipped,
    ]


@pytest.mark.parametrize(
    "contract",
    [
        clipped({}),
        clipped({"base_angular_velocity_b": 100.0, "joint_velocity": 50.0}),
        clipped({"command": (3.0, 3.0, 0.375)}),
        clipped({"joint_velocity": 50.0}, {"joint_velocity": (-0.05,)}),
        clipped({"joint_velocity": 50.0}, {"joint_velocity": (0.0,)}),
    ],
    ids=["none", "two", "per entry", "negative factor", "factor of zero"],
)
def test_mjlab_metadata_come_back_as_they_were(contract):
    read = mjlab_contract(mjlab_metadata(contract), load_robot("go2"), source="policy.onnx")
    for term, wanted in zip(read.observation, contract.observation, strict=True):
        assert (term.name, term.scale) == (wanted.name, wanted.scale)
        if wanted.scale == (0.0,):
            continue  # always zero, clipped or not
        assert (term.clip is None) == (wanted.clip is None)
        assert np.allclose(term.clip or 0.0, wanted.clip or 0.0, rtol=1e-12)
    rest = [name for name in contract.to_dict() if name not in ("observation", "provenance")]
    assert [getattr(read, name) for name in rest] == [getattr(contract, name) for name in rest]


@pytest.mark.parametrize("clip", [100.0, (1.0, 2.0, 3.0)])
def test_clips_that_mjlab_cannot_express_leave_its_names_out(clip, tmp_path):
    """Its runtime refuses a file without them; the clips that it found there were others, or none."""
    contract = clipped({"command": clip})  # which has a factor per entry
    assert mjlab_metadata(contract) == {}
    policy = make_policy("mlp", contract)
    export_onnx(policy, tmp_path / "policy.onnx")
    assert load_policy(tmp_path / "policy.onnx").contract == contract


def test_a_file_that_does_not_describe_itself_says_what_was_taken_for_granted(moe_onnx, tmp_path, caplog):
    bare = onnx.load(moe_onnx[1])
    del bare.metadata_props[:]
    onnx.save(bare, tmp_path / "bare.onnx")
    load_policy(moe_onnx[1])
    assert "taken for granted" not in caplog.text
    load_policy(tmp_path / "bare.onnx")
    said = [r.getMessage() for r in caplog.records if "taken for granted" in r.getMessage()]
    assert len(said) == 1
    for fact in (
        "5 frames, term-major",
        "joints FL_hip, FL_thigh",
        "joint_velocity × 0.05",
        "kp 20 and kd 0.5",
        "bare.onnx",
    ):
        assert fact in said[0]


def test_a_contract_file_says_how_a_file_is_run(moe_onnx, tmp_path):
    (tmp_path / "contract.toml").write_text(
        "action_scale = [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]\n"
        '[history]\nlength = 5\norder = "frame-major-newest-first"\nstart = "repeat"\n'
        '[[observation]]\nname = "command"\nscale = [2.0, 2.0, 0.25]\n'
        '[[observation]]\nname = "base_angular_velocity_b"\nscale = [0.25]\n'
        '[[observation]]\nname = "projected_gravity_b"\nscale = [1.0]\n'
        '[[observation]]\nname = "joint_position"\nscale = [1.0]\n'
        '[[observation]]\nname = "joint_velocity"\nscale = [0.05]\n'
        '[[observation]]\nname = "last_action"\nscale = [1.0]\n'
    )
    imported = import_policy(moe_onnx[1], tmp_path / "mine.gauge.pt", contract_file=tmp_path / "contract.toml")
    policy = imported.contract
    assert policy.history == History(length=5, order="frame-major-newest-first", start="repeat")
    assert policy.observation[0].name == "command" and policy.action_scale == (0.5,) * 12
    assert policy.stiffness == standard_contract(load_robot("go2")).stiffness and "assumed" not in policy.provenance
    (tmp_path / "contract.toml").write_text("actionscale = 1")
    with pytest.raises(PolicyError, match="actionscale"):
        import_policy(moe_onnx[1], tmp_path / "mine.gauge.pt", contract_file=tmp_path / "contract.toml")


def test_term_major_order():
    contract = standard_contract(load_robot("go2"))
    order = term_major_order(contract, 5)
    assert sorted(order.tolist()) == list(range(225))
    # Frame 0 begins the block of every term, the next frame follows within the block.
    assert order[:9].tolist() == [0, 1, 2, 15, 16, 17, 30, 31, 32]
    assert order[45:48].tolist() == [3, 4, 5]


def test_deploy_file_says_what_the_contract_says(tmp_path):
    robot = load_robot("go2")
    stiffness = tuple(20.0 + i / 7.0 for i in range(12))
    terms = tuple(
        replace(t, clip=100.0 if t.name == "joint_velocity" else None) for t in standard_contract(robot).observation
    )
    contract = replace(standard_contract(robot), stiffness=stiffness, observation=terms)
    policy = make_policy("moe", contract)
    export_deploy(policy, tmp_path / "deploy.yaml", robot)
    data = yaml.safe_load((tmp_path / "deploy.yaml").read_text())
    assert data["joint_ids_map"] == [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    assert data["stiffness"][:3] == list(stiffness[3:6])  # the SDK begins with the front right leg
    assert data["step_dt"] == 0.02
    read = deploy_contract(tmp_path / "deploy.yaml", robot)
    assert read.stiffness == stiffness and read.history.length == 5 and read.history.order == "term-major"


def test_deploy_refuses_what_it_cannot_say(tmp_path):
    robot = load_robot("go2")
    terms = tuple(
        replace(t, clip=(1.0, 2.0, 3.0)) if t.name == "command" else t for t in standard_contract(robot).observation
    )
    policy = make_policy("moe", replace(standard_contract(robot), observation=terms))
    with pytest.raises(ExportError, match="one clip for all entries"):
        export_deploy(policy, tmp_path / "deploy.yaml", robot)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ExportError, match="add sdk_joint_names"):
        export_deploy(make_policy("moe"), tmp_path / "deploy.yaml", replace(robot, sdk_joint_names=None))


@pytest.mark.slow
def test_export_all(tmp_path):
    written = export_policy(make_policy("moe"), tmp_path / "exported", load_robot("go2"))
    assert sorted(p.name for p in (tmp_path / "exported").iterdir()) == ["deploy.yaml", "policy.onnx", "policy.pt"]
    assert max(written.values()) <= 1e-5


def test_a_wrong_export_is_not_left_behind(tmp_path, monkeypatch):
    policy = make_policy("cts")
    path = tmp_path / "policy.pt"
    path.write_bytes(b"previous")
    monkeypatch.setattr(export, "Explained", WrongOutput)
    with pytest.raises(ExportError, match="differs from it by"):
        export_torchscript(policy, path)
    assert path.read_bytes() == b"previous" and [p.name for p in tmp_path.iterdir()] == ["policy.pt"]


class WrongOutput(export.Explained):
    def forward(self, history):
        actions, *rest = super().forward(history)
        return actions + 1e-3, *rest


def test_bad_input(tmp_path, scripted):
    policy, path = scripted("cts")
    with pytest.raises(ExportError, match="exported file already"):
        export_onnx(load_policy(path), tmp_path / "again.onnx")
    with pytest.raises(ExportError, match=r"cannot write .*: no such file"):
        export_torchscript(policy, Path(tmp_path / "none" / "policy.pt"))
