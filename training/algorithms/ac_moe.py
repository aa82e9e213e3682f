"""AC-MoE (paper, ablation, after MoE-Loco): CTS with a plain student encoder, and experts in actor and critic.

The actor mixes the actions of its experts; the critic's value heads, one for each expert, are mixed with the actor's weights, so that
values train the gate too, and through it the teacher encoder. Both learn from teacher and student samples, and so does the balance of the
experts, which is part of the policy's loss.
"""

from __future__ import annotations

from typing import Any

import torch

from ...policy.networks.layers import Experts, mixed
from ..configuration import NetworkConfiguration, TrainingConfiguration
from ..networks import ComposedActor, ValueNetwork, Widths, composed_arguments
from .cts import CTS, CtsLosses
from .losses import POLICY_LOSSES, load_balance


class AcMoeActor(ComposedActor):
    """An actor that mixes the actions of its experts."""

    def decide(self, latent: torch.Tensor, policy: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean actions (N, J) and weights of the experts (N, K); see ``StudentActor``."""
        (mean,), weights = self.composed(latent, policy)
        return mean, weights


class AcMoeCritic(ValueNetwork):
    """A value head for each of the actor's experts, on ``[latent, privileged]``."""

    def __init__(self, configuration: NetworkConfiguration, *, privileged_width: int) -> None:
        super().__init__()
        self.experts = Experts(
            inputs=configuration.latent_width + privileged_width,
            trunk_hidden=configuration.critic_hidden,
            num_experts=configuration.expert_count,
            expert_width=configuration.expert_width,
            outputs=1,
        )

    def value(
        self, latent: torch.Tensor, privileged: torch.Tensor, weights: torch.Tensor | None = None
    ) -> torch.Tensor:
        """See ``ValueNetwork``; the weights are needed."""
        assert weights is not None
        with torch.autocast(latent.device.type, enabled=False):
            return mixed(weights, self.experts.opinions(torch.cat((latent.float(), privileged), dim=-1)))


class AcMoeLosses(CtsLosses):
    """The losses of CTS, with the balance of the actor's experts in the policy's."""

    policy_names = (*POLICY_LOSSES, "load_balance", "largest_expert_share")

    def balanced(
        self, loss: torch.Tensor, metrics: torch.Tensor, weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ``Losses``."""
        balance, largest = load_balance(weights)
        figures = torch.cat((metrics, torch.stack((balance, largest)).detach()))
        return loss + self.settings.load_balance_coefficient * balance, figures


class AcMoe(CTS):
    """CTS with experts in actor and critic. See the module docstring."""

    losses_class, actor_class, critic_class = AcMoeLosses, AcMoeActor, AcMoeCritic

    @classmethod
    def deployed(cls, configuration: TrainingConfiguration, widths: Widths) -> tuple[str, dict[str, Any]]:
        """See ``CTS``."""
        return "ac_moe", composed_arguments(configuration, widths)

    def values(self, latent: torch.Tensor, policy: torch.Tensor, privileged: torch.Tensor) -> torch.Tensor:
        """See ``CTS``."""
        with torch.no_grad():
            weights = self.actor.decide(latent, policy)[1]
        return self.critic.value(latent, privileged, weights)
