"""Policies of foreign files whose networks were rebuilt: as fast as the project's own."""

from __future__ import annotations

import functools
import logging

import torch

from ..base import PROBE_EPISODES, PolicySession, RowwiseSession, act_alike
from ..contract import PolicyContract
from ..native import FilePolicy, ForeignFile
from .batched_program import NotUnderstoodError, Program, ProgramSession


class RebuiltPolicy(FilePolicy):
    """A policy that is played without the file's own code."""

    def __init__(self, contract: PolicyContract, stored: ForeignFile, program: Program, *, path: str) -> None:
        """Keep what was rebuilt.

        Raises:
            NotUnderstoodError: it cannot be played for several robots.
        """
        self.contract, self.stored, self.path = contract, stored, path
        self._program = program
        self.session(PROBE_EPISODES)

    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        """Start work on ``num_episodes`` episodes."""
        return ProgramSession(self._program, num_episodes, self.contract, torch.device(device))


def rebuilt(policy: FilePolicy) -> FilePolicy:
    """The policy with its network rebuilt, if its file is understood and both act the same, else the policy itself.

    Both play some episodes of random observations from a reset, one of them reset again on the way. That a network acts
    the same on others is known from its code, which was followed from end to end.
    """
    file = policy.stored
    if not isinstance(file, ForeignFile):
        return policy
    try:
        made = RebuiltPolicy(policy.contract, file, _program(policy, file), path=policy.path)
        alone = RowwiseSession(policy.session, PROBE_EPISODES)
        if act_alike(alone, made.session(PROBE_EPISODES), policy.contract.observation_width):
            return made
        policy.not_rebuilt = "what was rebuilt of it acts differently"
    except NotUnderstoodError as reason:
        policy.not_rebuilt = str(reason)
    _say(policy.path, policy.not_rebuilt)
    return policy


@functools.cache  # once, and not again in each process that is forked from this one
def _say(path: str, reason: str) -> None:
    logging.getLogger(__name__).warning(
        "'%s' is run with its own code, which is slower than a network of which the weights are known: %s", path, reason
    )


def _program(policy: FilePolicy, file: ForeignFile) -> Program:
    width = policy.contract.observation_width
    # Only those who load such a file wait for what it needs.
    if file.kind == "torchscript":
        from .torchscript_program import torchscript_program

        return torchscript_program(file.data, width, source=policy.path)
    from .onnx_program import onnx_program

    return onnx_program(file.data, width, source=policy.path)
