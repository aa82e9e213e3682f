"""Say what a repair is for, and install it once."""

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
    """What is wrong or slow there, the object of a sentence."""
    install: Callable[[], None]
    """Replace the functions; idempotent."""

    def apply(self) -> None:
        """Install the repair in this process; before the first kernel of the project is built.

        Raises:
            BackendError: another version is installed.
        """
        found = version(self.project)
        if found not in SpecifierSet(self.versions, prereleases=True):
            raise BackendError(
                f"{self.project} {found} is installed, but {self.fault} is repaired for {self.versions} alone; "
                f"install '{self.project}{self.versions}'"
            )
        self.install()
