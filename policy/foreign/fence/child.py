"""Runs a foreign program in a process of its own, and talks with it.

Observations and actions lie in memory that both see, and two semaphores pass the turn. Physics leaves little of either
process in the processor's caches, so that a line of Python that a control step runs here costs microseconds: what it needs is
laid out beforehand, and it is done in as few calls as will do. All other messages, and why a step failed, go through a
connection. What comes back is never unpickled: a word, JSON, or numbers. The process ends when its owner does, when it takes too
long, and when nothing refers to it any more.

One of the two always waits for the other, so both use one core. On one of its own the program would find the caches of a core
that has slept since the last step.
"""

from __future__ import annotations

import ctypes
import gc
import json
import mmap
import os
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.heap import Arena
from pathlib import Path
from typing import Any, Protocol

import torch

from ....files.cell import CONTEXT, MEMORY, allow_seconds, enclose
from ...base import PolicyError, PolicySession

STEP_SECONDS = 10
"""Longest that a foreign program may compute for one control step, or for being loaded."""
_WALL_SECONDS = 6 * STEP_SECONDS
"""Longest that its owner waits for that, on a machine that has other things to do."""
_LOOK_SECONDS = 0.5  # between two looks at whether it still lives
_LONGEST_REPLY = 2**28
_ROOM = 2**26  # of the memory that both see; what is not used takes none

# Numbers at the beginning of that memory.
_WANTED, _SESSION, _FAILS, _CORE, _HEAD = range(5)  # the core by its number and one; 0: any
_HEAD_BYTES = 64
_MESSAGE, _STEP, _STEP_AFTER_RESET = range(3)  # the kinds of request
_FINE, _FAILED = b"\0", b"\1"
# What the other process's end looks like; a value: the semaphore has been raised to its most.
_ENDED = (OSError, EOFError, ValueError)

_present_core: Callable[[], int] | None = (
    getattr(ctypes.CDLL(None), "sched_getcpu", None) if sys.platform == "linux" else None
)


class Program(Protocol):
    """A foreign program where it runs."""

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do what a request's ``do`` says; raise ``PolicyError`` where the program fails."""

    def session(self, rows: int, *, rowwise: bool) -> PolicySession:
        """Start work on so many episodes, together or each alone."""


class _Numbers:
    """The numbers of a session in the memory that both see: all sessions use the same places in turn."""

    def __init__(self, memory: Any, rows: int, width: int, joints: int) -> None:
        with torch.inference_mode(False):  # else they could be changed in that mode alone
            both = torch.frombuffer(memory, dtype=torch.float32, count=rows * (width + joints), offset=_HEAD_BYTES)
            self.observation = both[: rows * width].view(rows, width)
            self.action = both[rows * width :].view(rows, joints)
            self.forget = torch.frombuffer(memory, dtype=torch.bool, count=rows, offset=_HEAD_BYTES + both.nbytes)


def _head(memory: Any) -> memoryview:
    return memoryview(memory)[: 4 * _HEAD].cast("I")


class Child:
    """A process of one foreign program, seen from its owner."""

    def __init__(self, make: Callable[[bytes, str], Program], data: bytes, *, source: str) -> None:
        """Start the process and load the program there.

        Args:
            make: loads a program, given its content and its name for messages.

        Raises:
            PolicyError: it cannot be loaded, takes too long or too much memory.
        """
        self._source, self._owner = source, os.getpid()
        self._busy = threading.Lock()
        self._dropped: list[int] = []
        try:
            self._asked, self._done = CONTEXT.Semaphore(0), CONTEXT.Semaphore(0)
        except OSError as error:
            raise PolicyError(
                f"'{source}' is a program, and no process can be started for it: {error}; two semaphores need "
                "room in /dev/shm"
            ) from error
        self._connection, theirs = CONTEXT.Pipe()
        self._memory, shared = _shared_memory()
        self._head = _head(self._memory)
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
        """Return the answer to a request; raise ``PolicyError`` where the program fails, takes too long or too much memory."""
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
        session = ChildSession(number, _Numbers(self._memory, rows, width, joints))
        weakref.finalize(session, self._dropped_later, number)
        return session

    def _dropped_later(self, number: int) -> None:
        """Forget a session, with the next one that is started: this may be called at any time."""
        self._dropped.append(number)

    def act(self, session: ChildSession, observation: torch.Tensor, forget: torch.Tensor | None) -> torch.Tensor:
        """Return actions (N, J) float32 for observations (N, W), after those of ``forget`` (N,) bool were reset.

        Raises:
            PolicyError: the program fails, takes too long or too much memory.
        """
        if os.getpid() != self._owner:
            raise PolicyError(f"'{self._source}' runs for another process; load it in the one that asks for actions")
        numbers, head = session.numbers, self._head
        with self._busy:
            numbers.observation.copy_(observation)
            if forget is None:
                head[_WANTED] = _STEP
            else:
                numbers.forget.copy_(forget)
                head[_WANTED] = _STEP_AFTER_RESET
            head[_SESSION] = session.number
            anywhere = self._stay()
            try:
                self._asked.release()
                if not self._done.acquire(True, _LOOK_SECONDS):
                    self._wait_longer()
                reply = self._receive() if head[_FAILS] else _FINE
            except _ENDED as error:
                raise self._ended(error) from error
            except BaseException:
                self._end()  # whoever interrupts it leaves an answer behind that belongs to nobody
                raise
            finally:
                if anywhere:
                    with suppress(OSError):  # those cores may be this process's no more
                        os.sched_setaffinity(0, anywhere)
            if reply is not _FINE:
                _content(reply)
            return numbers.action.clone()

    def _stay(self) -> set[int] | None:
        """Stay on the present core and call the other process there; where this thread may run otherwise, if it can be held."""
        if _present_core is None:
            return None
        core = _present_core()
        try:
            anywhere = os.sched_getaffinity(0)
            os.sched_setaffinity(0, (core,))
        except (OSError, ValueError):  # not every machine lets a process choose; it costs time alone
            return None
        self._head[_CORE] = 1 + core
        return anywhere

    def _wait_longer(self) -> None:
        for _ in range(int(_WALL_SECONDS / _LOOK_SECONDS)):
            if not self._process.is_alive():
                raise EOFError
            if self._done.acquire(True, _LOOK_SECONDS):
                return
        raise TimeoutError

    def _exchange(self, message: bytes) -> bytes:
        with self._busy:
            self._head[_WANTED] = _MESSAGE
            try:
                self._asked.release()
                self._connection.send_bytes(message)
                reply = self._receive()
            except _ENDED as error:
                raise self._ended(error) from error
            except BaseException:
                self._end()
                raise
            return _content(reply)

    def _receive(self) -> bytes:
        if not self._connection.poll(_WALL_SECONDS):
            raise TimeoutError
        return self._connection.recv_bytes(_LONGEST_REPLY)

    def _ended(self, error: Exception) -> PolicyError:
        """Return the reason that the other process did not answer."""
        if isinstance(error, TimeoutError):
            self._end()
            return PolicyError(f"'{self._source}' took over {_WALL_SECONDS} s for one step and was ended")
        return PolicyError(f"'{self._source}' {self._how_it_ended()}")

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


def _content(reply: bytes) -> bytes:
    """Return the content of an answer; raise ``PolicyError`` with the answer's words where the program failed."""
    if reply[:1] != _FINE:
        raise PolicyError(reply[1:].decode("utf-8", errors="replace"))
    return reply[1:]


@dataclass(frozen=True)
class ChildSession:
    """A session in the process of a program, as its owner knows it."""

    number: int
    numbers: _Numbers


def _shared_memory() -> tuple[Any, Any]:
    """Return memory that both processes see: for the owner, and as it is handed to the other one."""
    if CONTEXT.get_start_method() == "fork":
        memory = mmap.mmap(-1, _HEAD_BYTES + _ROOM)
        return memory, memory
    arena = Arena(_HEAD_BYTES + _ROOM)
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
    """Run the process from its start to its end."""
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
    head = _head(memory)
    program: Program | None = None
    sessions: dict[int, tuple[PolicySession, _Numbers]] = {}
    allow_seconds(STEP_SECONDS)
    allowed = time.monotonic()
    core = 0
    while True:
        asked.acquire()
        if time.monotonic() > allowed + 1.0:  # three system calls, which not every control step has to make
            allow_seconds(STEP_SECONDS + 1)
            allowed = time.monotonic()
        wanted = head[_WANTED]
        if wanted == _MESSAGE:
            message = connection.recv_bytes()
            try:
                if program is None:
                    program = make(message, source)
                    answer: Any = None
                else:
                    answer = _answer(program, sessions, memory, json.loads(message))
                reply = _FINE + json.dumps(answer).encode()
            except Exception as error:  # noqa: BLE001  (whatever it is, the owner has to hear of it)
                reply = _FAILED + _reason(error, source)
            connection.send_bytes(reply)
            if program is None:
                return
            continue
        if core != head[_CORE]:
            core = head[_CORE]
            with suppress(OSError):
                os.sched_setaffinity(0, (core - 1,))
        session, numbers = sessions[head[_SESSION]]
        try:
            if wanted == _STEP_AFTER_RESET:
                session.reset(numbers.forget.clone())
            # a copy: a program may keep what it is given
            numbers.action.copy_(session.act(numbers.observation.clone()))
        except Exception as error:  # noqa: BLE001  (likewise)
            head[_FAILS] = True
            done.release()
            connection.send_bytes(_FAILED + _reason(error, source))
        else:
            head[_FAILS] = False
            done.release()


def _reason(error: Exception, source: str) -> bytes:
    """Return the reason that the program failed, for its owner."""
    if isinstance(error, PolicyError):
        reason = str(error)
    elif isinstance(error, MemoryError):
        reason = f"'{source}' needs over {MEMORY // 2**20} MiB of memory, the most that it gets"
    else:
        reason = f"'{source}' failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return reason.encode(errors="backslashreplace")


def _answer(
    program: Program, sessions: dict[int, tuple[PolicySession, _Numbers]], memory: Any, request: dict[str, Any]
) -> Mapping[str, Any]:
    if request["do"] != "session":
        return program.answer(request)
    for number in request["dropped"]:
        sessions.pop(number, None)
    made = program.session(request["rows"], rowwise=request["rowwise"])
    number = max(sessions, default=0) + 1
    sessions[number] = made, _Numbers(memory, request["rows"], request["width"], request["joints"])
    return {"number": number}
