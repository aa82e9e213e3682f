"""How well classes separate in a space: principal components, silhouette, a linear probe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_BLOCK = 512
_RIDGE = 1.0
"""Weight of the probe's coefficients, on standardized values: as much as one sample's."""


@dataclass(frozen=True, kw_only=True)
class Separation:
    """How well classes can be told apart."""

    silhouette: float
    """Mean over samples of (b − a) / max(a, b): a is the mean distance to its own class, b to the nearest other one
    (Rousseeuw 1987). From −1 to 1; near 0 classes overlap."""
    probe: float
    """Share of held-out samples that a linear probe puts into their class: recall, the mean over classes."""
    probe_range: tuple[float, float]
    """The least and the largest share among the robots that were held out."""
    recall: tuple[float, ...]
    """The share of each class."""
    chance: float
    """Accuracy of guessing."""


def principal_components(points: Array, count: int = 2) -> tuple[Array, Array]:
    """Points on the axes along which they vary most.

    Args:
        points: (N, D).

    Returns:
        (N, count), each axis with the sign that makes its largest coefficient positive, and each axis's share of the
        variance, (count,). Of less than ``count`` dimensions the further axes are zero.
    """
    centred = points - points.mean(axis=0)
    centred = np.pad(centred, ((0, 0), (0, max(count - points.shape[1], 0))))
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    axes = axes[:count]
    axes = axes * np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])[:, None]
    variance = sizes**2
    return centred @ axes.T, variance[:count] / max(float(variance.sum()), 1e-300)


def separation(points: Array, classes: Labels, robots: Labels) -> Separation:
    """How well classes can be told apart.

    The probe is tried on robots that it was not fitted to: samples of one robot follow each other and are alike, so that a
    probe that had seen some of them would know the others by heart.

    Args:
        points: (N, D).
        classes: class of each, (N,), from 0 on, each with at least one sample.
        robots: which robot each is of, (N,).
    """
    count = int(classes.max()) + 1
    hits = np.zeros(len(points), dtype=bool)
    shares = []
    for robot in np.unique(robots):
        held = robots == robot
        hits[held] = _probe(points[~held], classes[~held], points[held], count) == classes[held]
        shares.append(float(hits[held].mean()))
    recall = [float(hits[classes == c].mean()) for c in range(count)]
    return Separation(
        silhouette=silhouette(points, classes),
        probe=float(np.mean(recall)),
        probe_range=(min(shares), max(shares)),
        recall=tuple(recall),
        chance=1.0 / count,
    )


def silhouette(points: Array, classes: Labels) -> float:
    """Mean silhouette, see ``Separation``; a class of one sample counts 0."""
    count = int(classes.max()) + 1
    sizes = np.bincount(classes, minlength=count).astype(float)
    member = np.eye(count)[classes]
    total = 0.0
    for begin in range(0, len(points), _BLOCK):
        own = classes[begin : begin + _BLOCK]
        sums = cdist(points[begin : begin + _BLOCK], points) @ member
        rows = np.arange(len(own))
        within = sums[rows, own] / np.maximum(sizes[own] - 1.0, 1.0)
        others = sums / sizes
        others[rows, own] = np.inf
        nearest = others.min(axis=1)
        total += float(
            np.where(sizes[own] > 1.0, (nearest - within) / np.maximum(np.maximum(nearest, within), 1e-300), 0.0).sum()
        )
    return total / len(points)


def _probe(seen: Array, classes: Labels, asked: Array, count: int) -> Labels:
    """Classes that ridge regression on indicators gives: the largest of ``count`` linear functions."""
    mean, deviation = seen.mean(axis=0), seen.std(axis=0)
    scale = np.where(deviation > 1e-9, deviation, 1.0)
    design = np.column_stack(((seen - mean) / scale, np.ones(len(seen))))
    weight = _RIDGE * np.eye(design.shape[1])
    weight[-1, -1] = 0.0
    # each class counts the same, however many samples a fall has cost it
    balance = (1.0 / np.maximum(np.bincount(classes, minlength=count), 1))[classes]
    balance *= len(seen) / balance.sum()
    weighted = design * balance[:, None]
    coefficients = np.linalg.solve(weighted.T @ design + weight, weighted.T @ np.eye(count)[classes])
    found: Labels = (np.column_stack(((asked - mean) / scale, np.ones(len(asked)))) @ coefficients).argmax(axis=1)
    return found
