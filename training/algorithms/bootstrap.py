"""Beginning a method's training with a deployed policy alone, which has none of what only training needs: no critic, no teacher,
no decoder.

While it lasts, the student acts in all environments; encoder, actor and exploration noise stand still, and what the policy lacks
is learned for it. Afterwards training goes on as if it had never been cut in two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from ...files.parsing import shown
from .optimization import FlatGradients, load_moments, take_step

if TYPE_CHECKING:
    from .ppo import PPO


def iterations_left(state: Mapping[str, Any]) -> int:
    """Iterations left of what ``Bootstrap.save`` returned.

    Raises:
        ValueError, LookupError, TypeError: it is no such state.
    """
    left: object = state["left"]
    if type(left) is not int or left < 1:
        raise ValueError(f"what a bare policy lacks is learned for {shown(left)} more iterations")
    return left


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
        self._losses, self._names = losses, names
        parameters = list(parameters)
        self._gradients = FlatGradients(parameters, extra=len(names))
        self._optimizer = torch.optim.Adam(parameters, lr=1e-3)
        self._sums = torch.zeros(len(names) + 2, device=self._gradients.values.device)
        # Not in CUDA graphs: it is over after a few iterations.
        self._step = algorithm.joined(self._loss, self._optimizer, self._gradients, self._apply, graphs=False)

    @property
    def over(self) -> bool:
        """Whether it has done its iterations."""
        return self._left <= 0

    def save(self) -> dict[str, Any]:
        """Iterations left, and the optimizer's moments."""
        return {"left": self._left, "optimizer": self._optimizer.state_dict()}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over what ``save`` returned.

        Raises:
            ValueError, LookupError, TypeError, AttributeError: it does not fit.
        """
        self._left = iterations_left(state)
        load_moments(self._optimizer, state["optimizer"])

    def update(self) -> dict[str, float]:
        """All passes over one rollout.

        Returns:
            Means of the losses over the minibatches, by name; ``skipped_minibatches`` counts those whose gradients were not finite
            and were dropped.
        """
        algorithm, settings = self._algorithm, self._algorithm.configuration
        self._sums.zero_()
        algorithm.losses.prepare_student()
        algorithm.pass_over(algorithm.storage.minibatch_rows(settings.minibatches), self._step)
        self._left -= 1
        *sums, _, skipped = self._sums.tolist()
        total = settings.epochs * settings.minibatches
        means = {name: value / total for name, value in zip(self._names, sums, strict=True)}
        return means | {"skipped_minibatches": skipped}

    def _loss(self, *rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        losses = self._losses(*rows)
        return losses.sum(), losses.detach()

    def _apply(self) -> None:
        take_step(self._optimizer, self._gradients, self._algorithm.configuration.max_gradient_norm, self._sums)
