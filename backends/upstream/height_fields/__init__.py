"""Contacts with height fields, for every engine that steps mujoco_warp."""

from .repair import HEIGHT_FIELDS

__all__ = ["HEIGHT_FIELDS"]
