"""TorchScript archives read as data: the tree of objects and the source of their methods, nothing of it executed."""

from __future__ import annotations

import ast
import io
import pickle
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from .program import MOST_ELEMENTS, NotUnderstoodError

MOST_BYTES = 1 << 28
"""Of all that is read of an archive, once it is unpacked."""
MOST_SOURCE = 1 << 20
"""Of one file of code."""
_STORAGES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}


class ScriptObject:
    """An instance of one of the archive's classes."""

    qualified_name: str = ""
    """Of its class, ``__torch__.`` first."""

    state: dict[str, Any]
    """Attributes by name."""

    def __setstate__(self, state: Any) -> None:
        """Take over what the archive stored, as unpickling does.

        Raises:
            NotUnderstoodError: that is no table of attributes, because the class has a method to read it.
        """
        if not isinstance(state, dict) or not all(isinstance(k, str) for k in state):
            raise NotUnderstoodError(f"'{self.qualified_name}' restores itself in a way of its own")
        self.state = state


class ObjectTree:
    """A module with all that it holds."""

    def __init__(self, root: ScriptObject) -> None:
        self.root = root

    def parts(self) -> dict[str, ScriptObject]:
        """The module under an empty name, and all below it by dotted paths."""
        found: dict[str, ScriptObject] = {}
        waiting, seen = [("", self.root)], set()
        while waiting:
            path, part = waiting.pop()
            if id(part) not in seen:
                seen.add(id(part))
                found[path] = part
                below = [(n, v) for n, v in part.state.items() if isinstance(v, ScriptObject)]
                waiting += [(f"{path}.{name}" if path else name, value) for name, value in below]
        return found

    def tensors(self) -> dict[tuple[str, str], torch.Tensor]:
        """All tensors by the path of their module and their name in it."""
        parts = self.parts().items()
        return {(p, n): v for p, part in parts for n, v in part.state.items() if isinstance(v, torch.Tensor)}

    def place(self, where: tuple[str, str], value: torch.Tensor) -> None:
        """Put a tensor in the place of another."""
        self.parts()[where[0]].state[where[1]] = value

    def copy(self, tensor: Callable[[torch.Tensor], torch.Tensor] | None = None) -> ObjectTree:
        """New modules with the same values, tensors passed through a function."""
        made: dict[int, ScriptObject] = {}
        parts = self.parts().values()
        for part in parts:
            made[id(part)] = type(part)()
            made[id(part)].state = {}
        for part in parts:
            for name, value in part.state.items():
                if isinstance(value, ScriptObject):
                    value = made[id(value)]
                elif isinstance(value, torch.Tensor) and tensor is not None:
                    value = tensor(value)
                made[id(part)].state[name] = value
        return ObjectTree(made[id(self.root)])


@dataclass(kw_only=True)
class Archive:
    """What an archive holds."""

    memory: ObjectTree
    """The module, not yet reset, in evaluation mode."""
    constants: tuple[Any, ...]
    """``CONSTANTS.c0`` and on."""
    shared: frozenset[tuple[str, str]] = frozenset()
    """Places of tensors that have their numbers in common with others."""
    methods: dict[str, dict[str, ast.FunctionDef]] = field(default_factory=dict)
    """Methods of each class by its qualified name."""
    functions: dict[str, ast.FunctionDef] = field(default_factory=dict)
    """Functions by their qualified names."""


def read_archive(data: bytes) -> Archive:
    """Read a TorchScript file.

    Raises:
        NotUnderstoodError: it holds something else than plain data, tensors, modules and code, or is damaged.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _Reader(archive).read()
    except (
        zipfile.BadZipFile,
        zlib.error,
        pickle.UnpicklingError,
        SyntaxError,
        UnicodeDecodeError,
        EOFError,
        OSError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        RuntimeError,
        RecursionError,
        MemoryError,
    ) as error:
        raise NotUnderstoodError(f"its archive cannot be read as data ({type(error).__name__})") from error


class _Reader:
    """One archive that is being read."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        names = archive.namelist()
        self._folder = next(n for n in names if n.endswith("/data.pkl"))[: -len("data.pkl")]
        self._names = set(names)
        self._room = MOST_BYTES
        self._kept: list[_Unpickler] = []  # so that no two objects have one id
        self._origin: dict[int, int] = {}  # of each tensor, the storage that it was copied from

    def read(self) -> Archive:
        if self._folder + "byteorder" in self._names and self._bytes("byteorder") != b"little":
            raise NotUnderstoodError("its numbers are stored in another byte order")
        root = self._unpickled("data")
        constants = self._unpickled("constants") if self._folder + "constants.pkl" in self._names else ()
        if not isinstance(root, ScriptObject) or not isinstance(constants, tuple):
            raise NotUnderstoodError("it holds no module")
        read = Archive(memory=ObjectTree(root), constants=constants)
        prefix = self._folder + "code/"
        for name in sorted(n for n in self._names if n.startswith(prefix) and n.endswith(".py")):
            source = self._bytes(name[len(self._folder) :])
            if len(source) > MOST_SOURCE:
                raise NotUnderstoodError("its code is longer than that of a policy")
            self._declare(read, name[len(prefix) : -len(".py")].replace("/", "."), source.decode())
        places: dict[int, list[tuple[str, str]]] = {}
        for path, part in read.memory.parts().items():
            if "__setstate__" in read.methods.get(part.qualified_name, {}):
                raise NotUnderstoodError(f"'{part.qualified_name}' restores itself in a way of its own")
            if "training" in part.state:
                part.state["training"] = False
            for name, value in part.state.items():
                if isinstance(value, torch.Tensor):
                    places.setdefault(self._origin.get(id(value), id(value)), []).append((path, name))
        read.shared = frozenset(p for group in places.values() if len(group) > 1 for p in group)
        return read

    def _declare(self, read: Archive, module: str, source: str) -> None:
        for statement in ast.parse(source).body:
            if isinstance(statement, ast.FunctionDef):
                read.functions[f"{module}.{statement.name}"] = statement
            elif isinstance(statement, ast.ClassDef):
                methods = {s.name: s for s in statement.body if isinstance(s, ast.FunctionDef)}
                read.methods[f"{module}.{statement.name}"] = methods

    def _bytes(self, name: str) -> bytes:
        info = self._archive.getinfo(self._folder + name)
        self._room -= info.file_size
        if self._room < 0:
            raise NotUnderstoodError("it is larger than a policy")
        return self._archive.read(info)

    def _unpickled(self, name: str) -> Any:
        unpickler = _Unpickler(self._bytes(f"{name}.pkl"), lambda key: self._bytes(f"{name}/{key}"))
        value = unpickler.load()
        self._kept.append(unpickler)
        self._origin.update(unpickler.origin)
        return value


# The one in Python: what it remembers grows with the file, while the one in C makes room for any number that a file names.
class _Unpickler(pickle._Unpickler):
    """Plain data, tensors and instances of the archive's own classes; nothing else has a name."""

    def __init__(self, data: bytes, read: Callable[[str], bytes]) -> None:
        super().__init__(io.BytesIO(data))
        self._read = read
        self._storages: dict[str, torch.Tensor] = {}
        self._elements = 0
        self.origin: dict[int, int] = {}

    def find_class(self, module: str, name: str) -> Any:
        if module.startswith("__torch__"):
            return type("ScriptClass", (ScriptObject,), {"qualified_name": f"{module}.{name}"})
        found = {
            ("torch._utils", "_rebuild_tensor_v2"): self._tensor,
            ("torch._utils", "_rebuild_tensor"): self._tensor,
            ("collections", "OrderedDict"): OrderedDict,
            ("torch.jit._pickle", "build_intlist"): list,
            ("torch.jit._pickle", "build_doublelist"): list,
            ("torch.jit._pickle", "build_boollist"): list,
            ("torch.jit._pickle", "build_tensorlist"): list,
            ("torch.jit._pickle", "restore_type_tag"): _untagged,
        }.get((module, name))
        if found is None and module == "torch" and name in _STORAGES:
            return name
        if found is None:
            raise NotUnderstoodError(f"it stores a '{module}.{name}'")
        return found

    def persistent_load(self, pid: Any) -> torch.Tensor:
        kind, storage, key, _, count = pid
        if kind != "storage":
            raise NotUnderstoodError(f"it refers to a '{kind}'")
        if key not in self._storages:
            numbers = bytearray(self._read(str(key)))
            dtype = _STORAGES[storage]
            self._storages[key] = torch.frombuffer(numbers, dtype=dtype) if numbers else torch.empty(0, dtype=dtype)
        if len(self._storages[key]) != count or self._storages[key].dtype != _STORAGES[storage]:
            raise NotUnderstoodError("a tensor is not as long as it says")
        return self._storages[key]

    def _tensor(self, storage: torch.Tensor, offset: int, size: Any, stride: Any, *_: Any) -> torch.Tensor:
        size, stride = tuple(size), tuple(stride)
        elements = 1
        for length in size:
            elements *= length
        self._elements += max(elements, 0)
        if min((offset, *size, *stride), default=0) < 0 or self._elements > MOST_ELEMENTS:
            raise NotUnderstoodError("its tensors are larger than those of a policy")
        # a copy: tensors of one storage would change with each other
        tensor = storage.as_strided(size, stride, offset).clone()
        self.origin[id(tensor)] = id(storage)
        return tensor


def _untagged(value: Any, _: str) -> Any:
    return value
