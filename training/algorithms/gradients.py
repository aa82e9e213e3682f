"""Gradients of one minibatch: shared among processes, and made fit for an optimizer without asking the device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import nn


def clip_gradients(parameters: Iterable[nn.Parameter], limit: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Limit the joint gradient norm, in place; gradients that are not finite become zero.

    Args:
        parameters: those without a gradient are left out.
        limit: largest norm.

    Returns:
        The norm before, and 1.0 if the gradients were dropped, else 0.0; both ().
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    norm = nn.utils.get_total_norm(gradients)
    finite = torch.isfinite(norm)
    factor = torch.where(finite, (limit / (norm + 1e-6)).clamp(max=1.0), torch.zeros_like(norm))
    torch._foreach_mul_(gradients, factor)
    for gradient in gradients:
        gradient.nan_to_num_(0.0, 0.0, 0.0)
    return norm, (~finite).float()


class FlatGradients:
    """All gradients of an optimizer, and a few more numbers, in one tensor: one message between processes."""

    def __init__(self, parameters: Sequence[nn.Parameter], *, extra: int = 0) -> None:
        """Allocate; ``extra`` numbers travel with the gradients."""
        self._parameters = parameters
        self.values = torch.zeros(sum(p.numel() for p in parameters) + extra, device=parameters[0].device)
        """What the processes average."""
        *views, self.extra = self.values.split([*(p.numel() for p in parameters), extra])
        self._views = [view.view_as(p) for view, p in zip(views, parameters, strict=True)]

    def gather(self) -> None:
        """Take the parameters' gradients, and be their gradients from now on."""
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in self._parameters]
        torch._foreach_copy_(self._views, gradients)
        for parameter, view in zip(self._parameters, self._views, strict=True):
            parameter.grad = view
