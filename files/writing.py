"""Write files whole or not at all, and keep folders for one process at a time."""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import re
import secrets
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from .parsing import one_line, shown

LOCK = ".lock"
_PATIENCE = 3.0
"""Longest wait for a lock [s]: the workers of a killed process need a moment to notice."""


@contextmanager
def replacing(path: Path, error: type[Exception], *, durable: bool = True, ending: str = ".partial") -> Iterator[Path]:
    """Yield a temporary path that is renamed to ``path`` at the end; at an error it is removed, and ``path`` stays.

    Args:
        durable: wait until the disk has the file; otherwise it survives the end of the process, not that of the machine.
        ending: end of the temporary name, for libraries that go by it.

    Raises:
        error: the file cannot be written (the disk is full, read-only …), or ``path`` is no file.
    """
    if (other := _no_file(path)) is not None:
        raise error(f"cannot write '{one_line(path)}': {other}; choose another place")
    # Random, so that two processes never share it; without path's own name, which may have the greatest length already.
    partial = path.with_name(f".{secrets.token_hex(8)}.partial{ending.removeprefix('.partial')}")
    try:
        yield partial
        if durable:
            _flush(partial)
        os.replace(partial, path)
        if durable:
            _flush(path.parent)
    except OSError as problem:
        raise error(write_failure(path, problem)) from problem
    finally:
        with suppress(OSError):
            partial.unlink()


def is_half_written(name: str) -> bool:
    """Return whether ``replacing`` made a file's name: sixteen random digits, which no user's file has."""
    return re.match(r"\.[0-9a-f]{16}\.partial", name) is not None


def write_atomically(path: Path, data: str | bytes | memoryview, error: type[Exception]) -> None:
    """Write a whole file or, raising ``error``, nothing."""
    with replacing(path, error) as partial:
        partial.write_bytes(data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data)


def same_file(path: str | Path, other: str | Path) -> bool:
    """Return whether two paths lead to one file, links followed; False where either leads nowhere."""
    with suppress(OSError):
        return os.path.samefile(path, other)
    return False


def write_files(folder: Path, texts: Mapping[str, str], error: type[Exception]) -> None:
    """Write texts by file name into a folder that is created, each whole or not at all; raise ``error`` where that fails."""
    make_folder(folder, error)
    for name, text in texts.items():
        write_atomically(folder / name, text, error)


def make_folder(folder: Path, error: type[Exception], *, option: str = "--out") -> None:
    """Create a folder and its parents where missing; raise ``error``, which names the ``option`` for the place, on failure."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise error(write_failure(folder, problem, f"choose another {option}")) from problem
    except ValueError as problem:  # a null character, or half of a surrogate pair
        raise error(f"{shown(str(folder))} is no name that a folder can have; choose another {option}") from problem


def _no_file(path: Path) -> str | None:
    """Describe a path that no file may replace, such as a folder or, for root, a device; None for a file and for nothing."""
    try:
        if path.is_dir():
            return "it is a folder"
        if (path.exists() and not path.is_file()) or path.parent.resolve() == Path("/dev"):
            return "it is no file, but a device or a pipe"
        path.lstat()
    except ValueError:
        return "its name holds a null character"
    except OSError:
        pass  # nothing is there, or writing will say what is wrong
    return None


def write_failure(path: Path, problem: OSError, hint: str = "choose another place") -> str:
    """Return the sentence for a file that cannot be written; ``hint`` says what to do where the disk is not full."""
    reason = (problem.strerror or one_line(problem)).lower()
    if problem.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        hint = "free some space and run again; what was written before is intact"
    return f"cannot write '{one_line(path)}': {reason}; {hint}"


def json_text(data: Any) -> str:
    """Return plain data as JSON; values outside of JSON (NaN, infinity, halves of surrogate pairs) become text."""
    return json.dumps(_writable(data), indent=1, allow_nan=False) + "\n"


def _writable(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {_writable(str(k)): _writable(v) for k, v in value.items()}
    return [_writable(v) for v in value] if isinstance(value, list | tuple) else value


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV text. A text that a spreadsheet would run as a formula gets an apostrophe before it."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([f"'{value}" if _is_formula(value) else value for value in row] for row in rows)
    return text.getvalue()


def _is_formula(value: object) -> bool:
    if not isinstance(value, str) or not value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return False
    try:
        float(value)
    except ValueError:
        return True
    return False


def lock_folder(folder: Path, error: type[Exception]) -> FileLock:
    """Keep a folder for this process until ``release()`` or its end, and remove half-written files of killed processes.

    Raises:
        error: another process has it, or the folder cannot be written to.
    """
    lock = FileLock(folder / LOCK, timeout=_PATIENCE)
    try:
        lock.acquire()
    except Timeout as problem:
        busy = f"another process is writing to '{one_line(folder)}'; wait until it has ended, or choose another folder"
        raise error(busy) from problem
    except OSError as problem:
        raise error(write_failure(folder / LOCK, problem)) from problem
    for partial in _strays(folder):
        with suppress(OSError):
            partial.unlink()
    return lock


def _strays(folder: Path) -> Iterator[Path]:
    """Yield the half-written files of a folder, but not those of folders below that another process may have locked."""
    for place, below, names in os.walk(folder):
        if LOCK in names and Path(place) != folder:
            below.clear()
            continue
        yield from (Path(place, name) for name in names if is_half_written(name))


def _flush(path: Path) -> None:
    """Wait until the disk holds a file, or the names in a folder."""
    windows = sys.platform == "win32"  # opens no folder, and flushes only what may be written
    if windows and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if windows else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
