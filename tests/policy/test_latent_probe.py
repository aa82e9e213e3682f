import pytest
import torch
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.latent_probe import watched_session
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import NativePolicy, StoredNetwork
from gaitgauge.policy.networks.architectures import ARCHITECTURES
from gaitgauge.robots import load_robot


def policy_of(architecture: str, **arguments: object) -> NativePolicy:
    torch.manual_seed(0)
    network = ARCHITECTURES[architecture](**arguments)
    stored = StoredNetwork(architecture=architecture, arguments=arguments, state_dict=network.state_dict())
    return NativePolicy(standard_contract(load_robot("go2")), stored, path=architecture)


def test_a_watched_policy_acts_as_ever_and_shows_latent_and_weights():
    policy = load_policy("pretrained")
    session, network = watched_session(policy, 3)
    plain = policy.session(3)
    observations = torch.randn(4, 3, policy.contract.observation_width)
    for observation in observations:
        assert torch.allclose(session.act(observation), plain.act(observation), atol=1e-5)
        assert network.latent is not None and network.weights is not None
        assert torch.allclose(network.latent.norm(dim=1), torch.ones(3), atol=1e-5)
        assert torch.allclose(network.weights.sum(dim=1), torch.ones(3), atol=1e-5)
    assert network.latent.shape == (3, 32) and network.weights.shape == (3, 8)


def test_what_is_shown_is_what_the_layers_give():
    policy = policy_of("cts", encoder_hidden=[8], actor_hidden=[8])
    session, network = watched_session(policy, 2)
    observation = torch.randn(2, 45)
    session.act(observation)
    frames = torch.cat((torch.zeros(2, 4, 45), observation[:, None]), dim=1).flatten(1)
    layers = {name: value for name, value in policy.network.state_dict().items() if name.startswith("encoder")}
    hidden = torch.nn.functional.elu(frames @ layers["encoder.0.weight"].T + layers["encoder.0.bias"])
    latent = hidden @ layers["encoder.2.weight"].T + layers["encoder.2.bias"]
    assert torch.allclose(network.latent, latent / latent.norm(dim=1, keepdim=True), atol=1e-5)
    assert network.weights is None


def test_a_policy_without_encoder_and_experts_is_refused_in_one_sentence():
    policy = policy_of("mlp", frame_width=45, num_actions=12, hidden=[8])
    with pytest.raises(PolicyError, match="'mlp' has neither an encoder nor experts"):
        watched_session(policy, 1)
