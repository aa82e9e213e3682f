"""MCP (paper, ablation): CTS with a plain student encoder, and an actor that multiplies Gaussian primitives (Peng et al., "MCP: Learning
Composable Hierarchical Control with Multiplicative Compositional Policies", 2019).

The actions' standard deviation is that of the product: it differs from state to state, and no parameter of its own holds it.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.modules.distribution import HeteroscedasticGaussianDistribution

from ..configuration import ConfigurationError, TrainingConfiguration
from ..networks import ComposedActor, Widths, composed_arguments
from .cts import CTS


class McpActor(ComposedActor):
    """An actor that multiplies the primitives' distributions."""

    noise = HeteroscedasticGaussianDistribution

    def decide(self, latent: torch.Tensor, policy: torch.Tensor) -> tuple[torch.Tensor, None]:
        """Return the mean and standard deviation of the actions, (N, 2, J); see ``StudentActor``. The critic needs no weights, and no
        loss keeps them balanced.
        """
        (mean, deviation), _ = self.composed(latent, policy)
        return torch.stack((mean, deviation), dim=-2), None


class Mcp(CTS):
    """CTS with multiplied primitives. See the module docstring."""

    actor_class = McpActor

    @classmethod
    def deployed(cls, configuration: TrainingConfiguration, widths: Widths) -> tuple[str, dict[str, Any]]:
        """See ``CTS``."""
        if not widths.command_entries:
            raise ConfigurationError("The method 'mcp' hides the command from its primitives; the frame has none.")
        blind = {"primitives_blind_to": list(widths.command_entries)}
        return "mcp", composed_arguments(configuration, widths) | blind

    @property
    def action_std(self) -> torch.Tensor:
        """Return the mean standard deviation of the exploration noise in the rollout, (J,)."""
        return self.storage.action_std.mean(dim=(0, 1))
