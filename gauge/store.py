"""The folder of a run: what was asked for, and one file for each finished episode. Nothing in it is ever half written."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from ..files.parsing import one_line, parse_json, read_text, shown
from ..files.writing import LOCK, is_half_written, lock_folder, make_folder, write_atomically, write_failure
from .episodes import Episode, Record, read_records


class StoreError(ValueError):
    """The output folder cannot be used; the message says why and what to do."""


class RunFolder:
    """Finished episodes of one run, on disk. ``request.json`` holds what decides about results; ``episodes/`` the records.

    A context manager: until its end no other process can use the folder.
    """

    def __init__(self, folder: Path, request: Mapping[str, Any], *, resume: bool) -> None:
        """Open or create the folder.

        Args:
            request: everything that decides about the results (suite, policy hash, engine, environments …), plain data.

        Raises:
            StoreError: the folder belongs to another run, holds a run and ``resume`` is not asked for, is in use, or
                its episodes are a link to another place.
        """
        self._episodes = folder / "episodes"
        wanted = check_folder(folder, request, resume=resume)  # before anything in it is touched
        if self._episodes.is_symlink():  # records are removed and set aside there: of whom?
            raise StoreError(
                f"'{one_line(self._episodes)}' is a link, and a run writes to its own folder alone; "
                "put the episodes there in place of the link, or give another folder with --out"
            )
        make_folder(self._episodes, StoreError)
        self._lock = lock_folder(folder, StoreError)
        try:
            # and once more: who had the folder while this process waited may have left a run in it
            if _present_request(folder, wanted, resume=resume) != wanted:
                write_atomically(folder / "request.json", json.dumps(wanted, indent=1) + "\n", StoreError)
            self.records, self.damaged = read_records(self._episodes)
            """Episodes that have ended, to which ``put`` does not add; files that were damaged and are set aside."""
        except OSError as error:
            self._lock.release()
            raise StoreError(write_failure(folder, error)) from error
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *details: object) -> None:
        self._lock.release()

    def put(self, record: Record) -> None:
        """Keep a record."""
        record.save(self._episodes)

    def discard_all_but(self, counted: Collection[Episode]) -> None:
        """Remove the records of speculative episodes that results do not count; raise ``StoreError`` where one cannot be removed."""
        names = {episode.key for episode in counted}
        for path in self._episodes.glob("*.npz"):
            if path.stem not in names:
                try:
                    path.unlink()
                except OSError as error:
                    raise StoreError(write_failure(path, error)) from error


def check_folder(folder: Path, request: Mapping[str, Any], *, resume: bool) -> Any:
    """Check that a run may use a folder, as far as that can be known before it is locked; returns the request as JSON keeps it.

    Raises:
        StoreError: the folder belongs to another run, holds a run and ``resume`` is not asked for, or is a file.
    """
    wanted = json.loads(json.dumps(request))
    _present_request(folder, wanted, resume=resume)
    return wanted


def _present_request(folder: Path, wanted: Mapping[str, Any], *, resume: bool) -> Any:
    """The request of the run that a folder holds, None if it holds none; see ``RunFolder`` for what is refused."""
    marker = folder / "request.json"
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder} is a file; give a folder with --out")
    if not marker.exists():
        if folder.exists() and any(not _left_by_a_kill(path) for path in folder.iterdir()):
            raise StoreError(f"{folder} is not empty and holds no run; give another folder with --out")
        return None
    try:
        present = parse_json(read_text(marker, "request", StoreError, largest=10**8), "it", StoreError)
        if not isinstance(present, dict):
            raise StoreError("it holds no table")
    except StoreError as error:
        raise StoreError(f"{marker} is damaged ({error}); give another folder with --out") from error
    different = sorted(k for k in wanted.keys() | present.keys() if wanted.get(k) != present.get(k))
    if different and any((folder / "episodes").glob("*.npz")):  # else it ended before its first episode did
        found = "; ".join(_differences(present, wanted))
        raise StoreError(f"{folder} belongs to another run ({found}); give another folder with --out")
    if not different and not resume:
        raise StoreError(f"{folder} already holds this run; go on with --resume, or give another folder with --out")
    return present


def _left_by_a_kill(path: Path) -> bool:
    """Whether something in a folder is all that a run leaves that was killed while it began."""
    if path.is_dir():
        return path.name == "episodes" and not any(path.iterdir())
    return path.name == LOCK or is_half_written(path.name)


def _differences(present: Mapping[str, Any], wanted: Mapping[str, Any], path: str = "") -> list[str]:
    """What differs between two requests, entry by entry."""
    found = []
    for key in sorted(present.keys() | wanted.keys()):
        old, new = present.get(key), wanted.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            found += _differences(old, new, f"{path}{key}.")
        elif old != new:
            whole = f"{path}{one_line(key, 80)} was {shown(old)}, now {shown(new)}"
            found.append(whole if len(whole) <= 120 else f"{path}{one_line(key, 80)} differs")
    return found if path else found[:_NAMED]


_NAMED = 4
"""Differences that a sentence names."""
