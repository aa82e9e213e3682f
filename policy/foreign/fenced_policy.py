"""Policies with a foreign program as their network; the program runs in a process of its own (``fence``)."""

from __future__ import annotations

import functools
import logging
from collections.abc import Collection

import torch

from ..base import Interface, PolicyError, PolicySession, check_observation
from ..contract import PolicyContract, other_width
from ..native import FilePolicy, ForeignFile
from .fence.child import Child


class FencedPolicy(FilePolicy):
    """A policy in a TorchScript or ONNX file."""

    def __init__(
        self,
        stored: ForeignFile,
        child: Child,
        contract: PolicyContract,
        *,
        path: str,
        attributes: Collection[str] = (),
    ) -> None:
        """Try the program on zeros and find out how to run it in batches.

        Args:
            child: the process that has loaded it.
            attributes: names that the file's classes declare, for TorchScript.

        Raises:
            PolicyError: the program fails on zeros, or its input or output has the wrong width.
        """
        self.stored, self.contract, self.path = stored, contract, path
        self._child = child
        answer = child.ask("prepare", interface=Interface.of(contract).to_dict(), attributes=sorted(attributes))
        if width := answer.get("width"):
            raise PolicyError(f"'{path}' takes {width} values, {other_width(contract, width)}")
        self.row_by_row = answer.get("batched") is not True
        if self.row_by_row:
            _warn_of_speed(path)

    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        """Start work on ``num_episodes`` episodes; the program runs on the CPU wherever the tensors are."""
        return FencedSession(self._child, num_episodes, self.contract, self.path, device=torch.device(device))

    def rowwise_session(self, num_episodes: int) -> PolicySession:
        """Start work on ``num_episodes`` episodes, each of which goes through the program alone."""
        cpu = torch.device("cpu")
        return FencedSession(self._child, num_episodes, self.contract, self.path, device=cpu, rowwise=True)


@functools.cache  # once, and not again in each process that is forked from this one
def _warn_of_speed(path: str) -> None:
    logging.getLogger(__name__).warning(
        "'%s' runs its network for one robot at a time, which is slow, since its code fits a batch of one only; "
        "export it for any batch size, or import the checkpoint it came from (gaitgauge import)",
        path,
    )


class FencedSession(PolicySession):
    """A session in another process."""

    def __init__(
        self,
        child: Child,
        num_episodes: int,
        contract: PolicyContract,
        source: str,
        *,
        device: torch.device,
        rowwise: bool = False,
    ) -> None:
        self._ask, self._contract, self._source = child.act, contract, source
        self._session = child.session(num_episodes, contract.observation_width, contract.num_joints, rowwise=rowwise)
        self._device = None if device.type == "cpu" else device
        self._shape = torch.Size((num_episodes, contract.observation_width))
        self._forget: torch.Tensor | None = None

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``: it is done before the next action."""
        mask = torch.ones(self._shape[0], dtype=torch.bool) if episodes is None else episodes.cpu()
        self._forget = mask if self._forget is None else self._forget | mask

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        if observation.shape != self._shape:
            check_observation(observation, self._shape[0], self._contract, self._source)
        action = self._ask(self._session, observation, self._forget)
        self._forget = None
        return action if self._device is None else action.to(self._device)
