"""The coverage of a suite by a result: all of it, a part, or something that the suite does not have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..policy.contract import PRIVILEGED_TERMS
from .pipelines import Environment, make_environments
from .result import COMPLETE, CUSTOM, PART, UNKNOWN, AxisCoverage, Coverage, Result
from .suite import Suite
from .suited import beyond_in_words, changes

_AXES = {"terrains": "terrain", "frictions": "friction", "payloads": "payload", "seeds": "seed"}
"""Axes of a suite's matrix, and one entry of each in words."""

UNPROVED = "unproved: results of schema 2 lack what mean, mean@25, falls and self-contact follow from; evaluate the policy again"


def coverage(
    suite: Suite, environments: Sequence[Environment], seeds: Sequence[int], *, pipeline: str = "stress"
) -> Coverage:
    """Return the part of a suite that was played; ``pipeline``: ``level`` plays no quality episodes, so its seeds do not matter."""
    matrix = suite.matrix
    levels_alone = pipeline == "level"
    whole = make_environments(suite, terrains=matrix.terrains, frictions=None, payloads=None, level=None)
    wanted = {e.key for e in whole}
    played: dict[str, list[Any]] = {
        "terrains": list(dict.fromkeys(e.terrain for e in environments)),
        "frictions": sorted({e.friction for e in environments}),
        "payloads": sorted({e.payload for e in environments}),
        "seeds": [] if levels_alone else sorted(set(seeds)),
    }
    axes: dict[str, Any] = {
        axis: AxisCoverage(
            played=tuple(values),
            missing=tuple(v for v in getattr(matrix, axis) if v not in values),
            foreign=tuple(v for v in values if v not in getattr(matrix, axis)),
        )
        for axis, values in played.items()
    }
    found = {e.key for e in environments}
    levels = sorted({e.level for e in environments if e.level})
    units = {"payloads": " kg"}
    foreign = [
        f"{'further ' * (len(e.foreign) < len(e.played))}{_AXES[at]} {_listed(e.foreign)}{units.get(at, '')}"
        for at, e in axes.items()
        if e.foreign
    ]
    if levels:
        foreign.append(f"level {_listed(levels)} given, not searched for")
    foreign += changes(suite)
    if not foreign and found - wanted:
        foreign.append("pairs of friction and payload that the suite does not have")
    parts = [
        f"{len(entry.played)} of {len(getattr(matrix, axis))} {axis}"
        for axis, entry in axes.items()
        if entry.missing and not entry.foreign and not (axis == "seeds" and levels_alone)
    ]
    if not parts and wanted - found and not foreign:
        parts.append(f"{len(wanted & found)} of {len(wanted)} environments")
    if levels_alone:
        parts.append("levels alone")
    return Coverage(
        kind=CUSTOM if foreign else PART if parts else COMPLETE,
        text=", ".join([*foreign, *parts]) or "complete",
        environments=(len(wanted & found), len(wanted)),
        levels=tuple(levels),
        **axes,
    )


def suite_label(result: Result) -> str:
    """Return the suite's name and version as a result may use it: bare only where it holds all of the suite."""
    return {
        COMPLETE: f"{result.suite}, complete",
        PART: f"a part of {result.suite}",
        CUSTOM: f"custom, after {result.suite}",
        UNKNOWN: f"{result.suite}, coverage unknown",
    }[result.coverage.kind]


def score_label(result: Result) -> str:
    """Return the name of a score: bare only where it is the suite's, of a policy that a robot with encoders and gyroscope could carry."""
    covered = result.coverage
    kind = result.policy.kind_of_observations
    return (f"{kind} " if kind in ("privileged", "exteroceptive") else "") + {
        COMPLETE: "score",
        PART: f"score of a part ({covered.text})",
        CUSTOM: f"score of a custom run ({covered.text})",
        UNKNOWN: f"score ({covered.text})",
    }[covered.kind]


def notes(result: Result) -> list[str]:
    """Return sentences that a reader of the score must know: on figures without proof, privileged observations and unusual gains."""
    found = [] if result.proved else [UNPROVED]
    if result.policy.kind_of_observations == "privileged":
        terms = ", ".join(t for t in result.policy.observations or () if t in PRIVILEGED_TERMS)
        found.append(f"privileged observations: no sensor of a robot measures {terms}")
    if result.policy.kind_of_observations == "exteroceptive":
        found.append("exteroceptive observations: a robot needs a map of the ground for them; a simulated one was seen")
    found += [s] if (s := beyond_in_words(result.commands.limits, result.commands.beyond)) else []
    return found + ([result.motors.note] if result.motors.note else [])


def _listed(values: Sequence[Any]) -> str:
    """Return a few values in words."""
    texts = [v if isinstance(v, str) else f"{v:.12g}" if isinstance(v, float) else str(v) for v in values[:4]]
    return ", ".join(texts) + (f" and {len(values) - 4} more" if len(values) > 4 else "")
