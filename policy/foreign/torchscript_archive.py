"""TorchScript archives read as data: the tree of objects and the source of their methods, nothing of it executed."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from ..native import PROGRAM_ERRORS
from .batched_program import MOST_ELEMENTS, NotUnderstoodError
from .fence.archive import read_archive as read_records
from .fence.pickles import REBUILD_TENSOR, Call, Name, Storage, read_pickle, stored_tensor

MOST_SOURCE = 1 << 20
"""Of one file of code."""
_KINDS = ("build_intlist", "build_doublelist", "build_boollist", "build_tensorlist", "restore_type_tag")
_PLAIN = frozenset(f"torch.jit._pickle {kind}" for kind in _KINDS)
"""Calls that only say of which type their first argument is."""


@dataclass(eq=False)
class ScriptObject:
    """An instance of one of the archive's classes."""

    qualified_name: str
    """Of its class, ``__torch__.`` first."""
    state: dict[str, Any]
    """Attributes by name."""


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
        parts = self.parts().values()
        made = {id(part): ScriptObject(part.qualified_name, {}) for part in parts}
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
        return _Reader(read_records(data, source="the file")).read()
    except (SyntaxError, *PROGRAM_ERRORS) as error:
        raise NotUnderstoodError(f"its archive cannot be read as data ({type(error).__name__})") from error


class _Reader:
    """One archive that is being read: plain data, tensors and instances of its own classes; nothing else has a name."""

    def __init__(self, records: Mapping[str, bytes]) -> None:
        self._records = records
        self._elements = 0
        self._storages: dict[tuple[str, torch.dtype], torch.Tensor] = {}
        self._origin: dict[int, str] = {}  # of each tensor, the record that it was copied from

    def read(self) -> Archive:
        if self._records.get("byteorder", b"little") != b"little":
            raise NotUnderstoodError("its numbers are stored in another byte order")
        root = self._unpickled("data")
        constants = self._unpickled("constants") if "constants.pkl" in self._records else ()
        if not isinstance(root, ScriptObject) or not isinstance(constants, tuple):
            raise NotUnderstoodError("it holds no module")
        read = Archive(memory=ObjectTree(root), constants=constants)
        for name, source in sorted(self._records.items()):
            if name.startswith("code/") and name.endswith(".py"):
                if len(source) > MOST_SOURCE:
                    raise NotUnderstoodError("its code is longer than that of a policy")
                module = name.removeprefix("code/").removesuffix(".py").replace("/", ".")
                self._declare(read, module, source.decode())
        places: dict[str, list[tuple[str, str]]] = {}
        for path, part in read.memory.parts().items():
            if "__setstate__" in read.methods.get(part.qualified_name, {}):
                raise NotUnderstoodError(f"'{part.qualified_name}' restores itself in a way of its own")
            if "training" in part.state:
                part.state["training"] = False
            for name, value in part.state.items():
                if isinstance(value, torch.Tensor):
                    places.setdefault(self._origin[id(value)], []).append((path, name))
        read.shared = frozenset(p for group in places.values() if len(group) > 1 for p in group)
        return read

    def _declare(self, read: Archive, module: str, source: str) -> None:
        for statement in ast.parse(source).body:
            if isinstance(statement, ast.FunctionDef):
                read.functions[f"{module}.{statement.name}"] = statement
            elif isinstance(statement, ast.ClassDef):
                methods = {s.name: s for s in statement.body if isinstance(s, ast.FunctionDef)}
                read.methods[f"{module}.{statement.name}"] = methods

    def _unpickled(self, folder: str) -> Any:
        made: dict[int, Any] = {}  # what stands in several places is one thing there

        def value(stored: Any) -> Any:
            if not isinstance(stored, Call | Name | Storage | dict | list | tuple):
                return stored
            if id(stored) not in made:
                made[id(stored)] = unfolded(stored)
            return made[id(stored)]

        def unfolded(stored: Any) -> Any:
            if isinstance(stored, Call):
                return called(stored, stored.function.name)
            if isinstance(stored, dict):
                return {key: value(entry) for key, entry in stored.items()}
            if isinstance(stored, list | tuple):
                return type(stored)(value(entry) for entry in stored)
            raise NotUnderstoodError(f"it stores a '{stored.name if isinstance(stored, Name) else stored.kind}'")

        def called(call: Call, name: str) -> Any:
            if name.startswith("__torch__"):
                qualified, state = name.replace(" ", "."), value(call.state)
                if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
                    raise NotUnderstoodError(f"'{qualified}' restores itself in a way of its own")
                return ScriptObject(qualified, state)
            if name == REBUILD_TENSOR:
                return self._tensor(call, folder)
            if name in _PLAIN:
                return value(call.arguments[0])
            raise NotUnderstoodError(f"it stores a '{name.replace(' ', '.')}'")

        return value(read_pickle(self._records[f"{folder}.pkl"], source="the file").value)

    def _tensor(self, call: Call, folder: str) -> torch.Tensor:
        stored = stored_tensor(call, source="the file")
        key, dtype = f"{folder}/{stored.storage.key}", stored.storage.dtype
        self._elements += math.prod(stored.shape)
        if self._elements > MOST_ELEMENTS:
            raise NotUnderstoodError("its tensors are larger than those of a policy")
        if (key, dtype) not in self._storages:
            numbers = bytearray(self._records[key])
            storage = torch.frombuffer(numbers, dtype=dtype) if numbers else torch.empty(0, dtype=dtype)
            self._storages[key, dtype] = storage
        storage = self._storages[key, dtype]
        if len(storage) != stored.storage.count:
            raise NotUnderstoodError("a tensor is not as long as it says")
        # a copy: tensors of one storage would change with each other
        tensor = storage.as_strided(stored.shape, stored.stride, stored.offset).clone()
        self._origin[id(tensor)] = key
        return tensor
