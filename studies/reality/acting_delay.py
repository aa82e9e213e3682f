"""The delay from a target's row until motors act on it, without a guess of rotor inertia, friction or gains.

Each joint's torque, recorded or from inverse dynamics of the recorded positions, is a sum of constants times target minus position,
velocity, its sign, acceleration and one. The delay at which targets explain it best is the motors'.
"""

from __future__ import annotations

import numpy as np

from .log import Array, Log, free_legs_torque
from .rig import held_targets

LONGEST = 0.04
"""Longest delay that is tried [s]."""
_STEP = 0.001
_WINDOW = 0.05
"""Length of the windows in which all series are smoothed alike [s]."""
_SLOW = 0.1
"""Velocity [rad/s] from which dry friction has its whole size."""
_MOVES = 0.02
_FAST = 0.005
"""Longest period of rows with torques that say when they acted [s]."""
_EXPLAINED = {"torque": 0.95, "position": 0.975}
"""Least share of the torque's variance that must be explained: a motion below 2 Hz leaves the delay open, and less explains it."""


def acting_delay(log: Log) -> float | None:
    """Return the delay until targets act [s], to about 2 ms; None where the log does not tell it: too slow a motion, or a robot that
    does not hang and whose torques are not known.
    """
    from scipy.signal import savgol_filter

    known = log.torque is not None and log.period <= _FAST
    if not known and log.held != "hung":
        return None
    rows, step = log.fresh, log.period
    steps = int(log.time[-1] / step)
    grid = np.arange(steps + 1) * step
    window = max(2 * round(_WINDOW / step / 2) + 1, 5)

    def smooth(series: Array, order: int = 0) -> Array:
        even = np.stack([np.interp(grid, log.time[rows], column[rows]) for column in series.T], axis=1)
        found: Array = savgol_filter(even, window, 3, deriv=order, delta=step, axis=0)
        return found

    position, velocity, acceleration = (smooth(log.position, order) for order in range(3))
    torque = smooth(log.torque) if known and log.torque is not None else None
    whole = torque if torque is not None else free_legs_torque(log.robot, position, velocity, acceleration)
    used = slice(max(window, round(0.1 / step)), len(grid) - window)
    moving = np.flatnonzero(log.target.std(axis=0) > _MOVES)
    if not len(moving) or used.stop - used.start < 50:
        return None
    delays = np.arange(0.0, LONGEST + _STEP / 2, _STEP)
    left = np.empty((len(delays), len(moving)))
    for d, delay in enumerate(delays):
        held = held_targets(log, float(delay), steps + 1, step)
        target = savgol_filter(np.vstack([held[:1], (held[:-1] + held[1:]) / 2]), window, 3, axis=0)
        for i, j in enumerate(moving):
            v = velocity[:, j]
            columns = [target[: len(v), j] - position[:, j], v, np.tanh(v / _SLOW), np.ones(len(v))]
            columns += [] if torque is not None else [acceleration[:, j]]
            matrix, own = np.stack(columns, axis=1)[used], whole[used, j]
            error = matrix @ np.linalg.lstsq(matrix, own, rcond=None)[0] - own
            left[d, i] = np.log((error**2).mean() / max(float(own.var()), 1e-12))
    cost = left.mean(axis=1)
    best = int(cost.argmin())
    explained = 1.0 - np.exp(cost[best])
    return float(delays[best]) if explained >= _EXPLAINED["position" if torque is None else "torque"] else None
