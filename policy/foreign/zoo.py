"""The zoo: public policies of other projects, known by the SHA-256 of their files, and how each is run (``zoo.toml``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from ...files.parsing import Name, Text, read_toml
from ...robots.base import Robot
from ..base import PolicyError
from ..contract import PolicyContract
from .bodies import choose_robot
from .described import contract_of

_FILE = Path(__file__).parent / "zoo.toml"
ADAPTER = "zoo"


@dataclass(frozen=True, kw_only=True)
class KnownPolicy:
    """One public file."""

    name: Name
    file: Text
    """Name of the file in its project."""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    """Of its content."""
    title: Text
    """Robot, training code and kind."""
    source: Text
    """The project that publishes it."""
    licence: Text
    contract: Mapping[str, Any]
    """A ``contract.toml``."""
    note: Text | None = None
    """Settings that its authors' files leave open."""
    remark: Text | None = None
    """What else its user has to know."""

    @property
    def robot(self) -> str:
        """Return the name of its robot, which need not be installed."""
        return str(self.contract["robot"])

    def observed(self) -> str:
        """Return the width of the observation, and of its frames, in words."""
        contract = known_contract(self, None)
        width, frame = contract.observation_width, contract.frame_width
        inputs = f" in {len(contract.input_widths)} inputs" if len(contract.input_widths) > 1 else ""
        return f"{width}{inputs}" + (f", frames of {frame}" if width != frame else "")


@dataclass(frozen=True, kw_only=True)
class _Zoo:
    policy: tuple[KnownPolicy, ...]


@cache
def zoo() -> Mapping[str, KnownPolicy]:
    """Return all known policies by SHA-256, in the order of the file; raise ``PolicyError`` where the file is malformed."""
    return {each.sha256: each for each in read_toml(_FILE, _Zoo, "file of known policies", PolicyError).policy}


def known_contract(known: KnownPolicy, asked: Robot | None) -> PolicyContract:
    """Return how a known policy is run; ``asked`` is the robot that it is asked for, whose name may have an addition.

    Raises:
        PolicyError: it is for another robot, or its description needs a robot that is not installed.
    """
    provenance = {"adapter": ADAPTER, "file": known.name, "source": known.source, "licence": known.licence}
    if known.note is not None:
        provenance["assumed"] = known.note
    if known.remark is not None:
        provenance["remark"] = known.remark
    source = f"{known.file} ({known.name})"
    try:
        robot: Robot | None = choose_robot(asked, known.robot, source)
    except PolicyError:
        if asked is not None or "preset" in known.contract:
            raise
        robot = None  # it says everything, and a robot of one's own can be given later
    return contract_of(dict(known.contract), robot, f"the zoo's {known.name}", provenance)
