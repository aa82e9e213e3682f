"""The process in which a foreign program runs, and how its owner talks with it.

Observations and actions lie in memory that both see, and two semaphores say whose turn it is: physics leaves little else in the
processor's caches, so that in a control step every further call would be paid for twice. All other messages, and why a step
failed, go through a connection. What comes back is never unpickled: a word, JSON, or numbers. The process ends when its owner
does, when it takes too long, and when nothing refers to it any more.
"""

from __future__ import annotations

import gc
import json
import mmap
import os
import signal
import struct
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.heap import Arena
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
_LOOK_SECONDS = 0.5  # between two looks at whether it still lives
_LONGEST_REPLY = 2**28
_ROOM = 2**26  # of the memory that both see; what is not used takes none

_CALL = struct.Struct("=BBI")  # at its beginning: whether a step is wanted, whether some rows forget first, the session
_FAILS = _CALL.size  # the byte there that says whether the step failed
_HEAD = 64
_FINE, _FAILED = b"\0", b"\1"


class Program(Protocol):
    """A foreign program where it runs."""

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do what a request's ``do`` says.

        Raises:
            PolicyError: the program fails.
        """

    def session(self, rows: int, *, rowwise: bool) -> PolicySession:
        """Start work on so many episodes, together or each alone."""


class _Seats:
    """Where the numbers of a session lie in the memory that both see: all sessions use the same places in turn."""

    def __init__(self, memory: Any, rows: int, width: int, joints: int) -> None:
        numbers = np.frombuffer(memory, np.float32, rows * (width + joints), offset=_HEAD)
        self.observation = numbers[: rows * width].reshape(rows, width)
        self.action = numbers[rows * width :].reshape(rows, joints)
        self.forget = np.frombuffer(memory, np.bool_, rows, offset=_HEAD + numbers.nbytes)


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
        self._source, self._owner = source, os.getpid()
        self._busy = threading.Lock()
        self._dropped: list[int] = []
        try:
            self._asked, self._done = CONTEXT.Semaphore(0), CONTEXT.Semaphore(0)
        except OSError as error:
            raise PolicyError(f"'{source}' is a program, and no process can be started for it: {error}") from error
        self._connection, theirs = CONTEXT.Pipe()
        self._memory, shared = _shared_memory()
        with theirs:
            self._process = CONTEXT.Process(
                target=_run,
                args=(make, theirs, self._connection, shared, (self._asked, self._done), source, self._owner),
                daemon=True,
                name="fence",
            )
            self._process.start()
        self._end = weakref.finalize(self, _end, self._process, self._connection, os.getpid())
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

    def session(self, rows: int, width: int, joints: int, *, rowwise: bool) -> ChildSession:
        """Start a session of so many rows, observations ``width`` and actions ``joints`` wide.

        Raises:
            PolicyError: the program fails, or one step has more numbers than there is room for.
        """
        if 4 * rows * (width + joints) + rows > _ROOM:
            raise PolicyError(
                f"'{self._source}' is a program, which is given at most {_ROOM // 2**20} MiB of observations and actions at "
                f"once; those of {rows} episodes are more: play fewer at a time"
            )
        dropped, self._dropped = self._dropped, []
        answer = self.ask("session", rows=rows, width=width, joints=joints, rowwise=rowwise, dropped=dropped)
        number = int(answer["number"])
        session = ChildSession(number, _Seats(self._memory, rows, width, joints), batched=bool(answer["batched"]))
        weakref.finalize(session, self._dropped_later, number)
        return session

    def _dropped_later(self, number: int) -> None:
        """Forget a session, with the next one that is started: this may be called at any time."""
        self._dropped.append(number)

    def act(self, session: ChildSession, observation: np.ndarray, forget: np.ndarray | None) -> np.ndarray:
        """Actions (N, J) float32 for observations (N, W), after those of ``forget`` (N,) bool were reset.

        Raises:
            PolicyError: the program fails, takes too long or too much memory.
        """
        if os.getpid() != self._owner:
            raise PolicyError(f"'{self._source}' runs for another process; load it in the one that asks for actions")
        seats = session.seats
        with self._busy:
            seats.observation[:] = observation
            if forget is not None:
                seats.forget[:] = forget
            _CALL.pack_into(self._memory, 0, True, forget is not None, session.number)
            self._answered(None)
            return seats.action.copy()

    def _exchange(self, message: bytes) -> bytes:
        with self._busy:
            _CALL.pack_into(self._memory, 0, False, False, 0)
            return self._answered(message)

    def _answered(self, message: bytes | None) -> bytes:
        """The answer to a message; without one nothing, once a control step is done."""
        try:
            self._asked.release()
            if message is None:
                for _ in range(int(_WALL_SECONDS / _LOOK_SECONDS)):
                    if self._done.acquire(True, _LOOK_SECONDS):
                        break
                    if not self._process.is_alive():
                        raise EOFError
                else:
                    raise TimeoutError
                if not self._memory[_FAILS]:
                    return b""
            else:
                self._connection.send_bytes(message)
            if not self._connection.poll(_WALL_SECONDS):
                raise TimeoutError
            reply = self._connection.recv_bytes(_LONGEST_REPLY)
        except TimeoutError as error:
            self._end()
            raise PolicyError(f"'{self._source}' took over {_WALL_SECONDS} s for one step and was ended") from error
        except (OSError, EOFError, ValueError) as error:  # a value: the semaphore has been raised to its most
            raise PolicyError(f"'{self._source}' {self._how_it_ended()}") from error
        except BaseException:
            self._end()  # whoever interrupts it leaves an answer behind that belongs to nobody
            raise
        if reply[:1] != _FINE:
            raise PolicyError(reply[1:].decode("utf-8", errors="replace"))
        return reply[1:]

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


class ChildSession:
    """A session in the process of a program, as its owner knows it."""

    def __init__(self, number: int, seats: _Seats, *, batched: bool) -> None:
        self.number, self.seats = number, seats
        self.batched = batched
        """Whether one run of the program serves all rows."""


def _shared_memory() -> tuple[Any, Any]:
    """Memory that both processes see: for the owner, and as it is handed to the other one."""
    if CONTEXT.get_start_method() == "fork":
        memory = mmap.mmap(-1, _HEAD + _ROOM)
        return memory, memory
    arena = Arena(_HEAD + _ROOM)
    return arena.buffer, arena


def _end(process: Any, connection: Connection, owner: int) -> None:
    connection.close()
    if os.getpid() != owner:
        return  # a copy of its owner, forked: not its process to end
    process.kill()
    process.join(5.0)


def _run(
    make: Any, connection: Connection, parents: Connection, shared: Any, turns: Any, source: str, owner: int
) -> None:
    """The process's whole life."""
    if parents.fileno() != connection.fileno():
        parents.close()
    torch.set_num_threads(1)
    torch.backends.mkldnn.set_flags(False)  # its lstm believes what it is told of sizes, and writes outside of memory
    gc.freeze()  # what it has from its owner is not looked through for garbage again
    enclose(connection.fileno(), owner, [Path(__file__).parent.parent])
    memory = shared.buffer if isinstance(shared, Arena) else shared
    # without gradients and the bookkeeping for them, as episodes are played in the owner
    with suppress(EOFError, OSError), torch.inference_mode():
        _serve(make, connection, memory, turns, source)
    os._exit(0)  # nothing of what the owner would do at its end


def _serve(make: Any, connection: Connection, memory: Any, turns: Any, source: str) -> None:
    """Load the program and do what is asked; back if it cannot be loaded."""
    asked, done = turns
    program: Program | None = None
    sessions: dict[int, tuple[PolicySession, _Seats]] = {}
    allow_seconds(STEP_SECONDS)
    allowed = time.monotonic()
    while True:
        asked.acquire()
        if time.monotonic() > allowed + 1.0:  # three system calls, which not every control step has to make
            allow_seconds(STEP_SECONDS + 1)
            allowed = time.monotonic()
        step, some_forget, number = _CALL.unpack_from(memory)
        if step:
            _, reason = _tried(source, _act, *sessions[number], some_forget)
            memory[_FAILS] = bool(reason)
            done.release()
            if reason:
                connection.send_bytes(_FAILED + reason)
            continue
        message = connection.recv_bytes()
        if program is None:
            program, reason = _tried(source, make, message, source)
            answer = None
        else:
            answer, reason = _tried(source, _answer, program, sessions, memory, json.loads(message))
        connection.send_bytes(_FAILED + reason if reason else _FINE + json.dumps(answer).encode())
        if program is None:
            return


def _tried(source: str, work: Callable[..., Any], *given: Any) -> tuple[Any, bytes]:
    """What a work returns, and for the owner why it failed, if it did."""
    try:
        return work(*given), b""
    except PolicyError as error:
        reason = str(error)
    except MemoryError:
        reason = f"'{source}' needs over {MEMORY // 2**20} MiB of memory, the most that it gets"
    except Exception as error:  # noqa: BLE001  (whatever it is, the owner has to hear of it)
        reason = f"'{source}' failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return None, reason.encode(errors="backslashreplace")


def _answer(
    program: Program, sessions: dict[int, tuple[PolicySession, _Seats]], memory: Any, request: dict[str, Any]
) -> Mapping[str, Any]:
    if request["do"] != "session":
        return program.answer(request)
    for number in request["dropped"]:
        sessions.pop(number, None)
    made = program.session(request["rows"], rowwise=request["rowwise"])
    number = max(sessions, default=0) + 1
    sessions[number] = made, _Seats(memory, request["rows"], request["width"], request["joints"])
    return {"number": number, "batched": made.batched}


def _act(session: PolicySession, seats: _Seats, some_forget: bool) -> None:
    if some_forget:
        session.reset(torch.from_numpy(seats.forget.copy()))
    # a copy: a program may keep what it is given
    seats.action[:] = session.act(torch.from_numpy(seats.observation.copy())).numpy()
