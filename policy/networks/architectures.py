"""The network architectures that the project's own policy files name.

A network is a ``torch.nn.Module`` with two attributes, ``history_length`` (frames it looks at, the current one
included) and ``frame_width`` (width of its input at one step; the contract's ``observation_width``), and one of two
interfaces:

- ``forward(history) -> action`` for ``history`` (N, H, F), oldest frame first and the current one last, and ``action``
  (N, J). The session keeps the history; the contract says how it starts.
- with a memory of its own, in addition ``initial_state(n) -> (n, S)`` and ``forward(history, state) -> (action,
  state)``. The session keeps the state, and resets rows of it.

A network with an encoder or with experts also has ``encode(history) -> (latent, weights)``, which ``forward`` goes
through: what its actor is given of the history (N, L), None for no encoder, and the gate's weights (N, K), None for no
experts; they add up to one but for MCP, which weighs each primitive for itself. ``gaitgauge latent`` looks at both.
With a latent it also has ``explained(history)``: the actions, the latent, and the weights where it has experts, which is
what its TorchScript export gives out.

Row i of the output may depend on row i of the input alone. ``ARCHITECTURES`` maps an architecture's name to the
function that builds it from the keyword arguments stored in the file, which are plain JSON data. State-dict keys are
part of the file format.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn

from .composed import AcMoeNetwork, McpNetwork
from .estimators import DreamwaqNetwork, HimNetwork
from .layers import EncoderNetwork, GatedExperts, mixed, multilayer_perceptron, unit
from .trot import TrotController


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
        self.history_length, self.frame_width, self.normalize = history_length, frame_width, normalize
        width = frame_width * history_length
        if normalize:
            self.register_buffer("mean", torch.zeros(1, width))
            self.register_buffer("deviation", torch.ones(1, width))
        self.network = multilayer_perceptron((width, *hidden, num_actions), activation=activation)

    def forward(self, history: torch.Tensor) -> torch.Tensor:
        """Return actions (N, J) for ``history`` (N, H, F)."""
        features = history.flatten(1)
        if self.normalize:
            features = (features - self.mean) / self.deviation
        return self.network(features)


class RecurrentNetwork(nn.Module):
    """Act by a perceptron on what a recurrent layer (LSTM or GRU) remembers, as rsl_rl's recurrent actors do.

    State dict: ``rnn.*`` as torch names it, ``network.<layer>.weight|bias``, and ``mean``, ``deviation`` (1, F) if ``normalize``.
    """

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(
        self,
        *,
        frame_width: int,
        num_actions: int,
        cell: str = "lstm",
        memory_width: int = 256,
        layers: int = 1,
        hidden: Sequence[int] = (512, 256, 128),
        activation: str = "elu",
        normalize: bool = False,
    ) -> None:
        super().__init__()
        if cell not in ("lstm", "gru"):
            raise ValueError(f"unknown recurrent layer '{cell}'; choose from: lstm, gru")
        self.history_length, self.frame_width, self.normalize = 1, frame_width, normalize
        self.shape, self.tensors = (layers, memory_width), 2 if cell == "lstm" else 1
        if normalize:
            self.register_buffer("mean", torch.zeros(1, frame_width))
            self.register_buffer("deviation", torch.ones(1, frame_width))
        self.rnn = (nn.LSTM if cell == "lstm" else nn.GRU)(frame_width, memory_width, layers)
        self.network = multilayer_perceptron((memory_width, *hidden, num_actions), activation=activation)

    def initial_state(self, n: int) -> torch.Tensor:
        """Return the state at the start of an episode, (n, S)."""
        return torch.zeros(n, self.tensors * self.shape[0] * self.shape[1])

    def forward(self, history: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (N, J) and the next state (N, S) for ``history`` (N, 1, F)."""
        features = history[:, -1]
        if self.normalize:
            features = (features - self.mean) / self.deviation
        memory = state.unflatten(1, (self.tensors, *self.shape)).permute(1, 2, 0, 3).contiguous()
        out, new = self.rnn(features[None], tuple(memory) if self.tensors == 2 else memory[0])
        following = torch.stack(new if self.tensors == 2 else (new,)).permute(2, 0, 1, 3).flatten(1)
        return self.network(out[0]), following


class CtsNetwork(EncoderNetwork):
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
        inputs = frame_width * history_length
        encoder = multilayer_perceptron((inputs, *encoder_hidden, latent_width), activation=activation)
        actor = multilayer_perceptron((latent_width + frame_width, *actor_hidden, num_actions), activation=activation)
        super().__init__(encoder, actor, history_length=history_length, frame_width=frame_width)

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, None]:
        """Return the unit latent (N, L) for ``history`` (N, H, F); there are no experts."""
        return unit(self.encoder(history.flatten(1))), None


class ExpertMixture(GatedExperts):
    """Encoder of the history as a dense mixture of experts (paper, mixture of experts): one shared trunk, a head per
    expert, a gate.

    The trunk's last layer is ``num_experts`` blocks of ``expert_width``; head k maps block k to the latent. The gate's
    softmax weighs the heads. State dict: that of ``GatedExperts``.
    """

    seen: torch.Tensor

    def __init__(
        self,
        *,
        frame_width: int,
        history_length: int,
        latent_width: int,
        expert_blind_to: Sequence[int] = (),
        **shape: Any,
    ) -> None:
        """Build the layers; ``shape`` is that of experts and gate, as ``GatedExperts`` takes it."""
        seen = [i for i in range(frame_width) if i not in set(expert_blind_to)]
        super().__init__(
            gate_inputs=frame_width * history_length, inputs=len(seen) * history_length, outputs=latent_width, **shape
        )
        self.register_buffer("seen", torch.tensor(seen, dtype=torch.int64), persistent=False)
        self.sees_all = len(seen) == frame_width

    def forward(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mixture of the experts' latents (N, L), not normalised, and gate weights (N, K) for ``history`` (N, H, F)."""
        weights = torch.softmax(self.gate(history.flatten(1)), dim=-1)
        seen = history if self.sees_all else history[:, :, self.seen]
        return mixed(weights, self.opinions(seen.flatten(1))), weights


class MoeCtsNetwork(EncoderNetwork):
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
        actor_hidden: Sequence[int] = (512, 256, 128),
        activation: str = "elu",
        **experts: Any,
    ) -> None:
        """Build the layers; ``experts`` are further arguments of ``ExpertMixture``."""
        common: dict[str, Any] = {"frame_width": frame_width, "history_length": history_length}
        encoder = ExpertMixture(latent_width=latent_width, activation=activation, **common, **experts)
        actor = multilayer_perceptron((latent_width + frame_width, *actor_hidden, num_actions), activation=activation)
        super().__init__(encoder, actor, **common)

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the unit latent (N, L) and weights of the experts (N, K) for ``history`` (N, H, F)."""
        mixture, weights = self.encoder(history)
        return unit(mixture), weights


ARCHITECTURES: dict[str, Callable[..., nn.Module]] = {
    "mlp": MlpNetwork,
    "recurrent": RecurrentNetwork,
    "cts": CtsNetwork,
    "moe_cts": MoeCtsNetwork,
    "ac_moe": AcMoeNetwork,
    "mcp": McpNetwork,
    "him": HimNetwork,
    "dreamwaq": DreamwaqNetwork,
    "trot": TrotController,
}

__all__ = ["ARCHITECTURES", "CtsNetwork", "ExpertMixture", "MlpNetwork", "MoeCtsNetwork", "multilayer_perceptron"]
