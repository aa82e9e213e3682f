"""Keep the last good state of a run's networks in the host's memory: it is left when another process is lost.

A GPU that waits for a message from a lost process answers no more, so its memory is copied out after every iteration; the copy runs while
the next rollout begins.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch


class Keepsake:
    """A copy of a tree of dictionaries, lists, tensors and plain data."""

    def __init__(self) -> None:
        self._copy: Any = None
        self.iteration = -1
        """Iteration after which the copy was taken, −1 without one."""
        self._done: torch.cuda.Event | None = None

    def keep(self, tree: Mapping[str, Any], iteration: int, device: torch.device | str) -> None:
        """Copy; on a GPU without waiting for it. The tree has the same tensors every time."""
        self._copy = _copied(tree, self._copy)
        self.iteration = iteration
        if torch.device(device).type == "cuda":
            self._done = torch.cuda.Event()
            self._done.record(torch.cuda.current_stream(device))

    def settle(self) -> None:
        """Wait until the copy is complete; from then on ``take`` asks nothing of the device."""
        if self._done is not None:
            self._done.synchronize()
            self._done = None

    def take(self) -> Mapping[str, Any] | None:
        """Return the copy, None if there is none."""
        self.settle()
        return self._copy


def host_copy(tree: Mapping[str, Any], device: torch.device | str) -> Mapping[str, Any]:
    """Return a copy of a tree in the host's memory."""
    copy: Mapping[str, Any] = _copied(tree, None)
    if torch.device(device).type == "cuda":
        torch.cuda.current_stream(device).synchronize()
    return copy


def _copied(tree: Any, into: Any) -> Any:
    if isinstance(tree, torch.Tensor):
        if not isinstance(into, torch.Tensor) or into.shape != tree.shape:
            into = torch.empty(tree.shape, dtype=tree.dtype, device="cpu", pin_memory=tree.is_cuda)
        return into.copy_(tree.detach(), non_blocking=True)
    if isinstance(tree, Mapping):
        return {key: _copied(value, into.get(key) if into else None) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return type(tree)(_copied(value, into[i] if into else None) for i, value in enumerate(tree))
    return tree
