"""The network architectures that the project's own policy files name.

A network is a ``torch.nn.Module`` with two attributes, ``history_length`` (frames it looks at, the current one
included) and ``frame_width`` (width of its input at one step; the contract's ``observation_width``), and one of two
interfaces:

- ``forward(history) -> action`` for ``history`` (N, H, F), oldest frame first and the current one last, and ``action``
  (N, J). The session keeps the history; the contract says how it starts.
- with a memory of its own, in addition ``initial_state(n) -> (n, S)`` and ``forward(history, state) -> (action,
  state)``. The session keeps the state, and resets rows of it.

A network with an encoder or with experts also has ``encode(history) -> (latent, weights)``, which ``forward`` goes
through: what its actor is given of the history (N, L), None for no encoder, and the gate's weights (N, K), which add up
to one, None for no experts. ``gaitgauge latent`` looks at both.

Row i of the output may depend on row i of the input alone. ``ARCHITECTURES`` maps an architecture's name to the
function that builds it from the keyword arguments stored in the file, which are plain JSON data. State-dict keys are
part of the file format.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from .trot import TrotController

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


class Perceptron(nn.Sequential):
    """Layers one after another, called without hooks and detours: on the CPU these cost as much as a small layer."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Outputs (N, last width) for inputs (N, first width)."""
        for layer in self:
            if isinstance(layer, nn.Linear):
                input = functional.linear(input, layer.weight, layer.bias)
            else:
                input = layer.forward(input)
        return input


def multilayer_perceptron(
    widths: Sequence[int], *, activation: str = "elu", activate_output: bool = False
) -> Perceptron:
    """Linear layers of the given widths (input first, output last) with an activation between them.

    The linear layers are numbered 0, 2, 4 … in the state dict, as rsl_rl numbers them.
    """
    if activation not in ACTIVATIONS:
        raise ValueError(f"unknown activation '{activation}'; choose from: {', '.join(ACTIVATIONS)}")
    layers: list[nn.Module] = []
    for width_in, width_out in pairwise(widths):
        layers += [nn.Linear(width_in, width_out), ACTIVATIONS[activation]()]
    return Perceptron(*layers) if activate_output else Perceptron(*layers[:-1])


def unit(latent: torch.Tensor) -> torch.Tensor:
    """Vectors of unit length, those that are zero left zero, (…, L). To the last bit what ``functional.normalize`` gives."""
    return latent / torch.linalg.vector_norm(latent, dim=-1, keepdim=True).clamp_min(1e-12)


class MlpNetwork(nn.Module):
    """A plain perceptron on the whole history, frames oldest first, optionally on standardised input.

    State dict: ``network.<layer>.weight|bias``, and ``mean``, ``deviation`` (1, H·F) if ``normalize``.
    """

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(
        self,
        *,
        frame_width: int,
        num_actions: int,
        hidden: Sequence[int] = (512, 256, 128),
        activation: str = "elu",
        history_length: int = 1,
        normalize: bool = False,
    ) -> None:
        super().__init__()
        self.history_length = history_length
        self.frame_width = frame_width
        width = frame_width * history_length
        self.normalize = normalize
        if normalize:
            self.register_buffer("mean", torch.zeros(1, width))
            self.register_buffer("deviation", torch.ones(1, width))
        self.network = multilayer_perceptron((width, *hidden, num_actions), activation=activation)

    def forward(self, history: torch.Tensor) -> torch.Tensor:
        """Actions (N, J) for ``history`` (N, H, F)."""
        features = history.flatten(1)
        if self.normalize:
            features = (features - self.mean) / self.deviation
        return self.network(features)


class CtsNetwork(nn.Module):
    """The student of concurrent teacher-student training: an encoder of the history, and an actor on its unit latent
    (paper, method).

    State dict: ``encoder.<layer>.*`` and ``actor.<layer>.*``; the actor's input is the latent, then the current frame.
    """

    def __init__(
        self,
        *,
        frame_width: int = 45,
        num_actions: int = 12,
        history_length: int = 5,
        latent_width: int = 32,
        encoder_hidden: Sequence[int] = (512, 256),
        actor_hidden: Sequence[int] = (512, 256, 128),
        activation: str = "elu",
    ) -> None:
        super().__init__()
        self.history_length = history_length
        self.frame_width = frame_width
        self.encoder = multilayer_perceptron(
            (frame_width * history_length, *encoder_hidden, latent_width), activation=activation
        )
        self.actor = multilayer_perceptron(
            (latent_width + frame_width, *actor_hidden, num_actions), activation=activation
        )

    def forward(self, history: torch.Tensor) -> torch.Tensor:
        """Actions (N, J) for ``history`` (N, H, F)."""
        return self.actor(torch.cat((self.encode(history)[0], history[:, -1]), dim=-1))

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, None]:
        """Unit latent (N, L) for ``history`` (N, H, F); there are no experts."""
        return unit(self.encoder(history.flatten(1))), None


class ExpertMixture(nn.Module):
    """Encoder of the history as a dense mixture of experts (paper, mixture of experts): one shared trunk, a head per
    expert, a gate.

    The trunk's last layer is ``num_experts`` blocks of ``expert_width``; head k maps block k to the latent. The gate's
    softmax weighs the heads. State dict: ``trunk.<layer>.*``, ``gate.<layer>.*``, ``head_weight`` (K, latent, expert),
    ``head_bias`` (K, latent), with K = 1 if the experts share one head.
    """

    seen: torch.Tensor

    def __init__(
        self,
        *,
        frame_width: int,
        history_length: int,
        latent_width: int,
        num_experts: int,
        expert_width: int,
        trunk_hidden: Sequence[int],
        gate_hidden: Sequence[int],
        shared_head: bool,
        expert_blind_to: Sequence[int],
        activation: str,
    ) -> None:
        super().__init__()
        self.num_experts = num_experts
        self.expert_width = expert_width
        seen = [i for i in range(frame_width) if i not in set(expert_blind_to)]
        self.register_buffer("seen", torch.tensor(seen, dtype=torch.int64), persistent=False)
        self.sees_all = len(seen) == frame_width
        self.trunk = multilayer_perceptron(
            (len(seen) * history_length, *trunk_hidden, num_experts * expert_width),
            activation=activation,
            activate_output=True,
        )
        heads = 1 if shared_head else num_experts
        bound = expert_width**-0.5
        self.head_weight = nn.Parameter(torch.empty(heads, latent_width, expert_width).uniform_(-bound, bound))
        self.head_bias = nn.Parameter(torch.empty(heads, latent_width).uniform_(-bound, bound))
        self.gate = multilayer_perceptron(
            (frame_width * history_length, *gate_hidden, num_experts), activation=activation
        )

    def forward(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mixture of the experts' latents (N, L), not normalised, and gate weights (N, K) for ``history`` (N, H, F)."""
        weights = torch.softmax(self.gate(history.flatten(1)), dim=-1)
        seen = history if self.sees_all else history[:, :, self.seen]
        features = self.trunk(seen.flatten(1)).unflatten(1, (self.num_experts, self.expert_width))
        head_weight = self.head_weight.expand(self.num_experts, -1, -1)
        head_bias = self.head_bias.expand(self.num_experts, -1)
        experts = torch.bmm(features.transpose(0, 1), head_weight.transpose(1, 2)) + head_bias[:, None]
        return (weights.t()[..., None] * experts).sum(dim=0), weights


class MoeCtsNetwork(nn.Module):
    """CTS with a mixture of experts as the student's encoder: the paper's policy, and its published predecessors.

    The predecessors differ by ``expert_width=128``, ``shared_head=True`` and ``expert_blind_to=(6, 7, 8)``: their
    experts do not see the command. State dict: ``encoder.*`` as in ``ExpertMixture``, ``actor.<layer>.*`` as in
    ``CtsNetwork``.
    """

    def __init__(
        self,
        *,
        frame_width: int = 45,
        num_actions: int = 12,
        history_length: int = 5,
        latent_width: int = 32,
        num_experts: int = 8,
        expert_width: int = 256,
        trunk_hidden: Sequence[int] = (512, 256),
        gate_hidden: Sequence[int] = (512, 256),
        actor_hidden: Sequence[int] = (512, 256, 128),
        shared_head: bool = False,
        expert_blind_to: Sequence[int] = (),
        activation: str = "elu",
    ) -> None:
        super().__init__()
        self.history_length = history_length
        self.frame_width = frame_width
        self.encoder = ExpertMixture(
            frame_width=frame_width,
            history_length=history_length,
            latent_width=latent_width,
            num_experts=num_experts,
            expert_width=expert_width,
            trunk_hidden=trunk_hidden,
            gate_hidden=gate_hidden,
            shared_head=shared_head,
            expert_blind_to=expert_blind_to,
            activation=activation,
        )
        self.actor = multilayer_perceptron(
            (latent_width + frame_width, *actor_hidden, num_actions), activation=activation
        )

    def forward(self, history: torch.Tensor) -> torch.Tensor:
        """Actions (N, J) for ``history`` (N, H, F)."""
        return self.actor(torch.cat((self.encode(history)[0], history[:, -1]), dim=-1))

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Unit latent (N, L) and weights of the experts (N, K) for ``history`` (N, H, F)."""
        mixture, weights = self.encoder(history)
        return unit(mixture), weights


ARCHITECTURES: dict[str, Callable[..., nn.Module]] = {
    "mlp": MlpNetwork,
    "cts": CtsNetwork,
    "moe_cts": MoeCtsNetwork,
    "trot": TrotController,
}
