"""Prepare gradients and moments for the optimizers: gradients of one minibatch, averaged over the processes without asking the device,
and moments out of a checkpoint, perhaps a stranger's, which are checked before a step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn


class FlatGradients:
    """All gradients of an optimizer, and a few more numbers, in one tensor: sent between processes and limited as one."""

    def __init__(self, parameters: Sequence[nn.Parameter], *, extra: int = 0) -> None:
        """Allocate; ``extra`` numbers travel with the gradients."""
        self._parameters = parameters
        self.values = torch.zeros(sum(p.numel() for p in parameters) + extra, device=parameters[0].device)
        """Numbers that the processes average."""
        sizes = [p.numel() for p in parameters]
        self._gradients, self.extra = self.values.split([sum(sizes), extra])
        views = self._gradients.split(sizes)
        self._views = [view.view_as(p) for view, p in zip(views, parameters, strict=True)]

    def gather(self) -> None:
        """Take the parameters' gradients, and be their gradients from now on."""
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in self._parameters]
        torch._foreach_copy_(self._views, gradients)
        for parameter, view in zip(self._parameters, self._views, strict=True):
            parameter.grad = view

    def clip(self, limit: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Limit the joint norm of the gathered gradients, in place; gradients that are not finite become zero.

        Returns:
            The norm before, and 1.0 if the gradients were dropped, else 0.0; both ().
        """
        norm = torch.linalg.vector_norm(self._gradients)
        finite = torch.isfinite(norm)
        factor = torch.where(finite, (limit / (norm + 1e-6)).clamp(max=1.0), torch.zeros_like(norm))
        self._gradients.mul_(factor).nan_to_num_(0.0, 0.0, 0.0)
        return norm, (~finite).float()


class Learner:
    """An Adam, the gradients of its parameters, and the figures of the loss that it steps along."""

    def __init__(self, parameters: Sequence[nn.Parameter], names: Sequence[str], limit: float, **settings: Any) -> None:
        """Allocate; ``names`` are those of the figures, ``limit`` is that of the gradients' joint norm, ``settings`` are Adam's."""
        self.optimizer = torch.optim.Adam(parameters, **settings)
        self.gradients = FlatGradients(parameters, extra=len(names))
        self.sums = torch.zeros(len(names) + 2, device=self.gradients.values.device)
        """Sums over the steps of the figures and of the gradients' norms, and the number of dropped gradients, (names + 2,)."""
        self._limit = limit

    def step(self) -> None:
        """Step along the gathered gradients, their joint norm limited; gradients that are not finite are dropped."""
        norm, skipped = self.gradients.clip(self._limit)
        self.optimizer.step()
        self.sums += torch.nan_to_num(torch.cat((self.gradients.extra, torch.stack((norm, skipped)))), 0.0, 0.0, 0.0)


def load_moments(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> float:
    """Take over the moments of an Adam's ``state_dict()`` and return its learning rate; its settings stay those of this run.

    Raises:
        ValueError: moments of other parameters or shapes, or an impossible learning rate.
        LookupError, TypeError, AttributeError: it is no such state.
    """
    own = optimizer.state_dict()["param_groups"]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = {}
    for number, saved in state["state"].items():
        if number not in range(len(parameters)):
            raise ValueError(f"there are moments of parameter {number!r}, of {len(parameters)}")
        shapes = {"step": (), "exp_avg": parameters[number].shape, "exp_avg_sq": parameters[number].shape}
        for name, shape in shapes.items():
            if saved[name].shape != shape:
                raise ValueError(
                    f"{name} of parameter {number} has shape {tuple(saved[name].shape)}, not {tuple(shape)}"
                )
        moments[number] = {name: saved[name] for name in shapes}
    rate = float(state["param_groups"][0]["lr"])
    if not 0.0 < rate < math.inf:
        raise ValueError(f"the learning rate is {rate:g}")
    optimizer.load_state_dict({"state": moments, "param_groups": own})
    return rate
