"""One draw of uniform numbers per step, handed out by name.

A single kernel fills all random numbers that a step may need, whether or not it uses them. So a captured step is a pure function of its
inputs, random numbers do not depend on what happened in other worlds, and one generator state is all that a checkpoint needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate, pairwise, starmap

import torch


class UniformColumns:
    """Named blocks of columns of one (N, C) tensor of uniform numbers in [0, 1)."""

    def __init__(self, widths: Mapping[str, int], num_envs: int, generator: torch.Generator) -> None:
        ends = list(accumulate(widths.values(), initial=0))
        self._slices = dict(zip(widths, starmap(slice, pairwise(ends)), strict=True))
        self.values = torch.zeros(num_envs, ends[-1], device=generator.device)
        self._signed = torch.zeros_like(self.values)
        self._generator = generator

    def draw(self) -> None:
        """Fill all columns anew."""
        self.values.uniform_(generator=self._generator)
        torch.mul(self.values, 2.0, out=self._signed).sub_(1.0)

    def __getitem__(self, name: str) -> torch.Tensor:
        """Return the numbers of one name, (N, width), a view."""
        return self.values[:, self._slices[name]]

    def signed(self, name: str) -> torch.Tensor:
        """Return the same numbers stretched over [-1, 1), a view."""
        return self._signed[:, self._slices[name]]

    def span(self, first: str, last: str) -> torch.Tensor:
        """Return the numbers of neighbouring names, (N, their widths together), a view."""
        return self.values[:, self._slices[first].start : self._slices[last].stop]

    def between(self, name: str, low: float, high: float) -> torch.Tensor:
        """Return the numbers of one name, uniform between two bounds, (N, width)."""
        return self[name] * (high - low) + low
