"""Remember how long a command line took on this machine: its next run knows from the first second on how long it takes.

Estimates of one command line are wrong in the same places each time: in the imports, a search, a page, a film. So the rest that was
estimated at each share of the work is kept with the rest that it was, and the next run's estimates are corrected by their ratio.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ..files.writing import json_text, write_atomically
from ..version import __version__
from .console import without_options

_LEAST = 10.0
"""Time of a command that is worth remembering [s]."""
_KEPT = 200
"""Command lines of which the time is kept: the last ones."""
_PARTS = 50
"""Parts of the work, by the share that is done."""
_MOST = 3.0
"""Greatest correction of an estimate, as a factor or a divisor."""


def folder_of_times() -> Path | None:
    """Return where times are kept: a folder of the user's cache; None for a user without a home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gaitgauge" / "times"
    except RuntimeError:
        return None


class Remembered:
    """The last run of a command line, and the one at work."""

    def __init__(self, arguments: Sequence[str], folder: Path | None) -> None:
        """Read what the folder has of the command line without its program; without a folder nothing is remembered."""
        words = without_options(arguments, "--out")
        key = json.dumps([__version__, os.cpu_count(), words])
        name = hashlib.sha256(key.encode("utf-8", "backslashreplace")).hexdigest()[:16]
        self._path = folder / f"{name}.json" if folder is not None and "--resume" not in words else None
        self._began = time.time()
        self._seconds: float | None = None
        self._factors: list[float] = []
        self._furthest = 0.0
        self._notes: dict[int, tuple[int, float, float]] = {}  # by part: estimates, their sum, that of the times [s]
        with suppress(OSError, ValueError, TypeError, KeyError):
            data = json.loads(self._path.read_text(encoding="utf-8")) if self._path else {}
            seconds, factors = float(data["seconds"]), [min(max(float(f), 1 / _MOST), _MOST) for f in data["factors"]]
            if len(factors) == _PARTS + 1:
                self._seconds, self._factors = seconds, factors

    def left(self, spent: float, share: float, estimate: float | None) -> float | None:
        """Return the rest to show [s]: the estimate corrected, or the last run's time where there is no estimate yet.

        Args:
            spent: time since the command began [s].
            share: of the work that is done, 0 to 1.
            estimate: of the rest [s].
        """
        if estimate is not None:
            self._furthest = max(self._furthest, share)
            count, estimates, times = self._notes.get(_part(self._furthest), (0, 0.0, 0.0))
            self._notes[_part(self._furthest)] = count + 1, estimates + estimate, times + spent
        if self._seconds is None:
            return estimate
        if estimate is None:
            return max(self._seconds - spent, 0.0)
        return estimate * self._factors[_part(self._furthest)]

    def keep(self, seconds: float) -> None:
        """Keep how the run at work went, which has ended after so many seconds.

        One that compiled kernels is no measure of the next one; where nothing can be written, nothing is kept.
        """
        if self._path is None or seconds < _LEAST or not self._notes or _compiled_since(self._began):
            return
        factors: list[float] = []
        for part in range(_PARTS + 1):
            count, estimates, times = self._notes.get(part, (0, 0.0, 0.0))
            factors.append((count * seconds - times) / estimates if estimates > 0.0 else factors[-1] if part else 1.0)
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, json_text({"seconds": seconds, "factors": factors}), OSError)
            for old in sorted(self._path.parent.glob("*.json"), key=lambda f: f.stat().st_mtime)[:-_KEPT]:
                old.unlink(missing_ok=True)


def _compiled_since(began: float) -> bool:
    """Return whether Warp has compiled kernels since a time of ``time.time()``."""
    warp = sys.modules.get("warp")
    folder = Path(warp.config.kernel_cache_dir or "") if warp else None
    return folder is not None and folder.is_dir() and any(f.stat().st_mtime > began for f in folder.iterdir())


def _part(share: float) -> int:
    return round(_PARTS * min(max(share, 0.0), 1.0))
