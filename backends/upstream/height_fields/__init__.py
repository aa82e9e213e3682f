"""Contacts with height fields, for every engine that steps mujoco_warp."""

from .repair import repair_height_fields

__all__ = ["repair_height_fields"]
