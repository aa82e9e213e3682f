"""MuJoCo's equations on the GPU, by mujoco_warp."""

from .backend import MujocoWarpBackend

__all__ = ["MujocoWarpBackend"]
