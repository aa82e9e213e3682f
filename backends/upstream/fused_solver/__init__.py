"""Newton's method of mujoco_warp in one kernel, for every engine that steps it."""

from .solve import FUSED_SOLVER

__all__ = ["FUSED_SOLVER"]
