"""Actors composed of experts: the paper's ablations AC-MoE and MCP, with a plain encoder of the history."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from .layers import EncoderNetwork, GatedExperts, mixed, multilayer_perceptron, unit

_LEAST_LOG_STD, _LARGEST_LOG_STD = -5.0, 2.0
_LEAST_VARIANCE = 1e-9


class GatedActor(GatedExperts):
    """Actions as a mixture of the experts' actions: a softmax gate on the same input as the experts."""

    def __init__(self, *, inputs: int, num_actions: int, **shape: Any) -> None:
        super().__init__(gate_inputs=inputs, inputs=inputs, outputs=num_actions, **shape)

    def weigh(self, values: torch.Tensor) -> torch.Tensor:
        """Return the weights of the experts (N, K), which add up to one, for inputs (N, D)."""
        return torch.softmax(self.gate(values), dim=-1)

    def forward(self, values: torch.Tensor, weights: torch.Tensor) -> tuple[torch.Tensor]:
        """Return actions (N, J) for inputs (N, D) and what ``weigh`` gave for them."""
        return (mixed(weights, self.opinions(values)),)


class CompositeActor(GatedExperts):
    """Actions as the product of Gaussian primitives, each to the power of its weight (Peng et al., "MCP: Learning Composable
    Hierarchical Control with Multiplicative Compositional Policies", 2019, eq. 5 and 6). The gate sees everything, the primitives
    do not see the command: they are skills, the gate has the goal.
    """

    seen: torch.Tensor

    def __init__(self, *, inputs: int, num_actions: int, blind_to: Sequence[int], **shape: Any) -> None:
        seen = [i for i in range(inputs) if i not in set(blind_to)]
        super().__init__(gate_inputs=inputs, inputs=len(seen), outputs=2 * num_actions, **shape)
        self.register_buffer("seen", torch.tensor(seen, dtype=torch.int64), persistent=False)

    def weigh(self, values: torch.Tensor) -> torch.Tensor:
        """Return the weights of the primitives (N, K), each in (0, 1), for inputs (N, D)."""
        return torch.sigmoid(self.gate(values))

    def forward(self, values: torch.Tensor, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean and standard deviation of the actions, (N, J) each, for inputs (N, D) and what ``weigh`` gave for them."""
        mean, log_std = self.opinions(values[:, self.seen]).chunk(2, dim=-1)
        log_std = log_std.clamp(_LEAST_LOG_STD, _LARGEST_LOG_STD)
        precision = weights.t()[..., None] / (torch.exp(2.0 * log_std) + _LEAST_VARIANCE)
        variance = 1.0 / (precision.sum(dim=0) + _LEAST_VARIANCE)
        return variance * (precision * mean).sum(dim=0), variance.sqrt()


class _ComposedNetwork(EncoderNetwork):
    """An encoder of the history to a unit latent, and an actor of experts on the latent and the current frame."""

    actor: GatedActor | CompositeActor

    def __init__(
        self,
        make_actor: Callable[..., GatedActor | CompositeActor],
        *,
        frame_width: int = 45,
        num_actions: int = 12,
        history_length: int = 5,
        latent_width: int = 32,
        encoder_hidden: Sequence[int] = (512, 256),
        num_experts: int = 8,
        activation: str = "elu",
        **actor: Any,
    ) -> None:
        """Build the layers; ``actor`` holds the arguments of ``make_actor`` beside the common widths."""
        inputs = frame_width * history_length
        encoder = multilayer_perceptron((inputs, *encoder_hidden, latent_width), activation=activation)
        actor |= {"num_experts": num_experts, "activation": activation}
        made = make_actor(inputs=latent_width + frame_width, num_actions=num_actions, **actor)
        super().__init__(encoder, made, history_length=history_length, frame_width=frame_width)

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the unit latent (N, L) and weights of the actor's experts (N, K) for ``history`` (N, H, F)."""
        latent = unit(self.encoder(history.flatten(1)))
        return latent, self.actor.weigh(torch.cat((latent, history[:, -1]), dim=-1))

    def explained(self, history: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return actions (N, J), latent (N, L) and weights of the actor's experts (N, K)."""
        latent, weights = self.encode(history)
        return self.actor(torch.cat((latent, history[:, -1]), dim=-1), weights)[0], latent, weights


class AcMoeNetwork(_ComposedNetwork):
    """Run CTS with a mixture of experts as its actor (paper, ablation AC-MoE).

    State dict: ``encoder.<layer>.*``, ``actor.*`` as in ``GatedActor``.
    """

    def __init__(
        self,
        *,
        expert_width: int = 128,
        trunk_hidden: Sequence[int] = (512, 256),
        gate_hidden: Sequence[int] = (512, 256),
        **common: Any,
    ) -> None:
        super().__init__(
            GatedActor, expert_width=expert_width, trunk_hidden=trunk_hidden, gate_hidden=gate_hidden, **common
        )


class McpNetwork(_ComposedNetwork):
    """Run CTS with an actor that multiplies Gaussian primitives (paper, ablation MCP).

    State dict: ``encoder.<layer>.*``, ``actor.*`` as in ``CompositeActor``.
    """

    def __init__(
        self,
        *,
        latent_width: int = 32,
        expert_width: int = 256,
        trunk_hidden: Sequence[int] = (512, 256, 128),
        gate_hidden: Sequence[int] = (512, 256, 128),
        primitives_blind_to: Sequence[int] = (),
        **common: Any,
    ) -> None:
        """Build the layers; ``primitives_blind_to`` are entries of the current frame, as a rule the command's."""
        super().__init__(
            CompositeActor,
            latent_width=latent_width,
            expert_width=expert_width,
            trunk_hidden=trunk_hidden,
            gate_hidden=gate_hidden,
            blind_to=[latent_width + i for i in primitives_blind_to],
            **common,
        )
