"""The process in which a foreign program runs, and how its owner talks with it.

One message there and one back for a control step. What comes back is never unpickled: a word, JSON, or numbers. The process
ends when its owner does, when it takes too long, and when nothing refers to it any more.
"""

from __future__ import annotations

import json
import os
import select
import signal
import struct
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from ...files.cell import CONTEXT, MEMORY, allow_seconds, enclose
from ..base import PolicyError, PolicySession

STEP_SECONDS = 10
"""Longest that a foreign program may compute for one control step, or for being loaded."""
_WALL_SECONDS = 6 * STEP_SECONDS
"""Longest that its owner waits for that, on a machine that has other things to do."""
_LONGEST_REPLY = 2**28

_FINE, _FAILED = b"\0\0\0\0", b"\1\0\0\0"
_ACT = struct.Struct("=IIII")  # zero, session, rows, whether a mask of those to forget follows


class Program(Protocol):
    """A foreign program where it runs."""

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do what a request's ``do`` says.

        Raises:
            PolicyError: the program fails.
        """

    def session(self, rows: int, *, rowwise: bool) -> PolicySession:
        """Start work on so many episodes, together or each alone."""


class Child:
    """A process of one foreign program, seen from its owner."""

    def __init__(self, make: Callable[[bytes, str], Program], data: bytes, *, source: str) -> None:
        """Start the process and load the program there.

        Args:
            make: loads a program, given its content and its name for messages.
            data: the program.
            source: its name for messages.

        Raises:
            PolicyError: it cannot be loaded, takes too long or too much memory.
        """
        self._source = source
        self._busy = threading.Lock()
        self._dropped: list[int] = []
        self._connection, theirs = CONTEXT.Pipe()
        with theirs:
            self._process = CONTEXT.Process(
                target=_run, args=(make, theirs, self._connection, source, os.getpid()), daemon=True, name="fence"
            )
            self._process.start()
        self._end = weakref.finalize(self, _end, self._process, self._connection, os.getpid())
        self._poll = select.poll() if hasattr(select, "poll") else None
        if self._poll is not None:
            self._poll.register(self._connection.fileno(), select.POLLIN)
        self._exchange(data)

    def ask(self, do: str, **details: Any) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Raises:
            PolicyError: the program fails, takes too long or too much memory.
        """
        reply = self._exchange(json.dumps({"do": do, **details}).encode())
        try:
            answer = json.loads(reply)
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            raise PolicyError(f"'{self._source}' failed: its process answered nonsense")
        return answer

    def session(self, rows: int, *, rowwise: bool) -> tuple[int, bool]:
        """Start a session; its number, and whether one run of the program serves all its rows."""
        dropped, self._dropped = self._dropped, []
        answer = self.ask("session", rows=rows, rowwise=rowwise, dropped=dropped)
        return int(answer["number"]), bool(answer["batched"])

    def drop(self, number: int) -> None:
        """Forget a session, with the next one that is started: this may be called at any time."""
        self._dropped.append(number)

    def act(self, number: int, observation: np.ndarray, forget: np.ndarray | None, joints: int) -> torch.Tensor:
        """Actions (N, J) of a session for observations (N, W) float32, after those of ``forget`` (N,) bool were reset."""
        rows = len(observation)
        parts = [_ACT.pack(0, number, rows, forget is not None), b"" if forget is None else forget.tobytes()]
        reply = self._exchange(b"".join([*parts, np.ascontiguousarray(observation, dtype=np.float32).tobytes()]))
        if len(reply) != 4 * rows * joints:
            raise PolicyError(f"'{self._source}' failed: its process answered nonsense")
        # a bytearray may be written to, as torch wants it
        return torch.frombuffer(bytearray(reply), dtype=torch.float32).view(rows, joints)

    def _exchange(self, message: bytes) -> bytes:
        with self._busy:
            try:
                self._connection.send_bytes(message)
                if not self._arrives():
                    raise PolicyError(f"'{self._source}' took over {_WALL_SECONDS} s for one step and was ended")
                reply = self._connection.recv_bytes(_LONGEST_REPLY)
            except (OSError, EOFError) as error:
                raise PolicyError(f"'{self._source}' {self._how_it_ended()}") from error
            except BaseException:
                self._end()  # whoever interrupts it leaves an answer behind that belongs to nobody
                raise
        if reply[:4] != _FINE:
            raise PolicyError(reply[4:].decode("utf-8", errors="replace"))
        return bytes(reply[4:])

    def _arrives(self) -> bool:
        if self._poll is None:
            return self._connection.poll(_WALL_SECONDS)
        return bool(self._poll.poll(_WALL_SECONDS * 1000))

    def _how_it_ended(self) -> str:
        until = time.monotonic() + 2.0
        while self._process.is_alive() and time.monotonic() < until:
            time.sleep(0.01)
        code = self._process.exitcode
        self._end()
        if code is not None and -code == getattr(signal, "SIGXCPU", 0):
            return f"took over {STEP_SECONDS} s of computing for one step and was ended"
        if code is not None and code < 0:
            name = signal.Signals(-code).name
            return f"crashed in its own process ({name}); it may need over {MEMORY // 2**20} MiB of memory"
        return "ended its own process"


def _end(process: Any, connection: Connection, owner: int) -> None:
    connection.close()
    if os.getpid() != owner:
        return  # a copy of its owner, forked: not its process to end
    process.kill()
    process.join(5.0)


def _run(make: Any, connection: Connection, parents: Connection, source: str, owner: int) -> None:
    """The process's whole life."""
    if parents.fileno() != connection.fileno():
        parents.close()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    enclose(connection.fileno(), owner, [Path(__file__).parent.parent])
    try:
        allow_seconds(STEP_SECONDS)
        program = _answered(connection, source, lambda: make(connection.recv_bytes(), source))
        sessions: dict[int, PolicySession] = {}
        while program is not None:
            message = connection.recv_bytes()
            allow_seconds(STEP_SECONDS)
            if message[:4] == _FINE:
                _act(connection, source, sessions, message)
            else:
                _answer(connection, source, program, sessions, json.loads(message))
    except (EOFError, OSError):
        pass
    os._exit(0)  # nothing of what the owner would do at its end


def _answered(connection: Connection, source: str, work: Callable[[], Any], pack: Any = lambda _: b"") -> Any:
    """Do something and tell the owner how it went; None if it failed."""
    try:
        result = work()
        reply = _FINE + pack(result)
    except PolicyError as error:
        result, reply = None, _FAILED + str(error).encode(errors="backslashreplace")
    except MemoryError:
        reason = f"'{source}' needs over {MEMORY // 2**20} MiB of memory, the most that it gets"
        result, reply = None, _FAILED + reason.encode(errors="backslashreplace")
    except Exception as error:  # noqa: BLE001  (whatever it is, the owner has to hear of it)
        words = " ".join(str(error).split())[:200]
        result, reply = None, _FAILED + f"'{source}' failed: {type(error).__name__}: {words}".encode(errors="replace")
    connection.send_bytes(reply)
    return result


def _answer(
    connection: Connection, source: str, program: Program, sessions: dict[int, PolicySession], request: dict[str, Any]
) -> None:
    def work() -> Mapping[str, Any]:
        if request["do"] != "session":
            return program.answer(request)
        for number in request["dropped"]:
            sessions.pop(number, None)
        made = program.session(request["rows"], rowwise=request["rowwise"])
        number = max(sessions, default=0) + 1
        sessions[number] = made
        return {"number": number, "batched": made.batched}

    _answered(connection, source, work, lambda answer: json.dumps(answer).encode())


def _act(connection: Connection, source: str, sessions: dict[int, PolicySession], message: bytes) -> None:
    _, number, rows, masked = _ACT.unpack_from(message)
    start = _ACT.size + rows * masked

    def work() -> torch.Tensor:
        if masked:
            sessions[number].reset(torch.frombuffer(bytearray(message[_ACT.size : start]), dtype=torch.bool))
        observation = torch.frombuffer(bytearray(message[start:]), dtype=torch.float32)
        return sessions[number].act(observation.view(rows, -1))

    _answered(connection, source, work, lambda action: action.numpy().tobytes())
