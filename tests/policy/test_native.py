import json

import numpy as np
import pytest
import torch
from gaitgauge.policy import native
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import ForeignFile, FrozenNetwork, StoredNetwork, frozen, save_policy
from gaitgauge.policy.networks import architectures as networks
from gaitgauge.policy.networks.architectures import CtsNetwork, ExpertMixture, MlpNetwork, MoeCtsNetwork
from torch import nn

EPISODES, RESET_STEP, RESET_ROW = 4, 6, 2


def reference_cts(network: CtsNetwork, observations: torch.Tensor) -> np.ndarray:
    """The public policy's description in NumPy: history of 5 oldest first, zeros at the start, unit latent before the
    observation.
    """
    weights = {k: v.numpy() for k, v in network.state_dict().items()}

    def perceptron(name: str, x: np.ndarray) -> np.ndarray:
        layers = sorted({int(k.split(".")[1]) for k in weights if k.startswith(name)})
        for layer in layers:
            x = weights[f"{name}.{layer}.weight"] @ x + weights[f"{name}.{layer}.bias"]
            if layer != layers[-1]:
                x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
        return x

    frames, actions = [np.zeros(45, np.float32)] * 5, []
    for observation in observations.numpy():
        frames = [*frames[1:], observation]
        latent = perceptron("encoder", np.concatenate(frames))
        actions.append(perceptron("actor", np.concatenate([latent / np.linalg.norm(latent), observation])))
    return np.array(actions)


def test_cts_follows_its_description(cts_network, cts_file, observations):
    session = load_policy(cts_file).session(1)
    mine = torch.cat([session.act(o[:1]) for o in observations])
    np.testing.assert_allclose(mine, reference_cts(cts_network, observations[:, 0]), atol=1e-5)


def test_batch_equals_rows_with_partial_reset(cts_file, observations, run):
    policy = load_policy(cts_file)
    batch = run(policy.session(EPISODES), observations)
    assert batch.shape == (10, EPISODES, 12)
    for row in range(EPISODES):
        session = policy.session(1)
        steps = []
        for step, observation in enumerate(observations[:, row : row + 1]):
            if row == RESET_ROW and step == RESET_STEP:
                session.reset()
            steps.append(session.act(observation))
        np.testing.assert_allclose(batch[:, row : row + 1], torch.stack(steps), atol=1e-6)


def test_rows_do_not_influence_each_other(cts_file, observations, run):
    policy = load_policy(cts_file)
    poisoned = observations.clone()
    poisoned[3:, 1] = float("nan")
    a, b = run(policy.session(EPISODES), observations), run(policy.session(EPISODES), poisoned)
    others = torch.arange(EPISODES) != 1
    assert torch.equal(a[:, others], b[:, others])
    assert b[3:, 1].isnan().all()


def test_a_session_on_the_cpu_replays_its_network_to_the_last_bit(cts_file):
    policy = load_policy(cts_file)
    replayed = frozen(policy.network, 5)
    assert isinstance(replayed, FrozenNetwork)
    for rows in (1, 5, 13):
        history = torch.randn(rows, policy.network.history_length, policy.network.frame_width)
        with torch.inference_mode():
            assert torch.equal(replayed(history), policy.network(history))


def test_sessions_share_a_recording_and_nothing_else(cts_file, observations, run, monkeypatch):
    policy, recorded = load_policy(cts_file), []
    monkeypatch.setattr(native, "frozen", lambda network, count: recorded.append(count) or frozen(network, count))
    first = run(policy.session(EPISODES), observations)
    other = policy.session(EPISODES)
    run(other, observations.flip(0))
    assert torch.equal(run(policy.session(EPISODES), observations), first)
    policy.session(3)
    assert recorded == [EPISODES, 3]


class Moody(nn.Module):
    """Does something else on its second call, which a recording does not know."""

    history_length, frame_width = 1, 3

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def forward(self, history: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return history[:, -1] * (1.0 if self.calls == 1 else 2.0)


def test_a_network_that_cannot_be_replayed_is_called():
    network = Moody()
    assert frozen(network, 4) is network


def test_sessions_are_independent_and_repeatable(cts_file, observations, run):
    policy = load_policy(cts_file)
    first, second = policy.session(EPISODES), policy.session(EPISODES)
    for observation in observations[:4]:
        second.act(observation)
    assert torch.equal(run(first, observations), run(second, observations))


@pytest.mark.parametrize(
    ("architecture", "make", "arguments"),
    [
        (
            "mlp",
            MlpNetwork,
            {"frame_width": 45, "num_actions": 12, "hidden": [16], "history_length": 2, "normalize": True},
        ),
        ("moe_cts", MoeCtsNetwork, {"num_experts": 3, "expert_width": 8, "trunk_hidden": [16], "gate_hidden": [8]}),
        (
            "moe_cts",
            MoeCtsNetwork,
            {
                "num_experts": 3,
                "expert_width": 8,
                "trunk_hidden": [16],
                "shared_head": True,
                "expert_blind_to": [6, 7, 8],
            },
        ),
    ],
)
def test_every_architecture_survives_its_file(tmp_path, contract, observations, architecture, make, arguments):
    torch.manual_seed(3)
    network = make(**arguments).eval().requires_grad_(False)
    path = tmp_path / "model_10.pt"
    stored = StoredNetwork(architecture=architecture, arguments=arguments, state_dict=network.state_dict())
    save_policy(path, contract, stored)
    more = {"iter": 10, "optimizer_state_dict": {"step": torch.ones(1)}}
    torch.save(torch.load(path, weights_only=True) | more, path)
    policy = load_policy(path)
    assert policy.contract == contract
    session = policy.session(EPISODES)
    for observation in observations[: network.history_length]:
        action = session.act(observation)
    history = observations[: network.history_length].transpose(0, 1)
    assert torch.equal(action, network(history))


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        ({}, 1_088_264),
        ({"expert_width": 128, "shared_head": True, "expert_blind_to": (6, 7, 8)}, 961_460 - 205_708),
    ],
)
def test_expert_mixture_has_the_published_number_of_parameters(arguments, count):
    encoder = MoeCtsNetwork(**arguments).encoder
    assert sum(p.numel() for p in encoder.parameters()) == count
    assert sum(p.numel() for p in MoeCtsNetwork().actor.parameters()) == 205_708
    assert sum(p.numel() for p in CtsNetwork().parameters()) == 460_972


def test_expert_mixture_weighs_its_experts():
    mixture = ExpertMixture(
        frame_width=4,
        history_length=2,
        latent_width=3,
        num_experts=2,
        expert_width=5,
        trunk_hidden=(),
        gate_hidden=(),
        shared_head=False,
        expert_blind_to=(1,),
        activation="elu",
    )
    history = torch.randn(1, 2, 4)
    latent, weights = mixture(history)
    seen = history[:, :, [0, 2, 3]].flatten(1)
    features = nn.functional.elu(mixture.trunk[0](seen))
    expected = sum(
        weights[0, k] * (mixture.head_weight[k] @ features[0, 5 * k : 5 * k + 5] + mixture.head_bias[k])
        for k in range(2)
    )
    torch.testing.assert_close(latent[0], expected)
    blinded = history.clone()
    blinded[:, :, 1] += 1.0
    assert not torch.equal(mixture(blinded)[1], weights)


class Counter(nn.Module):
    """A controller with a memory: its actions are the number of steps since the reset."""

    history_length = 1
    frame_width = 45

    def initial_state(self, count: int) -> torch.Tensor:
        return torch.full((count, 1), 10.0)

    def forward(self, history: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return state.expand(-1, 12), state + 1.0


def test_networks_may_keep_a_state(tmp_path, contract, observations, monkeypatch, run):
    monkeypatch.setitem(networks.ARCHITECTURES, "counter", Counter)
    path = tmp_path / "counter.pt"
    save_policy(path, contract, StoredNetwork(architecture="counter", arguments={}, state_dict={}))
    actions = run(load_policy(path).session(EPISODES), observations)
    assert actions[:, 0, 0].tolist() == [10.0 + i for i in range(10)]
    assert actions[RESET_STEP:, RESET_ROW, 0].tolist() == [10.0 + i for i in range(10 - RESET_STEP)]


def test_wrong_inputs_and_widths(tmp_path, contract, cts_file):
    session = load_policy(cts_file).session(EPISODES)
    with pytest.raises(PolicyError, match=r"\(4, 45\)"):
        session.act(torch.zeros(EPISODES, 44))
    narrow = MlpNetwork(frame_width=45, num_actions=11, hidden=[8])
    arguments = {"frame_width": 45, "num_actions": 11, "hidden": [8]}
    stored = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=narrow.state_dict())
    with pytest.raises(PolicyError, match=r"\(1, 11\).*\(1, 12\)"):
        save_policy(tmp_path / "narrow.pt", contract, stored)
    with pytest.raises(PolicyError, match="44"):
        wide = MlpNetwork(frame_width=44, num_actions=12, hidden=[8])
        arguments = {"frame_width": 44, "num_actions": 12, "hidden": [8]}
        save_policy(
            tmp_path / "w.pt",
            contract,
            StoredNetwork(architecture="mlp", arguments=arguments, state_dict=wide.state_dict()),
        )
    assert not list(tmp_path.glob("*.partial")) and not (tmp_path / "w.pt").exists()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"version": 99}, "version 99"),
        ({"contract": None}, "contract"),
        ({"contract": "{"}, "JSON"),
        ({"network": {"kind": "magic"}}, "magic"),
        ({"network": {"kind": "native", "architecture": "nose", "arguments": "{}"}}, "nose"),
        ({"network": {"kind": "native", "architecture": "cts", "arguments": "{"}}, "arguments"),
        ({"network": {"kind": "native", "architecture": "cts", "arguments": '{"colour": 1}'}}, "colour"),
        ({"network": {"kind": "native", "architecture": "cts", "arguments": "{}"}}, "do not fit"),
        ({"network": {"kind": "onnx"}}, "onnx"),
        ({"state_dict": {"encoder.0.weight": 3}}, "state_dict"),
        ({"state_dict": {}}, "do not fit"),
    ],
)
def test_malformed_files_end_in_one_sentence(tmp_path, cts_file, changes, named):
    entries = torch.load(cts_file, weights_only=True)
    del entries["checksum"]  # as files from before it was written
    path = tmp_path / "changed.pt"
    torch.save({**entries, **changes}, path)
    with pytest.raises(PolicyError, match=named) as caught:
        load_policy(path)
    assert "\n" not in str(caught.value)


def test_file_is_plain_data(cts_file, contract):
    entries = torch.load(cts_file, weights_only=True)
    assert entries["format"] == "gaitgauge-policy"
    assert json.loads(entries["contract"])["joint_names"] == list(contract.joint_names)


def test_foreign_bytes_are_kept_as_they_are(tmp_path, contract):
    path = tmp_path / "foreign.pt"
    save_policy(path, contract, ForeignFile(kind="onnx", data=b"\x08\x07abc"))
    entries = torch.load(path, weights_only=True)
    assert entries["network"]["bytes"].numpy().tobytes() == b"\x08\x07abc"
