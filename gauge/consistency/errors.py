"""What can be wrong with a request for a consistency study."""

from __future__ import annotations


class ConsistencyError(ValueError):
    """The study cannot be made; the message says why and what to change."""
