"""What a result holds of its suite: all of it, a part, or something that the suite does not have."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..policy.contract import PRIVILEGED_TERMS
from .pipelines import Environment, make_environments
from .suite import Suite

COMPLETE, PART, CUSTOM, UNKNOWN = "complete", "part", "custom", "unknown"

_AXES = {"terrains": "terrain", "frictions": "friction", "payloads": "payload", "seeds": "seed"}
"""Axes of a suite's matrix, and one entry of each in words."""


def coverage(
    suite: Suite, environments: Sequence[Environment], seeds: Sequence[int], *, pipeline: str = "stress"
) -> dict[str, Any]:
    """What of a suite was played.

    Args:
        pipeline: ``level`` plays no quality episodes, so its seeds do not matter.

    Returns:
        Plain data: ``kind`` (``complete``, ``part`` or ``custom``), ``text`` (what it is of the suite, in words),
        ``environments`` (how many of the suite's were played, and how many it has), ``levels`` (those that were given instead of
        searched for), and for each axis of the matrix ``played``, ``missing`` and ``foreign`` (played, and none of the suite's).
    """
    matrix = suite.matrix
    levels_alone = pipeline == "level"
    whole = make_environments(suite, terrains=matrix.terrains, frictions=None, payloads=None, level=None)
    wanted = {e.key for e in whole}
    played: dict[str, list[Any]] = {
        "terrains": _distinct(e.terrain for e in environments),
        "frictions": sorted(_distinct(e.friction for e in environments)),
        "payloads": sorted(_distinct(e.payload for e in environments)),
        "seeds": [] if levels_alone else sorted(_distinct(seeds)),
    }
    axes = {
        axis: {
            "played": values,
            "missing": [v for v in getattr(matrix, axis) if v not in values],
            "foreign": [v for v in values if v not in getattr(matrix, axis)],
        }
        for axis, values in played.items()
    }
    found = {e.key for e in environments}
    levels = sorted({e.level for e in environments if e.level})
    foreign = [_foreign(_AXES[axis], entry["foreign"]) for axis, entry in axes.items() if entry["foreign"]]
    if levels:
        foreign.append(f"level {_listed(levels)} given, not searched for")
    if not foreign and found - wanted:
        foreign.append("pairs of friction and payload that the suite does not have")
    parts = [
        f"{len(entry['played'])} of {len(getattr(matrix, axis))} {axis}"
        for axis, entry in axes.items()
        if entry["missing"] and not entry["foreign"] and not (axis == "seeds" and levels_alone)
    ]
    if not parts and wanted - found and not foreign:
        parts.append(f"{len(wanted & found)} of {len(wanted)} environments")
    if levels_alone:
        parts.append("levels alone")
    return {
        "kind": CUSTOM if foreign else PART if parts else COMPLETE,
        "text": ", ".join([*foreign, *parts]) or "complete",
        "environments": [len(wanted & found), len(wanted)],
        "levels": levels,
        **axes,
    }


def coverage_of(results: Mapping[str, Any]) -> Mapping[str, Any]:
    """The coverage that some results state; of kind ``unknown`` where they are older than it."""
    return results.get("coverage") or {"kind": UNKNOWN, "text": "results that do not say what of the suite they hold"}


def coverage_words(covered: Mapping[str, Any]) -> str:
    """A coverage in words: ``complete``, or ``part: 1 of 7 terrains``."""
    return COMPLETE if covered["kind"] == COMPLETE else f"{covered['kind']}: {covered['text']}"


def suite_label(results: Mapping[str, Any]) -> str:
    """The suite's name and version as results may use it: bare only where they hold all of it."""
    name = f"{results['suite']['name']} {results['suite']['version']}"
    return {
        COMPLETE: f"{name}, complete",
        PART: f"a part of {name}",
        CUSTOM: f"custom, after {name}",
        UNKNOWN: f"{name}, coverage unknown",
    }[coverage_of(results)["kind"]]


def score_label(results: Mapping[str, Any]) -> str:
    """What a score is to be called: bare only where it is the suite's, of a policy that a robot could carry."""
    covered = coverage_of(results)
    privileged = results.get("policy", {}).get("kind_of_observations") == "privileged"
    return ("privileged " if privileged else "") + {
        COMPLETE: "score",
        PART: f"score of a part ({covered['text']})",
        CUSTOM: f"score of a custom run ({covered['text']})",
        UNKNOWN: f"score ({covered['text']})",
    }[covered["kind"]]


def notes(results: Mapping[str, Any]) -> list[str]:
    """Sentences that a reader of the score must know: gains that are not the policy's or the robot's usual ones, privileged
    observations.
    """
    found = []
    policy = results.get("policy", {})
    if policy.get("kind_of_observations") == "privileged":
        terms = ", ".join(t for t in policy["observations"] if t in PRIVILEGED_TERMS)
        found.append(f"privileged observations: no sensor of a robot measures {terms}")
    gains = results.get("motors", {}).get("note")
    return found + ([gains] if gains else [])


def _distinct(values: Iterable[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


def _foreign(word: str, values: Sequence[Any]) -> str:
    unit = " kg" if word == "payload" else ""
    return f"{word} {_listed(values)}{unit}"


def _listed(values: Sequence[Any]) -> str:
    """A few values in words."""
    texts = [v if isinstance(v, str) else f"{v:.12g}" if isinstance(v, float) else str(v) for v in values[:4]]
    return ", ".join(texts) + (f" and {len(values) - 4} more" if len(values) > 4 else "")
