"""Scores of known policies, to be shown beside a score of the same suite."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ...files.parsing import Name, Share, Text, build, parse_toml, read_text
from ..result import Result

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
    data = parse_toml(read_text(_FILE, "reference file", ReferenceScoreError), _FILE.name, ReferenceScoreError)
    return build(ReferenceTable, data, _FILE.name, ReferenceScoreError)


def references_for(result: Result) -> Sequence[ReferenceScore]:
    """Return scores that compare with a result, the best first: of the same suite, where it holds all of it; not of the same file."""
    if result.score is None or not result.complete:
        return ()
    suite, own = (result.suite.name, result.suite.version), result.policy.file_sha256
    found = [r for r in reference_table().reference if (r.suite, r.version) == suite and r.file_sha256 != own]
    return sorted(found, key=lambda r: -r.score)
