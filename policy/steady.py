"""Sessions in which the action of an episode is the same to the last bit, whichever row it sits in.

A matrix product may sum in another order for another number of rows, or for another place among them. Legged motion is
chaotic: a last bit is another episode some seconds later. Whether a policy's products do so is found out by trial.
"""

from __future__ import annotations

import torch

from .base import Policy, PolicySession

_TRIALS = 4


def steady_session(policy: Policy, num_episodes: int) -> tuple[PolicySession, bool]:
    """A session on the CPU in which rows do not matter.

    Returns:
        The session, and whether it may also be asked for the actions of any multiple of eight rows.
    """
    if not _same(policy, num_episodes, num_episodes):
        return policy.rowwise_session(num_episodes), False
    fewer = all(_same(policy, num_episodes, count) for count in range(8, num_episodes, 8))
    return policy.session(num_episodes), fewer


def _same(policy: Policy, total: int, count: int) -> bool:
    """Whether ``count`` of ``total`` episodes, in any order, get the actions that they get among all."""
    generator = torch.Generator().manual_seed(0)
    observations = torch.randn(_TRIALS, total, policy.contract.observation_width, generator=generator)
    whole, part = policy.session(total), policy.session(total)
    order = torch.randperm(total, generator=generator)
    rows = None if count == total else torch.arange(count)
    for observation in observations:
        if not torch.equal(whole.act(observation)[order[:count]], part.act(observation[order], rows)[:count]):
            return False
    return True
