"""Begin a method's training with a deployed policy alone, which has no critic, no teacher and no decoder.

While it lasts, the student acts in all environments; encoder, actor and exploration noise stand still, and the missing networks learn
from its behaviour. Afterwards training goes on as if it had never been cut in two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import nn

from ...files.parsing import shown
from ..configuration import AlgorithmConfiguration
from .optimization import Learner, load_moments


def iterations_left(state: Mapping[str, Any]) -> int:
    """Return the iterations left of a state that ``Bootstrap.save`` returned.

    Raises:
        ValueError, LookupError, TypeError: it is no such state.
    """
    left: object = state["left"]
    if type(left) is not int or left < 1:
        raise ValueError(f"what a bare policy lacks is learned for {shown(left)} more iterations")
    return left


class Bootstrap:
    """Learns the networks that a bare policy lacks from the policy's behaviour, for a number of iterations."""

    def __init__(
        self,
        iterations: int,
        settings: AlgorithmConfiguration,
        *,
        parameters: Sequence[nn.Parameter],
        losses: Callable[..., torch.Tensor],
        names: Sequence[str],
        joined: Callable[..., Callable[..., None]],
    ) -> None:
        """Prepare an optimizer for the missing networks' ``parameters``: the algorithm's starts fresh once the policy is followed.
        ``losses`` leads from the rows of a minibatch, one tensor for each group of environments, to one number for each name; ``joined`` is
        ``PPO.joined``.
        """
        self._left, self._settings, self._names = iterations, settings, names
        self._learner = Learner(parameters, names, settings.max_gradient_norm, lr=1e-3)

        def loss(*rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            found = losses(*rows)
            return found.sum(), found.detach()

        # Not in CUDA graphs: it is over after a few iterations.
        self.step = joined(loss, self._learner, graphs=False)
        """Step on the rows of a minibatch."""

    @property
    def over(self) -> bool:
        """True once it has done its iterations."""
        return self._left <= 0

    def save(self) -> dict[str, Any]:
        """Return the iterations left and the optimizer's moments."""
        return {"left": self._left, "optimizer": self._learner.optimizer.state_dict()}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over a state that ``save`` returned; raises as ``load_moments``."""
        self._left = iterations_left(state)
        load_moments(self._learner.optimizer, state["optimizer"])

    def finish(self) -> dict[str, float]:
        """End an iteration, after all passes over its rollout, and return figures as ``PPO.update``."""
        self._left -= 1
        *sums, _, skipped = self._learner.sums.tolist()
        self._learner.sums.zero_()
        total = self._settings.epochs * self._settings.minibatches
        means = {name: value / total for name, value in zip(self._names, sums, strict=True)}
        return means | {"skipped_minibatches": skipped}
