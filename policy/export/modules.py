"""Modules of exports: networks that keep their history, and networks that take it term by term."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ..networks.architectures import CtsNetwork, MlpNetwork, MoeCtsNetwork
from ..networks.composed import AcMoeNetwork, McpNetwork
from ..networks.estimators import DreamwaqNetwork, HimNetwork


class Explained(nn.Module):
    """A network as a function of its history: actions, latent, and the weights of its experts where it has any."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network: Any = network

    def forward(self, history: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return actions (N, J), latent (N, L) and weights (N, K) for frames (N, H, F)."""
        return self.network.explained(history)


class _WithMemory(nn.Module):
    """Keeps one robot's history in a tensor that ``forward`` changes. Frames begin as zeros, or NaN: copies of the first one."""

    def __init__(self, traced: nn.Module, start: torch.Tensor) -> None:
        super().__init__()
        self.network = traced
        self.history = start.clone()
        self.unseen: float = float(start[0, 0, 0])

    @torch.jit.export
    def reset(self) -> None:
        self.history = torch.full_like(self.history, self.unseen)

    def remember(self, observation: torch.Tensor) -> torch.Tensor:
        newest = observation.unsqueeze(1)
        history = torch.cat((self.history[:, 1:], newest), dim=1)
        self.history = torch.where(torch.isnan(history), newest, history)
        return self.history


class _MlpScript(_WithMemory):
    """Observation (1, F) to actions (1, J)."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.network(self.remember(observation))


class _LatentScript(_WithMemory):
    """Observation (1, F) to actions (1, J) and (nothing, latent (1, L))."""

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor | None, torch.Tensor]]:
        actions, latent = self.network(self.remember(observation))
        weights: torch.Tensor | None = None
        return actions, (weights, latent)


class _ExpertsScript(_WithMemory):
    """Observation (1, F) to actions (1, J) and (gate weights (1, K), latent (1, L))."""

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        actions, latent, weights = self.network(self.remember(observation))
        return actions, (weights, latent)


SCRIPTS: dict[type[nn.Module], type[_WithMemory]] = {
    MlpNetwork: _MlpScript,
    CtsNetwork: _LatentScript,
    HimNetwork: _LatentScript,
    DreamwaqNetwork: _LatentScript,
    MoeCtsNetwork: _ExpertsScript,
    AcMoeNetwork: _ExpertsScript,
    McpNetwork: _ExpertsScript,
}


class TermMajor(nn.Module):
    """Takes the history term by term, as Isaac Lab stacks it, and puts the frames together for the network."""

    order: torch.Tensor

    def __init__(self, network: nn.Module, order: torch.Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("order", order)
        self.frames = (int(network.history_length), int(network.frame_width))  # type: ignore[arg-type]

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Return actions (N, J) for term-major histories (N, H * F)."""
        return self.network(obs[:, self.order].unflatten(1, self.frames))
