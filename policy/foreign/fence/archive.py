"""The zip archives that torch writes, read with their sizes and checksums checked: torch checks neither."""

from __future__ import annotations

import io
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

from ...base import PolicyError

LARGEST_FILE = 512 * 2**20
"""Largest policy file, and largest content of an archive once unpacked [bytes]."""
MOST_RECORDS = 20_000
"""Most entries of an archive."""

_ERRORS = (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, KeyError, NotImplementedError, RuntimeError)


def read_limited(path: Path) -> bytes:
    """Return a policy file's content; raise ``PolicyError`` where it is unreadable, empty or larger than ``LARGEST_FILE``."""
    try:
        with path.open("rb") as file:
            large = os.fstat(file.fileno()).st_size > LARGEST_FILE
            data = b"" if large else file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise PolicyError(f"'{path}' cannot be read: {error.strerror}") from error
    if large or len(data) > LARGEST_FILE:
        raise PolicyError(f"'{path}' is larger than {LARGEST_FILE // 2**20} MiB, the most that is read of a policy")
    if not data:
        raise PolicyError(f"'{path}' is empty")
    return data


def archive_names(data: bytes, *, source: str) -> frozenset[str]:
    """Return an archive's records' names without the folder that holds them all; raise ``PolicyError`` where it is no archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return frozenset(name.partition("/")[2] for name in archive.namelist())
    except _ERRORS as error:
        raise PolicyError(f"'{source}' is a damaged or truncated archive: {error}") from error


def read_archive(data: bytes, *, source: str) -> dict[str, bytes]:
    """Return all records of an archive by their names without the folder that holds them all.

    Raises:
        PolicyError: not an archive of torch's form, damaged (a checksum is wrong), or larger than ``LARGEST_FILE`` unpacked.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _records(archive, source)
    except _ERRORS as error:
        if isinstance(error, PolicyError):
            raise
        raise PolicyError(f"'{source}' is a damaged or truncated archive: {error}") from error


def _records(archive: zipfile.ZipFile, source: str) -> dict[str, bytes]:
    entries = [e for e in archive.infolist() if not e.filename.endswith("/")]  # is_dir() fails without a name
    if len(entries) > MOST_RECORDS:
        raise PolicyError(f"'{source}' has {len(entries):,} entries; at most {MOST_RECORDS:,} are read")
    size = sum(entry.file_size for entry in entries)
    if size > LARGEST_FILE:
        raise PolicyError(
            f"'{source}' unpacks to {size / 2**20:,.0f} MiB; at most {LARGEST_FILE // 2**20} MiB are read"
        )
    if len({entry.filename.partition("/")[0] for entry in entries}) > 1:
        raise PolicyError(f"'{source}' is a zip archive, but neither TorchScript nor a torch.save file")
    records: dict[str, bytes] = {}
    spelled: set[str] = set()
    for entry in entries:
        name = entry.filename.partition("/")[2]
        if not name:
            raise PolicyError(f"'{source}' is a damaged archive: it has an entry without a name")
        if name.lower() in spelled:  # torch asks for names in any case
            raise PolicyError(f"'{source}' is a damaged archive: it has the entry '{entry.filename}' twice")
        spelled.add(name.lower())
        with archive.open(entry) as record:
            # reading to the end checks the sum, and stops where the archive says that the record does
            content = record.read()
        if len(content) != entry.file_size:
            raise PolicyError(f"'{source}' is a damaged archive: '{entry.filename}' has another size")
        records[name] = content
    return records


def packed(records: Mapping[str, bytes]) -> bytes:
    """Return the records as an archive that torch reads: what was checked is what is loaded, whatever else the file holds."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in records.items():
            archive.writestr(zipfile.ZipInfo(f"archive/{name}"), content)
    return buffer.getvalue()
