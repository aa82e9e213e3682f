"""The networks of the paper's baselines and ablations: sizes, and values that were worked out by hand."""

import pytest
import torch
from gaitgauge.policy.networks.composed import AcMoeNetwork, CompositeActor, GatedActor, McpNetwork
from gaitgauge.policy.networks.estimators import VELOCITY, DreamwaqNetwork, HimNetwork
from gaitgauge.policy.networks.layers import aligned
from torch import nn


def count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_sizes_of_the_defaults():
    """By hand from the widths: a layer of a inputs and b outputs has (a + 1) b numbers."""
    encoder = 226 * 512 + 513 * 256 + 257 * 32
    gate = 78 * 512 + 513 * 256 + 257 * 8
    ac_moe = 78 * 512 + 513 * 256 + 257 * 1024 + 8 * 12 * 129 + gate
    mcp = 75 * 512 + 513 * 256 + 257 * 128 + 129 * 2048 + 8 * 24 * 257
    mcp += 78 * 512 + 513 * 256 + 257 * 128 + 129 * 8
    actor = 65 * 512 + 513 * 256 + 257 * 128 + 129 * 12
    assert count(AcMoeNetwork()) == encoder + ac_moe
    assert count(McpNetwork(primitives_blind_to=(6, 7, 8))) == encoder + mcp
    assert count(DreamwaqNetwork()) == 226 * 128 + 129 * 64 + 65 * 35 + actor
    assert count(HimNetwork()) == 226 * 128 + 129 * 64 + 65 * 19 + actor


def test_primitives_multiply_as_gaussians():
    """Two primitives of one action: mean (w1 m1 / v1 + w2 m2 / v2) v, with 1 / v = w1 / v1 + w2 / v2."""
    actor = CompositeActor(
        inputs=3,
        num_actions=1,
        num_experts=2,
        expert_width=4,
        trunk_hidden=(),
        gate_hidden=(),
        blind_to=(2,),
        activation="elu",
    )
    with torch.no_grad():
        actor.head_weight.zero_()
        actor.head_bias.copy_(torch.tensor([[2.0, 0.0], [-1.0, 0.5]]))  # mean, log of the deviation
        actor.gate[0].weight.zero_()
        actor.gate[0].bias.copy_(torch.tensor([0.0, 1.0986123]))  # sigmoid: 1/2 and 3/4
        weights = actor.weigh(torch.zeros(1, 3))
        mean, deviation = actor(torch.zeros(1, 3), weights)
    precision = (0.5 / 1.0, 0.75 / 2.7182817)
    assert weights[0].tolist() == pytest.approx([0.5, 0.75])
    assert float(deviation) == pytest.approx(sum(precision) ** -0.5, rel=1e-5)
    assert float(mean) == pytest.approx((2.0 * precision[0] - precision[1]) / sum(precision), rel=1e-5)


def test_primitives_do_not_see_the_command_and_the_gate_does():
    torch.manual_seed(0)
    network = McpNetwork(primitives_blind_to=(6, 7, 8)).eval()
    history = torch.randn(2, 5, 45)
    other = history.clone()
    other[:, -1, 6:9] += 1.0
    values = [torch.cat((torch.zeros(2, 32), frames[:, -1]), dim=-1) for frames in (history, other)]
    seen = [network.actor.opinions(v[:, network.actor.seen]) for v in values]
    assert torch.equal(*seen)
    assert not torch.equal(network.actor.weigh(values[0]), network.actor.weigh(values[1]))


def test_a_gated_actor_weighs_its_experts():
    torch.manual_seed(0)
    actor = GatedActor(
        inputs=4, num_actions=3, num_experts=2, expert_width=5, trunk_hidden=(), gate_hidden=(), activation="elu"
    )
    values = torch.randn(1, 4)
    weights = actor.weigh(values)
    (action,) = actor(values, weights)
    features = nn.functional.elu(actor.trunk[0](values))
    expected = sum(
        weights[0, k] * (actor.head_weight[k] @ features[0, 5 * k : 5 * k + 5] + actor.head_bias[k]) for k in range(2)
    )
    torch.testing.assert_close(action[0], expected)
    assert weights.sum().item() == pytest.approx(1.0)


@pytest.mark.parametrize("make", [DreamwaqNetwork, HimNetwork])
def test_an_estimate_is_velocity_then_latent(make):
    torch.manual_seed(0)
    network, history = make(), torch.randn(3, 5, 45)
    action, estimate = network.explained(history)
    encoded = network.encoder(history.flatten(1))
    assert estimate.shape == (3, VELOCITY + 16) and torch.equal(estimate[:, :3], encoded[:, :3])
    if make is HimNetwork:
        torch.testing.assert_close(estimate[:, 3:].norm(dim=1), torch.ones(3))
    else:
        assert torch.equal(estimate[:, 3:], encoded[:, 3:19])
    assert torch.equal(action, network.actor(torch.cat((estimate, history[:, -1]), dim=1)))


@pytest.mark.parametrize(("width", "filled"), [(225, 232), (263, 264), (77, 80), (512, 512)])
def test_rows_that_are_filled_up_change_no_product_and_no_gradient(width, filled):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(7, width, generator=generator, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(5, width, generator=generator, dtype=torch.float64, requires_grad=True)
    longer, wider = aligned(values, weight)
    assert (longer.shape, wider.shape) == ((7, filled), (5, filled))
    plain, other = values @ weight.t(), longer @ wider.t()
    assert torch.allclose(plain, other, rtol=0.0, atol=1e-12)
    up = torch.randn(7, 5, generator=generator, dtype=torch.float64)
    for one, two in zip(
        torch.autograd.grad(plain, (values, weight), up), torch.autograd.grad(other, (values, weight), up), strict=True
    ):
        assert torch.allclose(one, two, rtol=0.0, atol=1e-12)
