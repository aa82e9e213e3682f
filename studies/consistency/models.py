"""The models compared field by field, as the engines hold them after import and randomization."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...backends.base import DESCRIPTION_KEYS
from ...robots import Robot

Description = Mapping[str, Sequence[float]]

TOLERANCE = 1e-5
"""Relative difference up to which single precision explains it; 84 roundings of float32."""


def entry_names(key: str, robot: Robot) -> list[str]:
    """What each entry of a description's field belongs to."""
    if key.startswith("body_"):
        bodies = list(robot.collision_bodies)
        return bodies if key == "body_mass" else [f"{b} {axis}" for b in bodies for axis in ("I1", "I2", "I3")]
    if key == "joint_range":
        return [f"{j} {end}" for j in robot.joint_names for end in ("low", "high")]
    if key.startswith("contact_") and key != "contact_cone":
        return list(robot.foot_names)
    return [robot.name] if key in ("total_mass", "contact_cone") else list(robot.joint_names)


def compare_models(robot: Robot, descriptions: Mapping[str, Description | None], reference: str) -> dict[str, Any]:
    """Compare what the engines say of themselves with what the reference says.

    Args:
        robot: names the entries.
        descriptions: by variant label; None for an engine that does not describe itself.

    Returns:
        Plain data: ``fields`` by name with ``reference`` (mean of the entries' magnitudes, None for no limit) and, by variant,
        ``largest`` absolute and ``relative`` difference, the ``entry`` where it is, the two ``values`` there (None for no
        limit) and whether it ``agrees`` to single precision; ``not_described`` names the silent engines.
    """
    silent = [label for label, found in descriptions.items() if found is None]
    others = {label: found for label, found in descriptions.items() if found is not None and label != reference}
    fields: dict[str, Any] = {}
    base = descriptions.get(reference) or {}
    for key in (k for k in DESCRIPTION_KEYS if k in base):
        expected = np.asarray(base[key], dtype=np.float64)
        rows = {label: _difference(key, found.get(key), expected, robot) for label, found in others.items()}
        fields[key] = {"reference": finite(np.abs(expected).mean()), "variants": rows}
    return {"reference": reference, "fields": fields, "not_described": silent}


def _difference(key: str, values: Sequence[float] | None, expected: np.ndarray, robot: Robot) -> dict[str, Any] | None:
    """Largest difference of a field; None where the engine does not say it."""
    if values is None:
        return None
    found = np.asarray(values, dtype=np.float64)
    if found.shape != expected.shape:
        entry = f"{len(found)} entries instead of {len(expected)}"
        return {"values": None, "largest": None, "relative": None, "entry": entry, "agrees": False}
    with np.errstate(invalid="ignore"):  # a limit that only one of them has is an infinite difference
        absolute = np.where(found == expected, 0.0, np.abs(found - expected))
        scale = np.maximum(np.maximum(np.abs(found), np.abs(expected)), 1e-12)
        relative = np.where(absolute == 0.0, 0.0, np.where(np.isinf(absolute), np.inf, absolute / scale))
    worst = int(np.argmax(relative))
    names = entry_names(key, robot)
    return {
        "values": [finite(expected[worst]), finite(found[worst])],
        "largest": finite(absolute.max()),
        "relative": finite(relative[worst]),
        "entry": names[worst] if worst < len(names) else str(worst),
        "agrees": bool((relative <= TOLERANCE).all()),
    }


def finite(value: float) -> float | None:
    """A number for JSON, which knows neither infinity nor NaN."""
    return float(value) if np.isfinite(value) else None
