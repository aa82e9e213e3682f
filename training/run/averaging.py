"""Average the weights over the later part of a run: these are played, gauged and exported.

Checkpoints at the end of a run differ by chance, and the mean of their weights is better than each of them (Polyak and Juditsky,
"Acceleration of Stochastic Approximation by Averaging", 1992; Izmailov et al., "Averaging Weights Leads to Wider Optima and Better
Generalization", 2018). The average here is that of Shamir and Zhang, "Stochastic Gradient Descent for Non-smooth Optimization", 2013
(polynomial-decay averaging): after t iterations those of iteration i count about in proportion to i to the power η. It needs one copy of
the weights, forgets the untrained network within a few iterations, and its window grows with the run, so that one number fits short and
long runs alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn


class WeightAverage:
    """Average of the parameters of some modules, on their device. Updating it waits for nothing."""

    def __init__(self, modules: Mapping[str, nn.Module], *, age: float) -> None:
        """Begin with the present weights.

        Args:
            modules: by the name that their state has in checkpoints. Their parameters must stay in the memory where they are.
            age: how far back the averaged weights lie in the mean, as a fraction of the iterations done, 1 / (η + 2); 0 for the weights
                of the last iteration alone, 0.5 for the plain mean over the whole run.
        """
        self._age = age
        self._count = 0
        self._now = [value for module in modules.values() for value in module.state_dict().values()]
        self._states = {
            name: {key: value.clone() for key, value in module.state_dict().items()} for name, module in modules.items()
        }

    def update(self) -> None:
        """Take in the weights after another iteration."""
        self._count += 1
        share = 1.0
        if self._age > 0.0:
            decay = 1.0 / self._age - 2.0
            share = (decay + 1.0) / (decay + self._count)
        means = [value for state in self._states.values() for value in state.values()]
        with torch.no_grad():
            torch._foreach_lerp_(means, self._now, share)

    def state_dict(self) -> dict[str, Any]:
        """Return the averaged modules' state dictionaries, which later updates change, and the number of averaged iterations."""
        return {"iterations": self._count, **self._states}

    def load_state_dict(self, state: Mapping[str, Any] | None) -> None:
        """Continue from a ``state_dict``; None begins with the present weights.

        Raises:
            ValueError: weights of another shape.
            LookupError, TypeError, AttributeError: it is no such state.
        """
        self._count = 0 if state is None else int(state["iterations"])
        now = iter(self._now)
        for name, mean in self._states.items():
            for key, value in mean.items():
                present = next(now)
                kept = present if state is None else state[name][key]
                if kept.shape != value.shape:
                    raise ValueError(f"the average of {key} has shape {tuple(kept.shape)}, not {tuple(value.shape)}")
                value.copy_(kept)
