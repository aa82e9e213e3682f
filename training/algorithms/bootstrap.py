"""Beginning a method's training with a deployed policy alone, which has none of what only training needs: no critic, no teacher,
no decoder.

While it lasts, the student acts in all environments; encoder, actor and exploration noise stand still, and what the policy lacks
is learned for it. Afterwards training goes on as if it had never been cut in two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import nn

from .optimization import FlatGradients

if TYPE_CHECKING:
    from .ppo import PPO


class Bootstrap:
    """Learns what a bare policy lacks from the policy's behaviour, for a number of iterations."""

    def __init__(
        self,
        algorithm: PPO,
        iterations: int,
        *,
        parameters: Sequence[nn.Parameter],
        losses: Callable[..., torch.Tensor],
        names: Sequence[str],
    ) -> None:
        """Prepare an optimizer of its own: the algorithm's starts fresh once the policy is followed.

        Args:
            algorithm: whose rollout and settings count.
            losses: from the rows of a minibatch, one tensor for each group of environments, to one number for each name.
        """
        self._algorithm = algorithm
        self._left = iterations
        self._parameters, self._losses, self._names = list(parameters), losses, names
        self._gradients = FlatGradients(self._parameters)
        self._optimizer = torch.optim.Adam(self._parameters, lr=1e-3)

    @property
    def over(self) -> bool:
        """Whether it has done its iterations."""
        return self._left <= 0

    def update(self) -> dict[str, float]:
        """All passes over one rollout.

        Returns:
            Means of the losses over the minibatches, by name.
        """
        algorithm = self._algorithm
        settings = algorithm.configuration
        groups = algorithm.storage.minibatch_rows(settings.minibatches)
        sums = torch.zeros(len(self._names), device=groups[0].device)
        for _ in range(settings.epochs):
            for minibatch in zip(*groups, strict=True):
                losses = self._losses(*minibatch)
                self._optimizer.zero_grad(set_to_none=True)
                losses.sum().backward()
                self._gradients.gather()
                algorithm.processes.average(self._gradients.values)
                torch.nn.utils.clip_grad_norm_(self._parameters, settings.max_gradient_norm)
                self._optimizer.step()
                sums += losses.detach()
        self._left -= 1
        means = (sums / (settings.epochs * settings.minibatches)).tolist()
        return dict(zip(self._names, means, strict=True)) | {"skipped_minibatches": 0.0}
