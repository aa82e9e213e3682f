"""Which of mujoco_warp's alarms say that contacts or constraints were dropped, for all engines that step with it."""

from __future__ import annotations

import mujoco_warp

_ALARMS = mujoco_warp.OverflowType
DROPPED = int(_ALARMS.ALL & ~(_ALARMS.ITERATIONS | _ALARMS.LS_ITERATIONS))
"""All but those of a solver that stopped at its iteration limit. A pair of convex shapes whose search ran out of room
(``EPA_HORIZON``) is left without a contact."""
