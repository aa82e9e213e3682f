"""Layers of the networks in policy files. Their names in a state dict are part of the file format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import nn
from torch.nn import functional

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "elu": nn.ELU,
    "relu": nn.ReLU,
    "selu": nn.SELU,
    "gelu": nn.GELU,
    "silu": nn.SiLU,
    "leaky_relu": nn.LeakyReLU,
    "tanh": nn.Tanh,
    "sigmoid": nn.Sigmoid,
}


def aligned(values: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return inputs (N, I) and weights (O, I) of a linear layer with zeros behind them, so that rows fill whole multiples of 16 bytes. A
    product of 225 columns takes three times as long as one of 228 on an H200.
    """
    spare = -weight.shape[1] % 8  # as many fill 16 bytes in half precision
    if spare == 0:
        return values, weight
    return functional.pad(values, [0, spare]), functional.pad(weight, [0, spare])


def linear(values: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    """Return outputs (N, O) of a linear layer for inputs (N, I), on a GPU with rows that are aligned."""
    if values.is_cuda:
        values, weight = aligned(values, weight)
    return functional.linear(values, weight, bias)


class Perceptron(nn.Sequential):
    """Layers one after another, called without hooks and detours: on the CPU these cost as much as a small layer."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Return outputs (N, last width) for inputs (N, first width)."""
        for layer in self:
            if isinstance(layer, nn.Linear):
                input = linear(input, layer.weight, layer.bias)
            else:
                input = layer.forward(input)
        return input


def multilayer_perceptron(
    widths: Sequence[int], *, activation: str = "elu", activate_output: bool = False
) -> Perceptron:
    """Return linear layers of the given widths (input first, output last) with an activation between them.

    The linear layers are numbered 0, 2, 4 … in the state dict, as rsl_rl numbers them.
    """
    if activation not in ACTIVATIONS:
        raise ValueError(f"unknown activation '{activation}'; choose from: {', '.join(ACTIVATIONS)}")
    layers: list[nn.Module] = []
    for width_in, width_out in pairwise(widths):
        layers += [nn.Linear(width_in, width_out), ACTIVATIONS[activation]()]
    return Perceptron(*layers) if activate_output else Perceptron(*layers[:-1])


def unit(latent: torch.Tensor) -> torch.Tensor:
    """Return vectors of unit length, those that are zero left zero, (…, L). To the last bit what ``functional.normalize`` gives."""
    return latent / torch.linalg.vector_norm(latent, dim=-1, keepdim=True).clamp_min(1e-12)


class EncoderNetwork(nn.Module):
    """Act on an encoder's latent of the history and on the current frame; see ``architectures.py``.

    State dict: ``encoder.*`` and ``actor.*``; the actor's input is what the encoder gives, then the current frame.
    """

    def __init__(self, encoder: nn.Module, actor: nn.Module, *, history_length: int, frame_width: int) -> None:
        super().__init__()
        self.history_length, self.frame_width = history_length, frame_width
        self.encoder, self.actor = encoder, actor

    def forward(self, history: torch.Tensor) -> torch.Tensor:
        """Return actions (N, J) for ``history`` (N, H, F)."""
        return self.explained(history)[0]

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the actor's input from ``history`` (N, H, F), (N, L), and weights of the experts (N, K), None without experts."""
        raise NotImplementedError

    def explained(self, history: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return actions (N, J), what the encoder gives (N, L) and, with experts, their weights (N, K)."""
        latent, weights = self.encode(history)
        actions = self.actor(torch.cat((latent, history[:, -1]), dim=-1))
        return (actions, latent) if weights is None else (actions, latent, weights)


class Experts(nn.Module):
    """Several experts as one shared trunk, with a block of private features for each in its last layer, and a linear head for each.

    State dict: ``trunk.<layer>.*``, ``head_weight`` (K, output, expert), ``head_bias`` (K, output), with K = 1 if the experts
    share one head.
    """

    def __init__(
        self,
        *,
        inputs: int,
        outputs: int,
        trunk_hidden: Sequence[int] = (512, 256),
        num_experts: int = 8,
        expert_width: int = 256,
        shared_head: bool = False,
        activation: str = "elu",
    ) -> None:
        super().__init__()
        self.num_experts, self.expert_width = num_experts, expert_width
        self.trunk = multilayer_perceptron(
            (inputs, *trunk_hidden, num_experts * expert_width), activation=activation, activate_output=True
        )
        heads = 1 if shared_head else num_experts
        bound = expert_width**-0.5
        self.head_weight = nn.Parameter(torch.empty(heads, outputs, expert_width).uniform_(-bound, bound))
        self.head_bias = nn.Parameter(torch.empty(heads, outputs).uniform_(-bound, bound))

    def opinions(self, values: torch.Tensor) -> torch.Tensor:
        """Return the output of each expert for inputs (N, D), (K, N, outputs)."""
        features = self.trunk(values).unflatten(1, (self.num_experts, self.expert_width))
        head_weight = self.head_weight.expand(self.num_experts, -1, -1)
        head_bias = self.head_bias.expand(self.num_experts, -1)
        return torch.bmm(features.transpose(0, 1), head_weight.transpose(1, 2)) + head_bias[:, None]


class GatedExperts(Experts):
    """Mix experts by a gate, which may see more than they do. State dict: that of ``Experts``, and ``gate.<layer>.*``."""

    def __init__(
        self,
        *,
        gate_inputs: int,
        gate_hidden: Sequence[int] = (512, 256),
        num_experts: int = 8,
        activation: str,
        **shape: Any,
    ) -> None:
        """Build the layers; ``shape`` is that of the experts, as ``Experts`` takes it."""
        super().__init__(num_experts=num_experts, activation=activation, **shape)
        self.gate = multilayer_perceptron((gate_inputs, *gate_hidden, num_experts), activation=activation)


def mixed(weights: torch.Tensor, opinions: torch.Tensor) -> torch.Tensor:
    """Return the sum of the experts' opinions (K, N, D) with weights (N, K), (N, D)."""
    return (weights.t()[..., None] * opinions).sum(dim=0)
