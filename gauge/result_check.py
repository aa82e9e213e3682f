"""What readers of a ``results.json`` take for granted, checked where somebody else may have written or edited it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field

from ..files.parsing import Name, Seed, Text, one_line, shown, take
from .chance.intervals import ChanceRules
from .result_figures import check_figures
from .suite import Friction, Payload

MOST_ROWS = 10_000
"""Environments of one result."""
MOST_REPLICATES = 20_000_000
"""Environments times replicates of the level searches, which are done again when results are compared."""
_Words = Annotated[str, Field(max_length=4096)]
_Score = Annotated[float, Field(ge=0.0, le=1001.0)]
"""A level weighs at most 1, and there are at most 1000."""
_Level = Annotated[float, Field(ge=0, le=1000)]
_Value = Annotated[float, Field(ge=-1e9, le=1e9)]
"""Of a metric, weighted by the level or not."""
_Table = Mapping[Text, Mapping[Text, _Value | tuple[_Value, _Value] | None]]


@dataclass(frozen=True, kw_only=True)
class _Result:
    score: _Score | None
    score_interval: tuple[_Value, _Value] | None = None
    level: _Level | None = None
    backend: Text
    robot: Name
    pipeline: Text
    groups: Mapping[Text, _Value] = field(default_factory=dict)
    terrains: _Table = field(default_factory=dict)
    metrics: _Table = field(default_factory=dict)
    health: Mapping[Text, _Value | None] | None = None
    solver: Mapping[Text, _Value | Text | bool | None] | None = None


@dataclass(frozen=True, kw_only=True)
class _Chance:
    note: _Words | None = None


@dataclass(frozen=True, kw_only=True)
class _Suite:
    name: Name
    version: Name
    digest: Text
    title: _Words = ""


@dataclass(frozen=True, kw_only=True)
class _Policy:
    path: _Words
    file_sha256: Text
    observations: Annotated[tuple[Text, ...], Field(max_length=1000)] | None = None
    kind_of_observations: Literal["measurable", "privileged"] | None = None


@dataclass(frozen=True, kw_only=True)
class _Coverage:
    kind: Literal["complete", "part", "custom", "unknown"]
    text: _Words


@dataclass(frozen=True, kw_only=True)
class _Row:
    terrain: Text
    friction: Friction
    payload: Payload
    level: _Level | None = None
    score: _Score | None = None
    quality: Mapping[Text, _Value] | None = None
    metrics: Mapping[Text, Mapping[Text, _Value]] = field(default_factory=dict)
    search: Mapping[Seed, bool] | None = None
    trials: Mapping[Seed, Mapping[Seed, bool]] = field(default_factory=dict)
    runs: Mapping[Seed, Mapping[Text, _Value | Mapping[Text, _Value]]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class _Provenance:
    versions: Mapping[str, Text] = field(default_factory=dict)
    digests: Mapping[str, Text] = field(default_factory=dict)


_TABLES: Mapping[str, type] = {
    "suite": _Suite,
    "policy": _Policy,
    "provenance": _Provenance,
    "chance": _Chance,
    "coverage": _Coverage,
}


def robot_digest_of(data: Mapping[str, Any]) -> str | None:
    """SHA-256 of the files of the robot that was judged; None in results from before, which do not say."""
    found: str | None = data.get("provenance", {}).get("digests", {}).get("robot")
    return found


def versions_of(data: Mapping[str, Any]) -> dict[str, str]:
    """Versions of gaitgauge and of the engine, and the digest of gaitgauge's source, as far as results state them."""
    provenance = data.get("provenance", {})
    names, versions = ("gaitgauge", str(data.get("backend")).partition(":")[0]), provenance.get("versions", {})
    found = {name: versions[name] for name in names if name in versions}
    source = provenance.get("digests", {}).get("source")
    return found | ({} if source is None else {"source of gaitgauge": source[:12]})


def unlike(tables: Sequence[Mapping[str, object]]) -> list[str]:
    """In what some tables differ, in words, in their order: ``mujoco 3.16.0 and 3.17.0``. What one does not say is no difference."""
    words = {}
    for name in dict.fromkeys(name for table in tables for name in table):
        values = list(dict.fromkeys(str(table[name]) for table in tables if table.get(name) is not None))
        if len(values) > 1:
            words[name] = f"{one_line(name)} {one_line(', '.join(values[:-1]))} and {one_line(values[-1])}"
    return list(words.values())


def check_result(data: Mapping[str, Any], source: str, error: type[Exception]) -> None:
    """Check names, numbers and their ranges in the content of a ``results.json``, and that its figures follow from its runs.

    What is not named here is left as it is.

    Raises:
        error: something is missing, of another type, out of range, or none of these results'.
    """
    take(_Result, data, source, error)
    for key, kind in _TABLES.items():
        if key != "coverage" or data.get(key) is not None:  # older results do not state theirs
            take(kind, data.get(key), f"{source}: {key}", error)
    rows = data.get("environments")
    if not isinstance(rows, list) or len(rows) > MOST_ROWS:
        raise error(f"{source}: environments is {shown(rows)}; it must be a list of at most {MOST_ROWS:,}")
    for at, row in enumerate(rows):
        take(_Row, row, f"{source}: environments[{at}]", error)
    interval = data.get("score_interval")
    if interval is not None and interval[0] > interval[1]:
        raise error(f"{source}: score_interval is {shown(list(interval))}; its ends must rise")
    check_figures(data, chance_rules_of(data, source, error), source, error)


def chance_rules_of(data: Mapping[str, Any], source: str, error: type[Exception]) -> ChanceRules:
    """The rules of chance that some results carry.

    Raises:
        error: one is missing or out of range, or all replicates together are too many.
    """
    rules = take(ChanceRules, data.get("chance"), f"{source}: chance", error)
    if len(data["environments"]) * rules.resamples > MOST_REPLICATES:
        raise error(
            f"{source}: {len(data['environments'])} environments with {rules.resamples:,} replicates are more than is computed; "
            f"{MOST_REPLICATES:,} replicates in all are allowed"
        )
    return rules
