"""What a locked process may still ask of the kernel: itself, and nothing of other processes, keys, mounts and clocks."""

import ctypes
import os
import platform
import sys

import pytest
from gaitgauge.files.cell import CONTEXT, lock

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="numbers of system calls of x86-64 Linux"
)
EPERM = 1
CALLS = {
    "limits of the owner": (302, "owner", 7, 0, 0),
    "limits of another process": (302, 1, 7, 0, 0),
    "cores of the owner": (203, "owner", 0, 0),
    "signal to the owner": (62, "owner", 0),
    "signal to the group": (62, 0, 0),
    "signal to a thread of the owner": (234, "owner", "owner", 0),
    "priorities": (141, 99, 0, 0),
    "keys": (248, 0, 0, 0, 0, 0),
    "another's key": (250, 9999, 0, 0),
    "mounts": (165, 0, 0, 0, 0, 0),
    "newer mounts": (430, 0, 0),
    "another root": (161, 0),
    "the clock": (227, 0, 0),
    "the clock's rate": (159, 0),
    "the machine's name": (170, 0, -1),
    "a namespace": (272, 0),
    "another's files": (438, -1, 0, 0),
}
"""Numbers and arguments that do nothing even where they are allowed: a test changes no process but its own, and no kernel."""


def ask(connection, owner):
    """Make the calls in a locked process and send the errors."""
    libc = ctypes.CDLL(None, use_errno=True)
    held = lock()
    errors = {}
    for name, (number, *arguments) in CALLS.items():
        ctypes.set_errno(0)
        libc.syscall(number, *[owner if argument == "owner" else argument for argument in arguments])
        errors[name] = ctypes.get_errno()
    own = libc.syscall(302, 0, 7, 0, 0), libc.syscall(234, os.getpid(), os.getpid(), 0)
    connection.send((held, errors, own))


def test_a_locked_process_reaches_nothing_but_itself():
    mine, theirs = CONTEXT.Pipe()
    process = CONTEXT.Process(target=ask, args=(theirs, os.getpid()))
    process.start()
    assert mine.poll(30)
    held, errors, own = mine.recv()
    process.join()
    if "seccomp" not in held:
        pytest.skip("this kernel has no seccomp")
    assert {name: error for name, error in errors.items() if error != EPERM} == {}
    assert own == (0, 0)
