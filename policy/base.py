"""What a policy is to the rooms that run it."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch

from .contract import PolicyContract


class PolicyError(ValueError):
    """A policy cannot be loaded or run; the message says which file, what is wrong and what is allowed."""


class PolicySession(ABC):
    """A policy at work on a fixed number of episodes. One session belongs to one thread.

    Rows never influence each other: the action of an episode depends on that row's observations alone, and on the batch
    size only.
    """

    batched: bool = True
    """Whether all episodes go through the network at once; False for a foreign file that can only be run one episode at
    a time.
    """

    @abstractmethod
    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """Forget what the policy remembers of the masked episodes, (N,) bool, None for all."""

    @abstractmethod
    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Raw network output (N, J) float32, in the contract's joint order, for observations (N,
        ``contract.observation_width``) float32.

        The output is not checked: a policy may return NaN, and the caller decides what that means.

        Raises:
            PolicyError: the network fails or its output has the wrong width.
        """


class Policy(ABC):
    """A loaded policy."""

    contract: PolicyContract
    path: str
    """Where it was loaded from, as given by the user."""

    @abstractmethod
    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        """Start work on ``num_episodes`` episodes."""
