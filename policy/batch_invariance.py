"""Sessions in which the action of an episode is the same to the last bit, whichever others are played beside it.

A matrix product may sum in another order for another number of rows, or for another place among them. Legged motion is
chaotic: a last bit is another episode some seconds later. So that the number of episodes does not matter, every network is
played in blocks of ``ROWS`` rows, filled up with zeros. Whether places matter, or fewer rows give the same, is found out by
trial; a policy for which they matter goes through its network row by row, which is slow.
"""

from __future__ import annotations

import logging

import torch

from .base import Policy, PolicySession

ROWS = 24
"""Rows of a block on the CPU: as many as a process has worlds."""
_TRIALS = 4


class BlockSession(PolicySession):
    """Episodes in blocks of ``ROWS`` rows, the last one filled up."""

    def __init__(self, policy: Policy, num_episodes: int, *, fewer: bool) -> None:
        """Begin the blocks; with ``fewer``, multiples of eight rows act as a whole block does."""
        self._num_episodes = num_episodes
        self._blocks = [policy.session(ROWS) for _ in range(-(-num_episodes // ROWS))]
        self._padding = len(self._blocks) * ROWS - num_episodes
        # of a single block that is not full, the rows that are worth the work
        needed = -(-num_episodes // 8) * 8
        self._needed = torch.arange(needed) if fewer and needed < ROWS else None

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession.reset``."""
        masks = [None] * len(self._blocks) if episodes is None else self._filled(episodes).split(ROWS)
        for block, mask in zip(self._blocks, masks, strict=True):
            block.reset(mask)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession.act``."""
        parts = self._filled(observation).split(ROWS)
        chosen = (self._needed if rows is None else rows) if len(parts) == 1 else None
        actions = [block.act(part, chosen) for block, part in zip(self._blocks, parts, strict=True)]
        return torch.cat(actions)[: self._num_episodes]

    def _filled(self, values: torch.Tensor) -> torch.Tensor:
        return torch.cat((values, values.new_zeros(self._padding, *values.shape[1:])))


def steady_session(policy: Policy, num_episodes: int) -> tuple[PolicySession, bool]:
    """Return a session on the CPU in which rows do not matter.

    Returns:
        The session, and whether it may also be asked for the actions of any multiple of eight rows.
    """
    if not _same(policy, ROWS):
        if not getattr(policy, "row_by_row", False):  # else the warning came when the policy was loaded
            logging.getLogger(__name__).warning("'%s' goes through its network row by row, which is slow", policy.path)
        return policy.rowwise_session(num_episodes), False
    fewer = all(_same(policy, count) for count in range(8, ROWS, 8))
    if num_episodes == ROWS:
        return policy.session(ROWS), fewer
    return BlockSession(policy, num_episodes, fewer=fewer), fewer and num_episodes < ROWS


def _same(policy: Policy, count: int) -> bool:
    """Return whether a smaller batch, in any order and beside any rows, gives bit-identical actions."""
    generator = torch.Generator().manual_seed(0)
    observations = torch.randn(_TRIALS, ROWS, policy.contract.observation_width, generator=generator)
    others = torch.randn(_TRIALS, ROWS, policy.contract.observation_width, generator=generator)
    whole, part = policy.session(ROWS), policy.session(ROWS)
    order = torch.randperm(ROWS, generator=generator)
    kept = torch.arange(ROWS) % 4 != 3  # the others' rows see something else
    rows = None if count == ROWS else torch.arange(count)
    chosen = kept[:count].nonzero().flatten()
    for observation, other in zip(observations, others, strict=True):
        expected = whole.act(observation)[order[:count]]
        actual = part.act(torch.where(kept[:, None], observation[order], other), rows)[:count]
        if not torch.equal(expected[chosen], actual[chosen]):
            return False
    return True
