"""Actors that are composed of experts and shared by teacher and student: what AC-MoE and MCP have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from ..configuration import ConfigurationError, TrainingConfiguration
from ..networks import CtsActor
from .ppo import Widths


def composed_arguments(configuration: TrainingConfiguration, widths: Widths) -> dict[str, Any]:
    """Arguments of a network of ``policy.composed``.

    Raises:
        ConfigurationError: the student's encoder is no plain one.
    """
    network = configuration.network
    if network.student_encoder != "mlp":
        raise ConfigurationError(
            f"student_encoder is {network.student_encoder!r}; the method {configuration.algorithm.method!r} has its experts in "
            "the actor and takes 'mlp'."
        )
    return {
        "frame_width": widths.frame,
        "num_actions": widths.actions,
        "history_length": widths.history,
        "latent_width": network.latent_width,
        "encoder_hidden": list(network.student_hidden),
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
