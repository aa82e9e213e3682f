"""Newton with its MuJoCo solver, and its other solvers."""

from .backend import NewtonBackend

__all__ = ["NewtonBackend"]
