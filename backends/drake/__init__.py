"""Drake on the CPU (extra ``[drake]``)."""

from .backend import DrakeBackend

__all__ = ["DrakeBackend"]
