"""A registry of parsers, and what every one of them must survive.

A parser is fed what somebody else may have written: its seeds (``tests/fuzz/seeds``), cut, spliced, and with bytes changed. It
may take it or raise an error of this package. Anything else fails the case: an error of another kind, over 20 s, over 2 GB,
a file written outside the case's own folder. To add a parser, call ``register`` in a module named ``fuzz_<room>.py`` here.
"""

from __future__ import annotations

import copy
import json
import math
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from hypothesis import strategies as st

SEEDS = Path(__file__).parent / "seeds"
MOST_SECONDS = 20
MOST_MEMORY = 2 * 10**9
"""What a case may take beyond what the process has at its start [bytes]."""


@dataclass(frozen=True, kw_only=True)
class Parser:
    """Something that reads what others wrote."""

    name: str
    feed: Callable[[bytes, Path], object]
    """Reads the content; the folder is the case's own, empty."""
    seeds: tuple[bytes, ...]
    """Contents that it takes."""
    words: tuple[bytes, ...]
    """What is put in between."""
    json: bool = False
    """Whether contents are JSON, of which values are replaced as well as bytes."""


@dataclass(kw_only=True)
class Tally:
    """What the cases of a parser came to."""

    cases: int = 0
    tracebacks: int = 0
    """Errors that are not the project's own, of time and memory included."""
    slowest: float = 0.0
    """[s]"""
    memory: int = 0
    """Largest that a case took beyond what the process had [bytes]; 0 where the system does not tell."""
    outside: int = 0
    """Files touched outside a case's folder."""


TALLIES: dict[str, Tally] = {}
PARSERS: dict[str, Parser] = {}

_BYTES = (b"\x00", b"\xff", b"\x80", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8, b"\x7f" + b"\xff" * 8)
_TEXTS = (b"null", b"-1", b"1e999", b"nan", b"[" * 2000, b"{" * 2000, b"9" * 400, b"\\ud800", "\u202e\x1b[31m".encode())


def register(
    name: str,
    feed: Callable[[bytes, Path], object],
    *,
    seeds: Sequence[bytes] | None = None,
    words: Sequence[bytes] = (),
    text: bool = False,
    json: bool = False,
) -> None:
    """Add a parser.

    Args:
        name: of the parser, and of the folder of its seeds.
        feed: see ``Parser``.
        seeds: None for the files in ``seeds/<name>``.
        words: of the format, to put in between.
        text: whether the format is a text.
        json: whether it is JSON.
    """
    found = seeds if seeds is not None else [f.read_bytes() for f in sorted((SEEDS / name).iterdir())]
    assert found, f"parser '{name}' has no seeds"
    words = (*words, *(_TEXTS if text or json else _BYTES))
    PARSERS[name] = Parser(name=name, feed=feed, seeds=tuple(found), words=words, json=json)


@st.composite
def contents(draw: Any, parser: Parser) -> bytes:
    """A seed of the parser, changed in up to eight places."""
    data = bytearray(draw(st.sampled_from(parser.seeds)))
    if parser.json and draw(st.booleans()):
        return draw(_trees(bytes(data)))
    for _ in range(draw(st.integers(1, 8))):
        at = int(draw(st.floats(0, 1, exclude_max=True)) * len(data))
        length = draw(st.sampled_from((1, 1, 2, 4, 16, 256)))
        match draw(st.sampled_from(("flip", "set", "insert", "delete", "repeat", "swap", "cut"))):
            case "flip" if data:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "set":
                data[at : at + length] = draw(st.sampled_from(parser.words))
            case "insert":
                data[at:at] = draw(st.sampled_from(parser.words) | st.binary(max_size=16))
            case "delete":
                del data[at : at + length]
            case "repeat":
                data[at:at] = data[at : at + length] * draw(st.integers(1, 50))
            case "swap":
                other = draw(st.sampled_from(parser.seeds))
                begin = int(draw(st.floats(0, 1, exclude_max=True)) * len(other))
                data[at : at + length] = other[begin : begin + length]
            case "cut":
                del data[at:]
    return bytes(data)


_ODD: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1,
    2**31,
    10**9,
    10**30,
    -0.5,
    1e300,
    math.nan,
    math.inf,
    "",
    "x",
    "../../x",
    "[/x]",
)
_ODD += ("\x1b[31m", "\ud800", "9" * 400, [], [[]], {}, {"": {}}, [None] * 3, [0] * 3000, "x" * 100_000)


@st.composite
def _trees(draw: Any, seed: bytes) -> bytes:
    """A JSON text of which up to four values, wherever they stand, are others, gone, or put into lists."""
    tree = json.loads(seed)
    for _ in range(draw(st.integers(1, 4))):
        table, key = None, None
        node = tree
        while isinstance(node, dict | list) and node and (table is None or draw(st.integers(0, 3))):
            table, key = node, draw(st.sampled_from(sorted(node) if isinstance(node, dict) else range(len(node))))
            node = table[key]
        if table is None:
            return json.dumps(draw(st.sampled_from(_ODD))).encode()
        match draw(st.sampled_from(("set", "set", "set", "delete", "list", "rename"))):
            case "set":
                table[key] = copy.deepcopy(draw(st.sampled_from(_ODD)))
            case "delete":
                del table[key]
            case "list":
                table[key] = [node, copy.deepcopy(node)]
            case "rename" if isinstance(table, dict):
                table[draw(st.sampled_from(("x", "", "\x1b[31m", "../x", "1e9")))] = table.pop(key)
    return json.dumps(tree).encode()


def check(parser: Parser, content: bytes) -> None:
    """Feed a parser.

    Raises:
        AssertionError: it did what it must not.
    """
    tally = TALLIES.setdefault(parser.name, Tally())
    tally.cases += 1
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name)
        before, began = _memory(reset=True), time.perf_counter()
        try:
            with _watched(folder) as written, _limits():
                try:
                    parser.feed(content, folder)
                except (ValueError, RuntimeError, OSError) as error:
                    if not _is_ours(error):
                        raise
                    assert str(error).isprintable(), f"not one printable line: {error!r}"
                    assert len(str(error)) < 2000, "a sentence of over 2000 characters"
        except BaseException:
            tally.tracebacks += 1
            raise
        finally:
            tally.slowest = max(tally.slowest, time.perf_counter() - began)
            tally.memory = max(tally.memory, _memory() - before)
            tally.outside += len(written)
        assert not written, f"written outside its folder: {written}"


def _memory(*, reset: bool = False) -> int:
    """Most memory that the process had at once, since its last reset [bytes]."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)


def _is_ours(error: BaseException) -> bool:
    return any(kind.__module__.startswith("gaitgauge.") for kind in type(error).__mro__)


class TooLongError(BaseException):
    """A case took over ``MOST_SECONDS``; no error that anybody catches."""


def _too_long(number: int, frame: FrameType | None) -> None:
    raise TooLongError(f"over {MOST_SECONDS} s")


@contextmanager
def _limits() -> Iterator[None]:
    """Limits of time and memory."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    statm = Path("/proc/self/statm")
    if statm.exists():
        resource.setrlimit(
            resource.RLIMIT_AS, (int(statm.read_text().split()[0]) * resource.getpagesize() + MOST_MEMORY, hard)
        )
    before = signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(MOST_SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


_watch: tuple[Path, list[str], int] | None = None
_CHANGES = {"os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod"}
_CHANGES |= {"os.chown", "os.utime", "shutil.move", "shutil.rmtree", "shutil.copyfile", "os.system", "subprocess.Popen"}


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _watch is None or os.getpid() != _watch[2]:
        return  # a process of a foreign program is locked up by the system itself
    if event == "open":
        path, mode, flags = arguments
        changes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        if not changes and not (isinstance(mode, str) and set(mode) & set("wax+")):
            return
    elif event in _CHANGES:
        path = arguments[0]
    else:
        return
    folder, written, _ = _watch
    if isinstance(path, int) or str(path) == os.devnull or Path(os.fsdecode(path)).name.startswith("torchinductor_"):
        return  # the last is a folder of torch's own, which it makes when it records a network
    if not Path(os.fsdecode(path)).absolute().is_relative_to(folder):
        written.append(f"{event} {path}")


sys.addaudithook(_hook)


@contextmanager
def _watched(folder: Path) -> Iterator[list[str]]:
    """Lists what is written outside a folder meanwhile."""
    global _watch
    written: list[str] = []
    _watch = (folder, written, os.getpid())
    try:
        yield written
    finally:
        _watch = None
