"""Alarms of mujoco_warp about dropped contacts or constraints, for all engines that step with it."""

from __future__ import annotations

import mujoco_warp

_ALARMS = mujoco_warp.OverflowType
DROPPED = int(_ALARMS.ALL & ~(_ALARMS.ITERATIONS | _ALARMS.LS_ITERATIONS))
"""All alarms except those of a solver at its iteration limit. ``EPA_HORIZON`` leaves a pair of convex shapes without a contact."""
