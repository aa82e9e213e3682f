"""What a session gives is what its network gives for the history that the session should have kept."""

import io
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.contract import PolicyContract
from gaitgauge.policy.foreign.fenced_policy import FencedPolicy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import ARCHITECTURES, unit
from torch import nn
from torch.nn import functional

pytestmark = pytest.mark.usefixtures("programs_run_here")

EPISODES, STEPS, RESETS = 24, 12, {0: None, 5: [2, 7], 6: [2], 9: [0, 23]}
ACTIVATIONS = ("elu", "relu", "selu", "gelu", "silu", "leaky_relu", "tanh", "sigmoid")
MLP = {"frame_width": 45, "num_actions": 12, "hidden": [32, 16]}
NETWORKS = {
    "cts": ("cts", {}),
    "moe_cts": ("moe_cts", {}),
    "moe_cts, one blind head": ("moe_cts", {"expert_width": 128, "shared_head": True, "expert_blind_to": [6, 7, 8]}),
    "ac_moe": ("ac_moe", {}),
    "mcp": ("mcp", {"primitives_blind_to": [6, 7, 8]}),
    "him": ("him", {}),
    "dreamwaq": ("dreamwaq", {}),
    "mlp": ("mlp", MLP),
    "mlp, standardised history": ("mlp", {**MLP, "history_length": 3, "normalize": True}),
    **{f"mlp, {name}": ("mlp", {**MLP, "activation": name}) for name in ACTIVATIONS},
}


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def frames() -> torch.Tensor:
    return torch.randn(STEPS, EPISODES, 45, generator=torch.Generator().manual_seed(4))


def build(architecture: str, arguments: dict) -> nn.Module:
    torch.manual_seed(3)
    network = ARCHITECTURES[architecture](**arguments).eval().requires_grad_(False)
    if arguments.get("normalize"):
        network.mean.normal_()
        network.deviation.uniform_(0.5, 2.0)
    return network


def mask(rows: list[int] | None) -> torch.Tensor | None:
    if rows is None:
        return None
    chosen = torch.zeros(EPISODES, dtype=torch.bool)
    chosen[rows] = True
    return chosen


def expected_actions(network: nn.Module, observations: torch.Tensor) -> list[torch.Tensor]:
    """The network on histories put together here, from zeros after each reset."""
    length = network.history_length
    history, actions = torch.zeros(EPISODES, length, 45), []
    for step, frame in enumerate(observations):
        if step in RESETS:
            history[slice(None) if RESETS[step] is None else RESETS[step]] = 0.0
        history = torch.stack([*history.unbind(1)[1:], frame], dim=1)
        actions.append(network(history))
    return actions


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(
    "inference", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["inference mode", "plain"]
)
def test_a_session_gives_what_its_network_gives(name, inference, tmp_path, contract):
    architecture, arguments = NETWORKS[name]
    network = build(architecture, arguments)
    path = tmp_path / "policy.pt"
    save_policy(
        path, contract, StoredNetwork(architecture=architecture, arguments=arguments, state_dict=network.state_dict())
    )
    policy = load_policy(path)
    observations = frames()
    given = observations.clone()
    whole, some = policy.session(EPISODES), policy.session(EPISODES)
    chosen = torch.tensor([3, 0, 23, 2, 17, 9, 5, 11, 7, 22, 13, 1, 20, 8, 6, 16])
    kept = []
    with torch.inference_mode(inference):
        for step, (frame, expected) in enumerate(zip(given, expected_actions(network, observations), strict=True)):
            if step in RESETS:
                whole.reset(mask(RESETS[step]))
                some.reset(mask(RESETS[step]))
            action = whole.act(frame)
            kept.append(action)
            assert torch.equal(action, expected)
            rows = None if step % 4 == 3 else chosen[: 8 + 8 * (step % 2)]
            picked = slice(None) if rows is None else rows
            # the last bit may depend on the number of rows, which is why the gauge keeps to one (test_batch_invariance.py)
            torch.testing.assert_close(some.act(frame, rows)[picked], expected[picked], rtol=1e-5, atol=1e-5)
    assert torch.equal(given, observations)  # what it was handed is not its memory
    for action, expected in zip(kept, expected_actions(network, observations), strict=True):
        assert torch.equal(action, expected)  # nor is what it handed out


class WithHistory(nn.Module):
    """An export with a history of three frames inside."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(5)
        self.layers = nn.Sequential(nn.Linear(135, 32), nn.ELU(), nn.Linear(32, 12))
        self.register_buffer("history", torch.zeros(1, 3, 45))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.history = torch.cat((self.history[:, 1:], observation[:, None]), dim=1)
        return self.layers(self.history.flatten(1))


def test_a_torchscript_session_gives_what_its_module_gives(tmp_path: Path, contract: PolicyContract):
    module = WithHistory().eval().requires_grad_(False)
    archive = io.BytesIO()
    torch.jit.save(torch.jit.script(module), archive)
    path = tmp_path / "policy.pt"
    path.write_bytes(archive.getvalue())
    policy, observations = load_policy(path), frames()
    assert isinstance(policy, FencedPolicy)
    session = policy.session(EPISODES)
    with torch.inference_mode():
        module.history = torch.zeros(EPISODES, 3, 45)
        for step, frame in enumerate(observations):
            if step in RESETS:
                session.reset(mask(RESETS[step]))
                module.history[slice(None) if RESETS[step] is None else RESETS[step]] = 0.0
            some, expected = session.act(frame, torch.tensor([1, 4])), module(frame)
            torch.testing.assert_close(some[[1, 4]], expected[[1, 4]], rtol=1e-5, atol=1e-6)


def test_unit_is_what_torch_calls_normalize():
    latent = torch.randn(1000, 32, generator=torch.Generator().manual_seed(1)) * 10.0 ** torch.arange(-8, 24)
    latent[3] = 0.0
    assert torch.equal(unit(latent), functional.normalize(latent, dim=-1))
