"""Reads the pickles inside torch's archives without running anything: names stay names, calls stay calls.

Of the pickle machine only what torch writes is understood. Numbers of a tensor are looked at before anything is allocated:
how much it occupies, and whether its storage is there and large enough.
"""

from __future__ import annotations

import math
import pickletools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ...base import PolicyError
from .archive import LARGEST_FILE

MOST_OPERATIONS = 2_000_000
"""Most operations of one pickle."""

REBUILD_TENSOR = "torch._utils _rebuild_tensor_v2"
"""The call that makes a dense tensor."""
REBUILD_QUANTIZED = "torch._utils _rebuild_qtensor"
"""The call that makes a quantized one, with the same arguments first."""

STORAGES: Mapping[str, torch.dtype] = {
    "torch DoubleStorage": torch.float64,
    "torch FloatStorage": torch.float32,
    "torch HalfStorage": torch.float16,
    "torch BFloat16Storage": torch.bfloat16,
    "torch LongStorage": torch.int64,
    "torch IntStorage": torch.int32,
    "torch ShortStorage": torch.int16,
    "torch CharStorage": torch.int8,
    "torch ByteStorage": torch.uint8,
    "torch BoolStorage": torch.bool,
    "torch QInt8Storage": torch.qint8,
    "torch QUInt8Storage": torch.quint8,
    "torch QInt32Storage": torch.qint32,
    "torch ComplexFloatStorage": torch.complex64,
    "torch ComplexDoubleStorage": torch.complex128,
}
"""Type of the entries by the name of their storage's class."""


@dataclass(frozen=True, eq=False)
class Name:
    """A class or function, by the words a pickle gives: module, blank, name."""

    name: str


@dataclass(frozen=True, eq=False)
class Call:
    """A function that would be called, or a class that would be built."""

    function: Name
    arguments: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Storage:
    """The memory of tensors: a record of the archive."""

    kind: str
    key: str
    count: int
    """Entries."""

    @property
    def dtype(self) -> torch.dtype:
        """Return the type of an entry."""
        return STORAGES[self.kind]


class PickleError(PolicyError):
    """A pickle holds what torch does not write."""


_MARK = object()


@dataclass(frozen=True, eq=False)
class Reading:
    """Hold the content of a pickle."""

    names: tuple[str, ...]
    """All names it mentions."""
    calls: tuple[Call, ...]
    """All calls that it would make."""


def read_pickle(data: bytes, *, source: str) -> Reading:
    """Read a pickle without running it.

    Raises:
        PolicyError: it is damaged or holds an operation that torch's files have no use for.
    """
    try:
        return _Machine(source).run(pickletools.genops(data))
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, UnicodeError, OverflowError) as error:
        if isinstance(error, PolicyError):
            raise
        raise PickleError(f"'{source}' holds a damaged pickle: {error}") from error


class _Machine:
    def __init__(self, source: str) -> None:
        self._source = source
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}
        self._names: list[str] = []
        self._calls: list[Call] = []

    def run(self, operations: Iterator[Any]) -> Reading:
        for number, (operation, argument, _) in enumerate(operations):
            if number > MOST_OPERATIONS:
                raise PickleError(f"'{self._source}' holds a pickle of over {MOST_OPERATIONS:,} operations")
            if operation.name == "STOP":
                self._stack.pop()  # its object; a pickle without one is damaged
                return Reading(names=tuple(self._names), calls=tuple(self._calls))
            step = _STEPS.get(operation.name)
            if step is None:
                raise PickleError(f"'{self._source}' holds the pickle operation {operation.name}, and was not loaded")
            step(self, argument)
        raise PickleError(f"'{self._source}' holds a truncated pickle")

    # ---- operations ----

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def above_mark(self) -> list[Any]:
        for at in range(len(self._stack) - 1, -1, -1):
            if self._stack[at] is _MARK:
                values = self._stack[at + 1 :]
                del self._stack[at:]
                return values
        raise PickleError(f"'{self._source}' holds a damaged pickle: a mark is missing")

    def top_tuple(self, count: int) -> None:
        values = tuple(self._stack[-count:])
        del self._stack[-count:]
        self.push(values)

    def name(self, words: str) -> None:
        self._names.append(words)
        self.push(Name(words))

    def stack_name(self, _: Any) -> None:
        name, module = self._stack.pop(), self._stack.pop()
        self.name(f"{module} {name}")

    def call(self, _: Any) -> None:
        arguments, function = self._stack.pop(), self._stack.pop()
        if not isinstance(function, Name) or not isinstance(arguments, tuple):
            raise PickleError(f"'{self._source}' holds a pickle that calls what it computed, and was not loaded")
        made = Call(function, arguments)
        self._calls.append(made)
        self.push(made)

    def build(self, _: Any) -> None:
        self._stack.pop()
        if not isinstance(self._stack[-1], Call):
            raise PickleError(f"'{self._source}' holds a pickle that gives plain data a state, and was not loaded")

    def persistent(self, _: Any) -> None:
        identity = self._stack.pop()
        kind, cls, key, _place, count = identity if isinstance(identity, tuple) else [identity] * 5
        if kind != "storage" or not isinstance(cls, Name) or cls.name not in STORAGES or not isinstance(key, str):
            shown = cls.name if isinstance(cls, Name) else "no storage"
            raise PickleError(f"'{self._source}' holds a storage of an unknown kind ({shown})")
        if not _whole(count) or count < 0:
            raise PickleError(f"'{self._source}' holds a storage with a size that is no number")
        self.push(Storage(cls.name, key, count))

    def set_items(self, pairs: list[Any]) -> None:
        target = self._stack[-1]
        if isinstance(target, Call):
            return
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            # a key may be what a call makes; nothing here depends on it being found again
            target[key if isinstance(key, (str, int, float, bool, type(None))) else id(key)] = value

    def set_item(self, _: Any) -> None:
        value, key = self._stack.pop(), self._stack.pop()
        self.set_items([key, value])

    def extend(self, values: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, Call):
            target.extend(values)

    def keep(self, index: int | None) -> None:
        self._memo[len(self._memo) if index is None else index] = self._stack[-1]

    def recall(self, index: int) -> None:
        self.push(self._memo[index])


_STEPS: dict[str, Any] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda m, a: None),
    "MARK": lambda m, a: m.push(_MARK),
    "POP": lambda m, a: m._stack.pop(),
    "NONE": lambda m, a: m.push(None),
    "NEWTRUE": lambda m, a: m.push(True),
    "NEWFALSE": lambda m, a: m.push(False),
    "EMPTY_TUPLE": lambda m, a: m.push(()),
    "EMPTY_DICT": lambda m, a: m.push({}),
    **dict.fromkeys(("EMPTY_LIST", "EMPTY_SET"), lambda m, a: m.push([])),
    **dict.fromkeys(("APPENDS", "ADDITEMS"), lambda m, a: m.extend(m.above_mark())),
    "TUPLE": lambda m, a: m.push(tuple(m.above_mark())),
    "TUPLE1": lambda m, a: m.top_tuple(1),
    "TUPLE2": lambda m, a: m.top_tuple(2),
    "TUPLE3": lambda m, a: m.top_tuple(3),
    "GLOBAL": lambda m, a: m.name(a),
    "STACK_GLOBAL": _Machine.stack_name,
    **dict.fromkeys(("REDUCE", "NEWOBJ"), _Machine.call),
    "BUILD": _Machine.build,
    "BINPERSID": _Machine.persistent,
    "SETITEM": _Machine.set_item,
    "SETITEMS": lambda m, a: m.set_items(m.above_mark()),
    "APPEND": lambda m, a: m.extend([m._stack.pop()]),
    "MEMOIZE": lambda m, a: m.keep(None),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), _Machine.keep),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _Machine.recall),
    **dict.fromkeys(("BININT", "BININT1", "BININT2", "LONG1", "INT", "LONG", "BINFLOAT", "FLOAT"), _Machine.push),
    **dict.fromkeys(("BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "UNICODE"), _Machine.push),
    **dict.fromkeys(("BINBYTES", "SHORT_BINBYTES", "BINSTRING", "SHORT_BINSTRING"), _Machine.push),
}


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _stored_tensor(call: Call, source: str) -> tuple[Storage, tuple[int, ...]]:
    """Return a described tensor's storage and shape; raise ``PolicyError`` where they are malformed or do not fit each other."""
    if len(call.arguments) < 4:
        raise PickleError(f"'{source}' holds a malformed tensor")
    storage, offset, shape, stride = call.arguments[:4]
    lists = isinstance(shape, tuple) and isinstance(stride, tuple)
    if not isinstance(storage, Storage) or not lists or len(shape) != len(stride) or len(shape) > 64:
        raise PickleError(f"'{source}' holds a malformed tensor")
    if not all(_whole(n) and 0 <= n < 2**48 for n in (offset, *shape, *stride)):
        raise PickleError(f"'{source}' holds a tensor of impossible shape")
    last = offset + sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
    if 0 not in shape and last >= storage.count:
        raise PickleError(
            f"'{source}' holds a tensor of shape {list(shape)} that reaches beyond its {storage.count} stored entries"
        )
    return storage, shape


def check_tensors(calls: Iterator[Call], sizes: Mapping[str, int], *, source: str) -> None:
    """Check that every tensor of an archive is there, and that all of them together fit.

    Args:
        calls: those that make tensors.
        sizes: of the archive's records of tensors by key [bytes].

    Raises:
        PolicyError: a tensor's storage is missing or too short, or spelled out all tensors occupy over ``LARGEST_FILE``.
    """
    total = 0
    for call in calls:
        storage, shape = _stored_tensor(call, source)
        if sizes.get(storage.key, -1) < storage.count * storage.dtype.itemsize:
            raise PickleError(f"'{source}' lacks the weights that it lists: record '{storage.key}' is missing or short")
        total += math.prod(shape) * storage.dtype.itemsize
        if total > LARGEST_FILE:
            raise PickleError(
                f"'{source}' holds tensors of over {LARGEST_FILE // 2**20} MiB once they are spelled out; "
                "that is the most that is read"
            )
