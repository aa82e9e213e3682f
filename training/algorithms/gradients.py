"""Gradients of one minibatch, made fit for an optimizer without asking the device."""

from __future__ import annotations

from collections.abc import Iterable

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
