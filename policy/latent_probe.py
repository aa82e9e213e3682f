"""Watches the inside of a policy at work: its encoder's latent, and the weights of its experts."""

from __future__ import annotations

from typing import Any

import torch

from .base import Policy, PolicyError
from .native import NativePolicy, NativeSession, StoredNetwork


class WatchedNetwork:
    """Act as a network of ``architectures.py`` does, and keep the last result of its ``encode``."""

    latent: torch.Tensor | None = None
    """The actor's input from the history, (N, L); None where there is no encoder, or one of no width."""
    weights: torch.Tensor | None = None
    """The gate's weights, (N, K); None where there are no experts."""
    history: torch.Tensor
    """The network's input, (N, H, F)."""

    def __init__(self, network: Any) -> None:
        """Watch a network that has ``encode`` and no memory of its own."""
        self.history_length, self.frame_width = network.history_length, network.frame_width
        self._network = network

    def __call__(self, history: torch.Tensor) -> torch.Tensor:
        """Return actions (N, J) for ``history`` (N, H, F)."""
        self.history = history
        found = self._network.encode(history)
        self.latent, self.weights = (part if part is not None and part.shape[1] else None for part in found)
        action: torch.Tensor = self._network(history)
        return action


def watched_session(policy: Policy, num_episodes: int) -> tuple[NativeSession, WatchedNetwork]:
    """Return a session of ``num_episodes`` episodes on the CPU, and the network at work in it, to be looked at after each step.

    Raises:
        PolicyError: the policy is a foreign program that cannot be looked into, or has neither encoder nor experts.
    """
    if not isinstance(policy, NativePolicy) or not isinstance(policy.stored, StoredNetwork):
        raise PolicyError(
            f"'{policy.path}' is a program of another format, and its inside cannot be watched; give the policy as a file of "
            "the project's own or as an rsl_rl checkpoint"
        )
    if not hasattr(policy.network, "encode"):
        raise PolicyError(
            f"'{policy.path}' has neither an encoder nor experts (network '{policy.stored.architecture}'), so there is no "
            "latent to look at; give a policy of another network, such as cts or moe_cts"
        )
    watched = WatchedNetwork(policy.network)
    return NativeSession(watched, num_episodes, policy.contract, torch.device("cpu"), policy.path), watched
