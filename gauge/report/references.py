"""Scores of known policies, to be shown beside a score of the same scale: suite, version, robot and engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from ...files.parsing import Name, Share, Text, read_toml
from ..result import COMPLETE, Result

ENGINE = "mujoco"
"""The engine of all scores of the table."""
_FILE = Path(__file__).parent / "references.toml"


class ReferenceScoreError(ValueError):
    """The table of reference scores is malformed."""


@dataclass(frozen=True, kw_only=True)
class ReferenceScore:
    """One policy on one suite."""

    suite: Name
    """The suite's name."""
    version: Name
    """The suite's version: others do not compare."""
    policy: Text
    """The policy, in words."""
    kind: Literal["published", "shipped", "trotting", "standing"]
    """Published by others, shipped with the project, the hand-made trot, or a robot that stands still."""
    robot: Name = "go2"
    """The robot's name: scores of other robots do not compare."""
    score: Share
    """Of the whole suite."""
    source: Text
    """The publication."""
    interval: tuple[Share, Share] | None = None
    """95 % interval of the score, where it is known."""
    file_sha256: Name | None = None
    """The policy's file, where it is known."""


@dataclass(frozen=True, kw_only=True)
class ReferenceTable:
    """All of them."""

    reference: tuple[ReferenceScore, ...]
    """In the order of the file."""


@cache
def reference_table() -> ReferenceTable:
    """Return the scores that ship with the project; raise ``ReferenceScoreError`` where the file is malformed."""
    return read_toml(_FILE, ReferenceTable, "reference file", ReferenceScoreError)


def references_for(result: Result) -> Sequence[ReferenceScore]:
    """Return scores that compare with a result, the best first: of the same scale, where it holds all of it; not of the same file."""
    if result.score is None or not result.complete or result.backend != ENGINE:
        return ()
    scale, own = (result.suite.name, result.suite.version, result.robot), result.policy.file_sha256
    found = [r for r in reference_table().reference if (r.suite, r.version, r.robot) == scale and r.file_sha256 != own]
    return sorted(found, key=lambda r: -r.score)


def comparable(result: Result) -> str:
    """Return in words which scores compare with a result's, and an example of one that does not."""
    scale = f"{result.suite} for the robot {result.robot} on the engine {result.backend}"
    if result.coverage.kind != COMPLETE:
        return f"this score compares only with runs of the same part ({result.coverage.text}) of {scale}"
    shipped = [r for r in reference_table().reference if r.kind == "shipped" and r.robot == result.robot]
    here = [r for r in shipped if (r.suite, r.version) == (result.suite.name, result.suite.version)]
    others = [r for r in shipped if r not in here]
    example = ""
    if others:
        both = [*here, others[0]] if result.backend == ENGINE else others[:1]
        told = " and ".join(f"{r.score:.4f} on {r.suite} {r.version}" for r in both)
        example = f"; other suites have other scales: {both[0].policy.partition(',')[0]} has {told}"
    return f"this score compares only with scores of {scale}{example}"
