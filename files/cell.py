"""Lock a process before it works on a stranger's file: no file to write, no other program, no network, little memory.

Landlock and seccomp do this on Linux, each as far as the kernel has it; limits on resources hold on every Unix.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import platform
import signal
import struct
import sys
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

MEMORY = 2**30
"""Memory that a locked process may take beyond its memory at the time of locking [bytes]."""
# A forked process has all modules at once; outside Linux, system libraries do not survive a fork.
CONTEXT: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
"""Context that starts the processes to be locked."""

_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _SECCOMP_FILTER = 38, 22, 2
_LANDLOCK_CREATE, _LANDLOCK_ADD, _LANDLOCK_RESTRICT = 444, 445, 446
_LANDLOCK_VERSION, _LANDLOCK_PATH = 1, 1
_READ = 0b1101  # execute (to load a library), read a file, list a folder
# All rights on files that each version of Landlock knows, then those on networks and on processes outside.
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
_NETWORK_RIGHTS, _SCOPES = 0b11, 0b11

_OPENING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_CLONE_THREAD = 0x10000
# Numbers of system calls: first calls with flags to check; calls that may act on this process alone, 0 or by its own number; calls
# that always fail. The latter change files or their names and rights, start programs, open sockets, reach into other processes or
# the kernel, and change limits, users, keys, mounts, clocks and modules.
_SAME_EVERYWHERE = (
    424, 425, 426, 427, 428, 429, 430, 431, 432, 433, 434, 437, 438, 440, 442, 443, 448, 452, 460, 463, 466, 467,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Calls:
    """System calls of one kind of processor."""

    opening: dict[int, int]
    """Calls that open a file, and the place of their flags."""
    itself: tuple[int, ...]
    """Calls whose first argument must be 0 or this process."""
    refused: tuple[int, ...]
    clone: int


# fmt: off
_CALLS = {
    "x86_64": _Calls(
        opening={2: 1, 257: 2},
        itself=(203, 234, 302),  # sched_setaffinity, tgkill, prlimit64
        refused=(29, 41, 53, 57, 58, 59, 62, 64, 68, 76, 82, 83, 84, 85, 86, 87, 88, 90, 91, 92, 93, 94, 101, 103, 105, 106, 109, 112,
         113, 114, 116, 117, 119, 122, 123, 126, 129, 132, 133, 134, 135, 141, 142, 144, 153, 155, 159, 161, 163, 164, 165, 166,
         167, 168, 169, 170, 171, 172, 173, 175, 176, 179, 188, 189, 190, 197, 198, 199, 200, 212, 227, 235, 240, 241, 246, 248,
         249, 250, 251, 256, 258, 259, 260, 261, 263, 264, 265, 266, 268, 272, 279, 280, 297, 298, 300, 303, 304, 305, 308, 310,
         311, 312, 313, 314, 316, 317, 319, 320, 321, 322, 323, *_SAME_EVERYWHERE),
        clone=56,
    ),
    "aarch64": _Calls(
        opening={56: 2},
        itself=(122, 131, 261),
        refused=(5, 6, 7, 14, 15, 16, 30, 33, 34, 35, 36, 37, 38, 39, 40, 41, 45, 51, 52, 53, 54, 55, 58, 60, 88, 89, 91, 92, 97,
         104, 105, 106, 112, 116, 117, 118, 119, 129, 130, 138, 140, 142, 143, 144, 145, 146, 147, 149, 151, 152, 154, 157, 159, 161,
         162, 170, 171, 180, 181, 186, 190, 194, 198, 199, 217, 218, 219, 221, 224, 225, 238, 239, 240, 241, 262, 264, 265, 266,
         268, 270, 271, 272, 273, 274, 276, 277, 279, 280, 281, 282, 294, *_SAME_EVERYWHERE),
        clone=220,
    ),
}
# fmt: on
_CLONE3 = 435
_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_FIRST_FOREIGN_CALL = 0x40000000  # numbers of x86's other set of calls


def enclose(kept: int, owner: int, readable: Iterable[Path] = ()) -> tuple[str, ...]:
    """Lock a process that its owner has just started and that works for this owner alone.

    The process ends with its owner, ignores Ctrl-C (the owner ends it), and keeps none of the owner's files open.

    Args:
        kept: descriptor of the connection with its owner.
        readable: as for ``lock``.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _close_all_but(kept)
    held = lock(readable)
    threading.Thread(target=_watch, args=(owner,), daemon=True).start()
    return held


def _watch(owner: int) -> None:
    """End this process with its owner, even while others hold the connection."""
    while os.getppid() == owner:
        time.sleep(1.0)
    os._exit(0)


def _close_all_but(kept: int) -> None:
    """Close the files, sockets and devices that the owner has open."""
    if sys.platform == "win32":
        return
    os.closerange(3, kept)
    os.closerange(kept + 1, min(os.sysconf("SC_OPEN_MAX"), 65_536))
    nothing = os.open(os.devnull, os.O_RDWR)
    for standard in (0, 1, 2):
        os.dup2(nothing, standard)
    os.close(nothing)


def lock(readable: Iterable[Path] = ()) -> tuple[str, ...]:
    """Lock this thread, and every thread that it starts, for the rest of its life.

    Args:
        readable: folders that may be read, beside those of Python and the system's libraries.

    Returns:
        The locks in force: of ``limits``, ``landlock`` and ``seccomp`` those that this system has.
    """
    held = []
    if resource is not None:
        _limit()
        held.append("limits")
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0:
            if _landlock(libc, [*readable, *_libraries()]):
                held.append("landlock")
            if _seccomp(libc):
                held.append("seccomp")
    if resource is not None and len(held) == 1:
        # Neither landlock nor seccomp is there: then no further file is opened at all.
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    return tuple(held)


def allow_seconds(seconds: int) -> None:
    """Let this process compute for so many seconds from now; the system ends it when they are over."""
    if resource is not None:
        used = resource.getrusage(resource.RUSAGE_SELF)
        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(used.ru_utime + used.ru_stime) + 1 + seconds, hard))


def _limit() -> None:
    # no byte is written to any file, whatever is open
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    status = Path("/proc/self/statm")
    if status.is_file():
        mapped = int(status.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, mapped + MEMORY))


def _libraries() -> list[Path]:
    """Return the folders of Python, its packages and the system's libraries: modules may be loaded late."""
    libraries = ("/usr/lib", "/usr/lib64", "/lib", "/lib64", "/etc/ld.so.cache")
    devices = ("/proc/self", "/proc/cpuinfo", "/sys/devices/system", "/dev/null", "/dev/urandom")
    return [Path(p) for p in (sys.prefix, sys.base_prefix, *libraries, *devices, *sys.path) if p]


def _landlock(libc: ctypes.CDLL, readable: list[Path]) -> bool:
    version = libc.syscall(_LANDLOCK_CREATE, None, 0, _LANDLOCK_VERSION)
    if version < 1:
        return False
    rights = (1 << _FILE_RIGHTS[min(version, 5)]) - 1
    attributes = struct.pack("QQQ", rights, _NETWORK_RIGHTS if version >= 4 else 0, _SCOPES if version >= 6 else 0)
    size = 8 if version < 4 else 16 if version < 6 else 24
    rules = libc.syscall(_LANDLOCK_CREATE, attributes[:size], size, 0)
    if rules < 0:
        return False
    try:
        for path in readable:
            try:
                place = os.open(path, os.O_PATH | os.O_CLOEXEC)
            except OSError:
                continue
            try:
                may = _READ if path.is_dir() else 0b100
                libc.syscall(_LANDLOCK_ADD, rules, _LANDLOCK_PATH, struct.pack("=Qi", may & rights, place), 0)
            finally:
                os.close(place)
        return libc.syscall(_LANDLOCK_RESTRICT, rules, 0) == 0
    finally:
        os.close(rules)


def _seccomp(libc: ctypes.CDLL) -> bool:
    machine = platform.machine()
    if machine not in _CALLS or sys.maxsize < 2**32:
        return False
    calls = _CALLS[machine]
    load, equal, at_least, masked, give = 0x20, 0x15, 0x35, 0x45, 0x06
    kill, deny, absent, allow = 0x80000000, 0x00050000 | 1, 0x00050000 | 38, 0x7FFF0000
    lines: list[tuple[int, int, int, int]] = [
        (load, 0, 0, 4),
        (equal, 1, 0, _ARCHITECTURES[machine]),
        (give, 0, 0, kill),
        (load, 0, 0, 0),
        (at_least, 0, 1, _FIRST_FOREIGN_CALL),
        (give, 0, 0, deny),
        # the C library falls back to the older call, where flags can be checked, if this one does not exist
        (equal, 0, 1, _CLONE3),
        (give, 0, 0, absent),
    ]
    for number in calls.refused:
        lines += [(equal, 0, 1, number), (give, 0, 0, deny)]
    for number, argument in calls.opening.items():
        lines += [(equal, 0, 4, number), (load, 0, 0, 16 + 8 * argument), (masked, 0, 1, _OPENING)]
        lines += [(give, 0, 0, deny), (give, 0, 0, allow)]
    for number in calls.itself:
        lines += [(equal, 0, 5, number), (load, 0, 0, 16), (equal, 2, 0, 0), (equal, 1, 0, os.getpid())]
        lines += [(give, 0, 0, deny), (give, 0, 0, allow)]
    # threads may be started, processes not
    lines += [(equal, 0, 4, calls.clone), (load, 0, 0, 16), (masked, 1, 0, _CLONE_THREAD), (give, 0, 0, deny)]
    lines += [(give, 0, 0, allow), (give, 0, 0, allow)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *line) for line in lines))
    program = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(lines), ctypes.addressof(code)))
    return libc.prctl(_PR_SET_SECCOMP, _SECCOMP_FILTER, program, 0, 0) == 0
