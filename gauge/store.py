"""The folder of a run: what was asked for, and one file for each finished episode. Nothing in it is ever half written."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .episodes import Episode, Record


class StoreError(ValueError):
    """The output folder cannot be used; the message says why and what to do."""


def write_atomically(path: Path, text: str) -> None:
    """Write a text file, all or nothing."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


class RunFolder:
    """Finished episodes of one run, on disk. ``request.json`` holds what decides about results; ``episodes/`` the records."""

    def __init__(self, folder: Path, request: Mapping[str, Any], *, resume: bool) -> None:
        """Open or create the folder.

        Args:
            folder: where results go.
            request: everything that decides about the results (suite, policy hash, engine, environments …), plain data.
            resume: go on with a run that is already there.

        Raises:
            StoreError: the folder belongs to another run, or holds a run and ``resume`` is not asked for.
        """
        self.folder = folder
        self._episodes = folder / "episodes"
        wanted = json.loads(json.dumps(request))
        marker = folder / "request.json"
        if folder.exists() and not folder.is_dir():
            raise StoreError(f"{folder} is a file; give a folder with --out")
        if marker.exists():
            try:
                present = json.loads(marker.read_text(encoding="utf-8"))
                if not isinstance(present, dict):
                    raise ValueError("it holds no table")
            except (OSError, ValueError) as error:
                raise StoreError(f"{marker} is damaged ({error}); give another folder with --out") from error
            different = sorted(k for k in wanted.keys() | present.keys() if wanted.get(k) != present.get(k))
            if different and not any(self._episodes.glob("*.npz")):
                marker.unlink()  # the other run ended before its first episode did: there is nothing to lose
            elif different:
                key = different[0]
                raise StoreError(
                    f"{folder} belongs to another run ({_difference(key, present.get(key), wanted.get(key))}); "
                    "give another folder with --out"
                )
            elif not resume:
                raise StoreError(
                    f"{folder} already holds this run; go on with --resume, or give another folder with --out"
                )
        elif folder.exists() and any(not _left_by_a_kill(p) for p in folder.iterdir()):
            raise StoreError(f"{folder} is not empty and holds no run; give another folder with --out")
        try:
            self._episodes.mkdir(parents=True, exist_ok=True)
            if not marker.exists():
                write_atomically(marker, json.dumps(wanted, indent=1) + "\n")
        except OSError as error:
            raise StoreError(f"cannot write to {folder}: {error.strerror}; give another folder with --out") from error
        self.found = {p.stem for p in self._episodes.glob("*.npz")}

    def get(self, episode: Episode) -> Record | None:
        """The record of an episode that has already run."""
        if episode.key not in self.found:
            return None
        return Record.load(self._episodes / f"{episode.key}.npz")

    def put(self, record: Record) -> None:
        """Keep a record."""
        record.save(self._episodes)


def _left_by_a_kill(path: Path) -> bool:
    """Whether something in a folder is all that a run leaves that was killed while it began."""
    if path.is_dir():
        return path.name == "episodes" and not any(path.iterdir())
    return path.name == "request.json.tmp"


class MemoryStore:
    """Keeps records in memory only."""

    def __init__(self) -> None:
        self.records: dict[str, Record] = {}

    def get(self, episode: Episode) -> Record | None:
        """The record of an episode that has already run."""
        return self.records.get(episode.key)

    def put(self, record: Record) -> None:
        """Keep a record."""
        self.records[record.episode.key] = record


def _difference(key: str, present: Any, wanted: Any) -> str:
    shown = [json.dumps(v) for v in (present, wanted)]
    if max(map(len, shown)) > 60:
        return f"{key} differs"
    return f"{key} was {shown[0]}, now {shown[1]}"
