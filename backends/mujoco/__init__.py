"""MuJoCo on the CPU."""

from .backend import MujocoBackend

__all__ = ["MujocoBackend"]
