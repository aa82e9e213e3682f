"""Writes a policy of the project's own as the published training code would export it, to measure how fast such files are.

    python benchmarks/published_form.py POLICY FILE.pt

One robot's observation goes in, the history is inside, the batch of one stands in the shapes, the heads of the experts are a
convolution with groups, and the output is ``(actions, (weights, latent))``. The weights are the policy's (``moe_cts`` with a
head for each expert), so that it walks as the policy does.
"""

from __future__ import annotations

import argparse
import warnings

import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import NativePolicy
from gaitgauge.policy.networks.architectures import MoeCtsNetwork
from torch import nn
from torch.nn import functional


class PublishedForm(nn.Module):
    """A mixture of experts for one robot."""

    def __init__(self, network: MoeCtsNetwork) -> None:
        super().__init__()
        encoder = network.encoder
        experts, latent, width = encoder.head_weight.shape
        self.num_experts, self.latent_width, self.history_length = experts, latent, network.history_length
        self.history = torch.zeros(1, network.history_length, network.frame_width)
        self.trunk = nn.Sequential(*encoder.trunk)
        self.gate = nn.Sequential(*encoder.gate, nn.Softmax(dim=-1))
        self.heads = nn.Conv1d(experts * width, experts * latent, kernel_size=1, groups=experts)
        self.heads.weight.data = encoder.head_weight.reshape(experts * latent, width, 1).clone()
        self.heads.bias.data = encoder.head_bias.reshape(-1).clone()
        self.actor = nn.Sequential(*network.actor)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """Actions (1, J), and gate weights (1, K) with latent (1, L), for an observation (1, F)."""
        self.history = torch.cat([self.history[:, 1:], x.unsqueeze(1)], dim=1)
        history = self.history.reshape(1, -1)
        weights = self.gate(history)
        experts = self.heads(self.trunk(history).unsqueeze(-1)).squeeze(-1)
        experts = experts.reshape(-1, self.num_experts, self.latent_width)
        latent = functional.normalize(torch.sum(weights.unsqueeze(-1) * experts, dim=1), p=2.0, dim=-1)
        return self.actor(torch.cat([latent, x], dim=1)), (weights, latent)

    @torch.jit.export
    def reset(self) -> None:
        """Forget the history."""
        self.history = torch.zeros_like(self.history)


def main() -> None:
    """Load, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("file")
    arguments = parser.parse_args()
    policy = load_policy(arguments.policy)
    network = policy.network if isinstance(policy, NativePolicy) else None
    if not isinstance(network, MoeCtsNetwork) or network.encoder.head_weight.shape[0] != network.encoder.num_experts:
        raise SystemExit(f"'{arguments.policy}' is no mixture of experts with a head for each; try pretrained")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(PublishedForm(network).eval()), arguments.file)


if __name__ == "__main__":
    main()
