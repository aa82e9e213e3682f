"""Declare a repair, and install it once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version

from packaging.specifiers import SpecifierSet

from ..base import BackendError


@dataclass(frozen=True, kw_only=True)
class Repair:
    """A replacement of functions of another project."""

    project: str
    """Distribution that is repaired."""
    versions: str
    """Versions that the repair was written for."""
    fault: str
    """The fault or slowness there, the object of a sentence."""
    install: Callable[[], None]
    """Function that replaces the functions; idempotent."""

    def apply(self) -> None:
        """Install the repair before the project's first kernel is built; raise ``BackendError`` for another version."""
        found = version(self.project)
        if found not in SpecifierSet(self.versions, prereleases=True):
            raise BackendError(
                f"{self.project} {found} is installed, but {self.fault} is repaired for {self.versions} alone; "
                f"install '{self.project}{self.versions}'"
            )
        self.install()
