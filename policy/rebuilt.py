"""Policies of foreign files whose networks were rebuilt: as fast as the project's own."""

from __future__ import annotations

import functools
import logging

import torch

from .base import PolicyError, PolicySession
from .contract import PolicyContract
from .native import FilePolicy, ForeignFile
from .program import NotUnderstoodError, Program, ProgramSession

TOLERANCE = 1e-5
"""Largest difference of an action to the file's own, absolute or relative."""
_EPISODES, _STEPS = 3, 8


class RebuiltPolicy(FilePolicy):
    """A policy that is played without the file's own code."""

    batched = True

    def __init__(self, contract: PolicyContract, stored: ForeignFile, program: Program, *, path: str) -> None:
        """Keep what was rebuilt.

        Raises:
            NotUnderstoodError: it cannot be played for several robots.
        """
        self.contract, self.stored, self.path = contract, stored, path
        self._program = program
        self.session(_EPISODES)

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
        if _acts_alike(policy, made):
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


def _acts_alike(policy: FilePolicy, made: FilePolicy) -> bool:
    """Whether episodes together go as they go alone with the file's own code."""
    alone, together = [policy.session(1) for _ in range(_EPISODES)], made.session(_EPISODES)
    generator = torch.Generator().manual_seed(0)
    for step in range(_STEPS):
        if step == _STEPS // 2:
            alone[1].reset()
            together.reset(torch.arange(_EPISODES) == 1)
        observations = torch.randn(_EPISODES, policy.contract.observation_width, generator=generator)
        expected = torch.cat([one.act(row) for one, row in zip(alone, observations.split(1), strict=True)])
        try:
            actual = together.act(observations)
        except PolicyError:
            return False
        if not torch.allclose(actual, expected, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True):
            return False
    return True
