"""Actors that are composed of experts and shared by teacher and student: what AC-MoE and MCP have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from ..configuration import TrainingConfiguration
from ..networks import CtsActor, Widths, plain_arguments


def composed_arguments(configuration: TrainingConfiguration, widths: Widths) -> dict[str, Any]:
    """Arguments of a network of ``policy.composed``.

    Raises:
        ConfigurationError: the student's encoder is no plain one.
    """
    network = configuration.network
    return {
        **plain_arguments(configuration, widths, "has its experts in the actor"),
        "num_experts": network.expert_count,
        "expert_width": network.expert_width,
        "trunk_hidden": list(network.actor_hidden),
        "gate_hidden": list(network.gate_hidden),
    }


class ComposedActor(CtsActor):
    """Teacher encoder, and a student whose actor is composed of experts."""

    def composed(self, latent: torch.Tensor, policy: torch.Tensor) -> tuple[Sequence[torch.Tensor], torch.Tensor]:
        """What the actor says, and the weights of its experts (N, K), for latents (N, L) and frames (N, F); in float32, since
        probability ratios live on small differences of actions.
        """
        with torch.autocast(latent.device.type, enabled=False):
            values = torch.cat((latent.float(), policy), dim=-1)
            weights = self.student.actor.weigh(values)
            return self.student.actor(values, weights), weights

    def action_mean(self, latent: torch.Tensor, policy: torch.Tensor) -> torch.Tensor:
        """See ``StudentActor``."""
        return self.composed(latent, policy)[0][0]
