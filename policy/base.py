"""Defines the interface of a policy to the packages that run it."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ..files.parsing import one_line
from .contract import PolicyContract

LONGEST_MESSAGE = 1000
"""Length at which a message is cut."""


class PolicyError(ValueError):
    """Say that a policy cannot be loaded or run: which file, what is wrong and what is allowed.

    Words of the file itself may be part of it: what a terminal would act on is escaped, what is long is cut.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message, LONGEST_MESSAGE))


class PolicySession(ABC):
    """A policy at work on a fixed number of episodes. One session belongs to one thread.

    Rows never influence each other: the action of an episode depends on that row's observations alone, and on the batch
    size only.
    """

    @abstractmethod
    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """Forget what the policy remembers of the masked episodes, (N,) bool, None for all."""

    @abstractmethod
    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """Return the raw network output (N, J) float32, in the contract's joint order, for observations (N,
        ``contract.observation_width``) float32.

        ``rows`` are the indices of the episodes that need an action, None for all; the actions of the others are then
        arbitrary. Observations of all episodes enter their memories either way.

        The output is not checked: a policy may return NaN, and the caller decides what that means.

        Raises:
            PolicyError: the network fails or its output has the wrong width.
        """


class RowwiseSession(PolicySession):
    """Send every episode through the network alone: slower, and the same in every row."""

    def __init__(self, begin: Callable[[int], PolicySession], num_episodes: int) -> None:
        """Begin one session for each episode with ``begin``, which starts a session of a given number of episodes."""
        self._sessions = [begin(1) for _ in range(num_episodes)]

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession.reset``."""
        for i, session in enumerate(self._sessions):
            if episodes is None or bool(episodes[i]):
                session.reset()

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession.act``."""
        return torch.cat([session.act(observation[i : i + 1]) for i, session in enumerate(self._sessions)])


class Policy(ABC):
    """A loaded policy."""

    contract: PolicyContract
    path: str
    """Path or name that the user gave."""

    @abstractmethod
    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        """Start work on ``num_episodes`` episodes."""

    def rowwise_session(self, num_episodes: int) -> PolicySession:
        """Start work on ``num_episodes`` episodes on the CPU, each of which goes through the network alone."""
        return RowwiseSession(self.session, num_episodes)


LONGEST_ACTION = 0.1
"""Computing time that a program may take for one action of one robot [s]: five control periods of most policies."""


def timed_action(session: PolicySession, width: int, source: str) -> torch.Tensor:
    """Return the action (1, J) on zeros of a session of one robot, observations ``width`` wide.

    Raises:
        PolicyError: it takes more than ``LONGEST_ACTION``, at the second time too: the first may compile.
    """
    for last in (False, True):
        began = time.process_time()
        action = session.act(torch.zeros(1, width))
        if (took := time.process_time() - began) <= LONGEST_ACTION:
            break
        if last:
            raise PolicyError(
                f"'{source}' computes {took:.1f} s for one action of one robot; a policy may take {LONGEST_ACTION:g} s"
            )
        session.reset()
    return action


PROBE_EPISODES, _PROBE_STEPS = 3, 8
PROBE_TOLERANCE = 1e-5
"""Largest difference of an action between two ways to play a policy, absolute or relative."""


def act_alike(alone: PolicySession, together: PolicySession, width: int) -> bool:
    """Return whether ``PROBE_EPISODES`` played together act as they do alone: random observations (N, ``width``) from a reset, with
    one episode reset again on the way.
    """
    generator = torch.Generator().manual_seed(0)
    for step in range(_PROBE_STEPS):
        if step == _PROBE_STEPS // 2:
            for session in (alone, together):
                session.reset(torch.arange(PROBE_EPISODES) == 1)
        observations = torch.randn(PROBE_EPISODES, width, generator=generator)
        expected = alone.act(observations)
        try:
            actual = together.act(observations)
        except PolicyError:
            return False
        if not torch.allclose(actual, expected, rtol=PROBE_TOLERANCE, atol=PROBE_TOLERANCE, equal_nan=True):
            return False
    return True


@dataclass(frozen=True, kw_only=True)
class Interface:
    """The inputs and the output of a foreign program."""

    inputs: Mapping[str, int]
    """Width of each input by name, in the order in which an observation holds them; ``""`` for the only one."""
    num_joints: int
    """Width of the output, 0 while it is not known."""
    memory: tuple[tuple[str, str], ...] = ()
    """Input and output of each recurrent state of an ONNX file; empty: found by their names."""

    @property
    def observation_width(self) -> int:
        """Return the width of all inputs together."""
        return sum(self.inputs.values())

    @classmethod
    def of(cls, contract: PolicyContract) -> Interface:
        """Return the interface of a policy with this contract and one network."""
        return cls(inputs=contract.input_widths, num_joints=contract.num_joints, memory=contract.memory)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, ready for JSON."""
        return {"inputs": list(self.inputs.items()), "num_joints": self.num_joints, "memory": self.memory}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Interface:
        """Read what ``to_dict`` wrote."""
        memory = tuple((str(a), str(b)) for a, b in data["memory"])
        return cls(inputs=dict(data["inputs"]), num_joints=int(data["num_joints"]), memory=memory)


def check_observation(observation: torch.Tensor, rows: int, contract: PolicyContract | Interface, source: str) -> None:
    """Raise ``PolicyError``, with the policy's name ``source``, for observations that are not ``rows`` of the contract's width."""
    expected = (rows, contract.observation_width)
    if observation.shape != expected:
        raise PolicyError(f"'{source}' takes observations of shape {expected}, not {tuple(observation.shape)}")


def checked_action(action: torch.Tensor, rows: int, contract: PolicyContract | Interface, source: str) -> torch.Tensor:
    """Return an output as a fresh float32 tensor (rows, J), one row also without its axis; raise ``PolicyError`` for another shape."""
    expected = (rows, contract.num_joints or action.shape[-1] if action.dim() else 0)
    if rows == 1 and tuple(action.shape) == expected[1:]:
        action = action.unsqueeze(0)
    if tuple(action.shape) != expected:
        raise PolicyError(
            f"'{source}' gives an output of shape {tuple(action.shape)}; {expected}, one entry per joint, is needed"
        )
    return action.to(torch.float32, copy=True)
