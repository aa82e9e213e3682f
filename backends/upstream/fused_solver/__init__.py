"""Newton's method of mujoco_warp in one kernel, for every engine that steps it."""

from .solve import fuse_solver

__all__ = ["fuse_solver"]
