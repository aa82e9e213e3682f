"""Dry friction of joints as an explicit torque, for engines that have none of their own."""

from __future__ import annotations

import mujoco
import numpy as np


def dry_friction_slope(reference: mujoco.MjModel, dofs: np.ndarray, timestep: float) -> np.ndarray:
    """Return the steepest slope of an explicit dry-friction torque around zero speed without overshoot [N·m·s/rad], (J,).

    A slope of half the joint's own inertia per step keeps even three coupled joints of a leg stable.

    Args:
        dofs: degree of freedom of each joint, (J,).
        timestep: length of a physics step [s].
    """
    data = mujoco.MjData(reference)
    mujoco.mj_forward(reference, data)
    inertia = np.zeros((reference.nv, reference.nv))
    mujoco.mj_fullM(reference, data, inertia)
    own = 1.0 / np.diag(np.linalg.inv(inertia))
    return 0.5 * own[dofs] / timestep
