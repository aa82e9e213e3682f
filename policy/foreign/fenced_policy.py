"""Policies with a foreign program as their network; the program runs in a process of its own (``fence``)."""

from __future__ import annotations

import functools
import logging
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import torch

from ..base import Interface, PolicyError, PolicySession, check_observation
from ..comparing import other_width
from ..contract import PolicyContract
from ..native import FilePolicy, ForeignFile
from .fence.child import Child


class FencedPolicy(FilePolicy):
    """A policy in a TorchScript or ONNX file."""

    def __init__(
        self, stored: ForeignFile, program: Started, contract: PolicyContract, *, path: str, encoder: Started | None
    ) -> None:
        """Try the program on zeros and find out how to run it in batches.

        Args:
            encoder: the same of the network that runs first, where the contract has one.

        Raises:
            PolicyError: the program fails on zeros, or its input or output has the wrong width.
        """
        self.stored, self.contract, self.path = stored, contract, path
        self._child, self._encoder = program.child, None if encoder is None else encoder.child
        main, batched = Interface.of(contract), True
        if encoder is not None and contract.encoder is not None:
            widths = dict(contract.input_widths)
            own = widths.pop(contract.encoder.input) if contract.encoder.input else contract.observation_width
            if len(widths) > 1:
                raise PolicyError(
                    f"'{path}' has an encoder and {len(widths)} further inputs ({', '.join(widths)}); one is allowed"
                )
            answer = encoder.prepare(Interface(inputs={"": own}, num_joints=0))
            if width := answer.get("width"):
                raise PolicyError(
                    f"its encoder '{contract.encoder.file}' takes {width} values; its layout gives it {own}"
                )
            self._latents, batched = Interface(inputs={"": own}, num_joints=answer["num_joints"]), answer["batched"]
            main = replace(main, inputs={"": sum(widths.values()) + answer["num_joints"]})
        self._main = main
        answer = program.prepare(main)
        if width := answer.get("width"):
            given = f"but its encoder and layout give it {main.observation_width}"
            raise PolicyError(f"'{path}' takes {width} values, {given if encoder else other_width(contract, width)}")
        self.row_by_row = not (batched and answer.get("batched") is True)
        if self.row_by_row:
            _warn_of_speed(path)

    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        """Start work on ``num_episodes`` episodes; the program runs on the CPU wherever the tensors are."""
        return self._begin(num_episodes, torch.device(device), rowwise=False)

    def rowwise_session(self, num_episodes: int) -> PolicySession:
        """Start work on ``num_episodes`` episodes, each of which goes through the program alone."""
        return self._begin(num_episodes, torch.device("cpu"), rowwise=True)

    def _begin(self, num_episodes: int, device: torch.device, *, rowwise: bool) -> PolicySession:
        settings: dict[str, Any] = {"device": device, "rowwise": rowwise}
        main = FencedSession(self._child, num_episodes, self._main, self.path, **settings)
        if self._encoder is None:
            return main
        encoder = FencedSession(self._encoder, num_episodes, self._latents, self.path, **settings)
        return EncodedSession(encoder, main, self.contract)


@dataclass(frozen=True, kw_only=True)
class Started:
    """A program in its process."""

    child: Child
    attributes: Collection[str]
    """Names that the file's classes declare, for TorchScript."""

    def prepare(self, interface: Interface) -> dict[str, Any]:
        """Try the program on zeros; return its answer, see the programs' ``answer``."""
        return self.child.ask("prepare", interface=interface.to_dict(), attributes=sorted(self.attributes))


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
        contract: Interface | PolicyContract,
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


class EncodedSession(PolicySession):
    """Two programs, one after the other: the second one is given what the first one gives."""

    def __init__(self, encoder: PolicySession, main: PolicySession, contract: PolicyContract) -> None:
        """Begin with a contract that has an ``encoder``."""
        assert contract.encoder is not None
        self._encoder, self._main = encoder, main
        self._latent_first, self._input = contract.encoder.latent == "first", contract.encoder.input
        self._names, self._widths = list(contract.input_widths), list(contract.input_widths.values())

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``."""
        self._encoder.reset(episodes)
        self._main.reset(episodes)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        seen, rest = observation, [observation]
        if self._input:
            parts = dict(zip(self._names, observation.split(self._widths, dim=1), strict=True))
            seen, rest = parts.pop(self._input).contiguous(), list(parts.values())
        latent = self._encoder.act(seen)
        return self._main.act(torch.cat([latent, *rest] if self._latent_first else [*rest, latent], dim=1))
