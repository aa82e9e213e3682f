"""Differences between a log and its replay: by joint and group of joints, in time, over frequency, with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...robots.sets import joint_groups
from .log import Array, Log
from .rig import Motion

QUANTITIES = {"position": "rad", "velocity": "rad/s", "torque": "N·m"}
BANDS = ((0.0, 1.0), (1.0, 2.0), (2.0, 5.0), (5.0, 10.0), (10.0, 25.0))
"""Bands of frequency [Hz]."""
BLOCK = 0.5
"""Length of a block of the bootstrap [s]: errors of neighbouring rows are alike, those of neighbouring blocks hardly."""
SETTLING = 0.1
"""Time at the start that is not counted [s], while the unknown velocity at the first row dies away."""
_DRAWS = 1000
_NOISE_ROWS = 7


def differences(log: Log, motion: Motion) -> dict[str, Array]:
    """Return simulated minus recorded series by quantity, (T, J), NaN in rows that do not count."""
    counted = log.fresh & (log.time >= SETTLING)
    found = {}
    for name in QUANTITIES:
        recorded = getattr(log, name)
        if recorded is not None:
            found[name] = np.where(counted[:, None], getattr(motion, name) - recorded, np.nan)
    return found


def blocks_of(log: Log) -> NDArray[np.int64]:
    """Return the number of each row's block, (T,)."""
    return (log.time / BLOCK).astype(np.int64)


def resampled(log: Log, seed: int = 0) -> NDArray[np.int64]:
    """Return how often each block occurs in each draw of the bootstrap, (draws, blocks)."""
    count = int(blocks_of(log).max()) + 1
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), size=_DRAWS)


class Squares:
    """Sums of squared differences in each block of a log, from which RMS values and their intervals follow."""

    def __init__(self, log: Log, error: Array) -> None:
        """Sum the squares of ``error``, (T, J)."""
        number = blocks_of(log)
        self._sums = np.zeros((number.max() + 1, error.shape[1]))
        self._counts = np.zeros(number.max() + 1)
        known = np.isfinite(error).all(axis=1)
        np.add.at(self._sums, number[known], error[known] ** 2)
        np.add.at(self._counts, number[known], 1.0)

    def rms(self, joints: Any, draws: NDArray[np.int64] | None = None) -> Any:
        """Return the RMS over some joints, of the log itself or of each draw, (draws,)."""
        weights = np.ones((1, len(self._counts))) if draws is None else draws
        mean = (weights @ self._sums[:, joints]).sum(axis=1) / (weights @ self._counts * len(joints)).clip(1e-300)
        found = np.sqrt(mean)
        return float(found[0]) if draws is None else found


def interval(values: Array) -> list[float]:
    """Return the 95 % interval of draws."""
    low, high = np.percentile(values, [2.5, 97.5])
    return [float(low), float(high)]


def spectrum(log: Log, error: Array) -> tuple[Array, Array]:
    """Return frequencies [Hz], (F,), and the power spectral density of differences, (F, J)."""
    from scipy.signal import welch

    known = np.isfinite(error).all(axis=1)
    grid = np.arange(log.time[known][0], log.time[-1], log.period)
    even = np.stack([np.interp(grid, log.time[known], error[known, j]) for j in range(error.shape[1])], axis=1)
    length = min(len(even), round(4.0 / log.period))
    frequency, power = welch(even, fs=1.0 / log.period, nperseg=length, axis=0, detrend=False)
    return frequency, power


def by_band(frequency: Array, power: Array, joints: Any) -> list[float]:
    """Return the RMS in each of ``BANDS`` over some joints."""
    width = frequency[1] - frequency[0]
    mean = power[:, joints].mean(axis=1) * width
    edge = BANDS[-1][1]
    return [float(np.sqrt(mean[(frequency >= low) & (frequency < min(high, edge))].sum())) for low, high in BANDS]


def noise(log: Log, joints: Any) -> dict[str, float]:
    """Return the RMS of what is faster than any joint in each recorded quantity: the floor of a log without repetition."""
    from scipy.signal import savgol_filter

    found = {}
    rows = log.fresh
    for name in QUANTITIES:
        series = getattr(log, name)
        if series is not None and rows.sum() > _NOISE_ROWS:
            own = series[rows][:, joints]
            smooth = savgol_filter(own, _NOISE_ROWS, 2, axis=0)
            kept = 1.0 - savgol_coefficient()
            found[name] = float(np.sqrt(((own - smooth) ** 2).mean() / kept))
    return found


def savgol_coefficient() -> float:
    """Return the share of white noise that the smoothing of ``noise`` keeps in each value."""
    from scipy.signal import savgol_coeffs

    return float(savgol_coeffs(_NOISE_ROWS, 2)[_NOISE_ROWS // 2])


def repeatability(log: Log, other: Log, joints: Any) -> dict[str, float] | None:
    """Return the RMS by which two recordings of the same targets differ, over √2; None where their targets or gains differ."""
    alike = np.allclose(log.stiffness, other.stiffness) and np.allclose(log.damping, other.damping)
    if not alike or abs(log.time[-1] - other.time[-1]) > BLOCK:
        return None

    def there(series: Array) -> Array:
        return np.stack([np.interp(log.time, other.time, series[:, j]) for j in joints], axis=1)

    if np.sqrt(((there(other.target) - log.target[:, joints]) ** 2).mean()) > 0.01:
        return None
    found = {}
    for name in QUANTITIES:
        mine, theirs = getattr(log, name), getattr(other, name)
        if mine is not None and theirs is not None:
            error = (there(theirs) - mine[:, joints])[log.fresh]
            found[name] = float(np.sqrt((error**2).mean() / 2.0))
    return found


def lead(log: Log, motion: Motion, joints: Any) -> float:
    """Return the time by which the simulated positions lead the recorded ones [s], to first order."""
    rows = log.fresh & (log.time >= SETTLING)
    error, speed = (motion.position - log.position)[rows][:, joints], motion.velocity[rows][:, joints]
    return float((error * speed).mean() / max((speed**2).mean(), 1e-12))


def summarize(
    log: Log, motion: Motion, reference: Mapping[str, Squares] | None
) -> tuple[dict[str, Any], dict[str, Squares]]:
    """Return the figures of a replay, by group and joint, and the squares for comparing others with it.

    Args:
        reference: of the first replay; each figure then has a ``ratio`` to it with its paired interval.
    """
    groups, draws = joint_groups(log.robot), resampled(log)
    errors = differences(log, motion)
    squares = {name: Squares(log, error) for name, error in errors.items()}
    spectra = {name: spectrum(log, error) for name, error in errors.items()}

    def figures(joints: list[int]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, sums in squares.items():
            drawn = sums.rms(joints, draws)
            entry = {"rms": sums.rms(joints), "interval": interval(drawn), "bands": by_band(*spectra[name], joints)}
            if reference is not None:
                base, base_drawn = reference[name].rms(joints), reference[name].rms(joints, draws)
                entry["ratio"] = {
                    "value": entry["rms"] / max(base, 1e-12),
                    "interval": interval(drawn / base_drawn.clip(1e-12)),
                }
            found[name] = entry
        found["lead"] = lead(log, motion, joints)
        return found

    names = log.robot.joint_names
    return {
        "groups": {group: figures(joints) for group, joints in groups.items()},
        "joints": {names[j]: figures([j]) for j in range(len(names))},
    }, squares
