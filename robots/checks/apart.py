"""Try a foreign robot in a process of its own: compiling its files may take all memory, all time, or crash MuJoCo."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from ...files.cell import CONTEXT, MEMORY, allow_seconds, enclose
from ...files.parsing import one_line
from ..loading import RobotError, model_files

COMPUTING_SECONDS = 10
"""Most CPU time for compiling and checking a robot [s]."""
_WAITING_SECONDS = 6 * COMPUTING_SECONDS
"""Longest wait for that on a busy machine [s]."""
_LONGEST_TEXT = 1_000_000
_SOUND = b"\0"
"""Prefix of a result; no error's sentence begins so."""


def run_apart(work: Callable[[], str | None], mjcf: Path) -> str:
    """Work on a robot's model where it can do no harm, and return the text that ``work`` returns.

    Args:
        work: raises ``RobotError`` for a fault, or returns a text.

    Raises:
        RobotError: as ``work``; or the work takes too much time or memory, or MuJoCo crashes.
    """
    import mujoco  # noqa: F401  (once here, not again in each forked process)

    ours, theirs = CONTEXT.Pipe(duplex=False)
    folders = sorted({file.resolve().parent for file in model_files(mjcf)} | {mjcf.parent})
    process = CONTEXT.Process(target=_run, args=(work, theirs, folders, os.getpid()), daemon=True, name="robot")
    with ours:
        with theirs:
            process.start()
        verdict = b""
        try:
            if ours.poll(_WAITING_SECONDS):
                verdict = ours.recv_bytes(_LONGEST_TEXT)
        except (OSError, EOFError):
            process.join(2.0)  # the process has ended, or is about to
        finally:
            process.kill()
            process.join(5.0)
    if verdict.startswith(_SOUND):
        return verdict.removeprefix(_SOUND).decode()
    raise RobotError(verdict.decode("utf-8", "replace") or f"'{one_line(mjcf)}' {_how_it_ended(process.exitcode)}")


def _how_it_ended(code: int | None) -> str:
    if code is not None and -code == getattr(signal, "SIGXCPU", 0):
        return f"takes over {COMPUTING_SECONDS} s of computing to be compiled; make its model smaller"
    if code is not None and code < 0 and -code != signal.SIGKILL:
        crash = f"brought MuJoCo down ({signal.Signals(-code).name})"
        return f"{crash}; it may need over {MEMORY // 2**20} MiB of memory: make its model smaller"
    return f"was not compiled and checked within {_WAITING_SECONDS} s; make its model smaller"


def _run(work: Callable[[], str | None], connection: Connection, folders: list[Path], owner: int) -> None:
    """Run in the process, from its start to its end."""
    enclose(connection.fileno(), owner, folders)
    allow_seconds(COMPUTING_SECONDS)
    try:
        verdict = _SOUND + (work() or "").encode("utf-8", "replace")
    except RobotError as error:
        verdict = str(error).encode("utf-8", "backslashreplace")
    except MemoryError:
        verdict = f"the robot needs over {MEMORY // 2**20} MiB of memory to compile; make its model smaller".encode()
    except Exception as error:  # noqa: BLE001  (the owner has to hear of every error)
        verdict = f"the robot cannot be checked: {type(error).__name__}: {one_line(error)}".encode(errors="replace")
    connection.send_bytes(verdict[:_LONGEST_TEXT])
    os._exit(0)  # without the owner's exit handlers
