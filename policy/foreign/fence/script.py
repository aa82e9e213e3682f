"""Reads TorchScript files before torch loads them: the operators of their code, and the memory they would allocate.

torch runs code of the file while it loads it (``__setstate__``). So the code is parsed here first, as the part of Python that
it is. Every function that is called, and every word behind a point, has to be one of the archive's own or of a list of
operators; whatever is not is refused by name.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ...base import PolicyError
from .archive import packed, read_archive
from .operators import OPERATORS, PYTHON_NAMES, RECURRENT, TORCH_OPERATORS
from .pickles import REBUILD_QUANTIZED, REBUILD_TENSOR, Call, check_tensors, read_pickle

MOST_CODE = 8 * 2**20
"""Most code of a file [characters]."""
CONTRACT_FILE = "contract.json"
RESET_METHODS = ("reset", "reset_memory")
"""Methods with which an export forgets."""
LONGEST_CONTRACT = 1_000_000

_OWN = "__torch__"
# Classes of torch's own that are no code of the archive, but for the weights of quantized linear layers.
_CUSTOM_CLASS = re.compile(r"__torch__\.torch\.classes\b(?!\.quantized\.LinearPackedParamsBase$)")
_PLAIN_NAMES = re.compile(
    r"torch\.jit\._pickle (build_(int|double|bool|tensor)list|restore_type_tag)|collections OrderedDict|torch (\w+)Storage"
    r"|torch\._utils _rebuild_(tensor_v2|qtensor)|torch device|builtins complex|torch per_(tensor|channel)_affine"
)
# What torch loads of an archive. It finds a name in whatever case that stands there, so that only these names are handed on.
_RECORDS = re.compile(
    r"data\.pkl|constants\.pkl|(data|constants)/[^/]+|code/[\w/.]+\.py|version|byteorder|\.data/(version|serialization_id)",
    re.ASCII,
)
# Written by hand, code may differ in how Python and torch read it; what torch itself writes has none of these.
_STRANGE = re.compile(r"[^\n\x20-\x7e]|\\\n")
# The words that torch's code has for a module's attributes, its types, and numbers that are none.
_TORCH_CONSTANTS = frozenset({"float", "int", "bool", "device", "dtype", "layout"})
# Names with a meaning of their own in TorchScript: no variable may take it away, and what starts tasks is not called.
_RESERVED = frozenset({"torch", "ops", "CONSTANTS", _OWN, "fork", "awaitable", "annotate", "uninitialized", "getattr"})
# Methods that torch calls by itself.
_OWN_METHODS = frozenset({"forward", "__init__", "__getstate__", "__setstate__", "__enter__", "__exit__"})


@dataclass(frozen=True, kw_only=True)
class ScriptFile:
    """Hold a TorchScript file after its code has been read."""

    data: bytes
    """The archive to load: what was read, and nothing else."""
    contract: str
    """JSON text of the contract that it carries, empty for none."""
    attributes: frozenset[str]
    """Names of all attributes that its classes declare."""


def check_script(data: bytes, *, source: str) -> ScriptFile:
    """Read a TorchScript file, and refuse it if it could do anything but compute.

    Raises:
        PolicyError: it is damaged, too large, or uses what is not on the list of operators; the message names that.
    """
    records = read_archive(data, source=source)
    code = {name: content for name, content in records.items() if name.startswith("code/") and name.endswith(".py")}
    if sum(map(len, code.values())) > MOST_CODE:
        raise PolicyError(f"'{source}' holds over {MOST_CODE // 2**20} MiB of code, the most that is read")
    trees = {name: _parsed(content, name, source) for name, content in code.items()}
    _check_code(trees, source)
    for name in ("data", "constants"):
        _check_pickle(records, name, source)
    contract = records.get(f"extra/{CONTRACT_FILE}", b"")
    if len(contract) > LONGEST_CONTRACT:
        raise PolicyError(f"'{source}' carries a contract of over {LONGEST_CONTRACT:,} characters")
    attributes = frozenset(_attributes(trees.values()))
    kept = {name: content for name, content in records.items() if _RECORDS.fullmatch(name)}
    return ScriptFile(data=packed(kept), contract=contract.decode("utf-8", errors="replace"), attributes=attributes)


def _parsed(content: bytes, name: str, source: str) -> ast.Module:
    text = content.decode("latin-1")  # whatever is no ASCII is strange
    if _STRANGE.search(text):
        raise PolicyError(f"'{source}' holds code with characters that torch does not write, in '{name}'")
    try:
        return ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise PolicyError(f"'{source}' holds code that cannot be read, in '{name}'") from error


def _check_code(trees: Mapping[str, ast.Module], source: str) -> None:
    methods = set(_OWN_METHODS)
    for tree in trees.values():
        methods.update(node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    # a method of the archive's own by the name of an operator would let that operator through
    operators = {name for name in methods - TORCH_OPERATORS if torch._C._jit_get_schemas_for_operator(f"aten::{name}")}
    _check_setstate(trees, source)
    for name, tree in trees.items():
        variables = {
            node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        }
        variables |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
        checker = _Checker(frozenset(methods - operators), source, name)
        if taken := sorted(variables & _RESERVED):
            checker.refuse(f"a variable named {taken[0]}")
        try:
            checker.visit(tree)
        except RecursionError as error:
            raise PolicyError(f"'{source}' holds code that is nested too deeply, in '{name}'") from error


class _Checker(ast.NodeVisitor):
    """Walk through a file's code and refuse whatever is not expected."""

    def __init__(self, methods: frozenset[str], source: str, file: str) -> None:
        self._methods, self._functions = methods, frozenset[str]()
        self._source, self._file = source, file

    def refuse(self, what: str) -> None:
        raise PolicyError(
            f"'{self._source}' was not loaded: its code uses {what}, which is not on the list of tensor operators "
            f"(in '{self._file}')"
        )

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            if not alias.name.startswith(f"{_OWN}.") or alias.asname is not None:
                self.refuse(f"import {alias.name}")

    def visit_Attribute(self, node: ast.Attribute) -> None:
        """Check a name: a chain that begins at ``torch``, ``ops`` or the archive's own classes is one, any other is a value's."""
        words = _words(node)
        if words is None:
            self.generic_visit(node)
            return
        dotted = ".".join(words)
        if words[0] == "torch":
            if len(words) != 2 or words[1] not in TORCH_OPERATORS | _TORCH_CONSTANTS:
                self.refuse(dotted)
        elif words[0] == "ops":
            space, name = (words[1], words[2]) if len(words) == 3 else ("", "")
            known = OPERATORS.get(space, frozenset())
            if name not in known:
                self.refuse(dotted)
        elif words[0] == _OWN and _CUSTOM_CLASS.match(dotted):
            self.refuse(dotted)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        """Check that variables that are called are functions of the archive's own, and nothing else in the same function."""
        outside, self._functions = self._functions, _own_functions(node)
        self.generic_visit(node)
        self._functions = outside

    def visit_Call(self, node: ast.Call) -> None:
        function = node.func
        if isinstance(function, ast.Attribute):
            words = _words(function)
            known = words is not None and words[0] in ("torch", "ops", _OWN)  # looked at by visit_Attribute
            if not known and function.attr not in self._methods | TORCH_OPERATORS:
                self.refuse(f"{function.attr}()")
        elif isinstance(function, ast.Name):
            if function.id not in PYTHON_NAMES | self._functions:
                self.refuse(f"{function.id}()")
            if function.id in ("getattr", "hasattr") and not _names_attribute(node):
                self.refuse(f"{function.id}() with a name that it computes")
        else:
            self.refuse("a call of what it computed")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bytes) or getattr(node, "kind", None):
            self.refuse("a text that is none of TorchScript's")

    def generic_visit(self, node: ast.AST) -> None:
        if not isinstance(node, _NODES):
            self.refuse(f"'{type(node).__name__}'")
        super().generic_visit(node)


# fmt: off
_NODES = (
    ast.Module, ast.ClassDef, ast.FunctionDef, ast.arguments, ast.arg, ast.Return, ast.Assign, ast.AugAssign, ast.AnnAssign,
    ast.For, ast.While, ast.If, ast.With, ast.withitem, ast.Raise, ast.Assert, ast.Expr, ast.Pass, ast.Break, ast.Continue,
    ast.Delete, ast.BoolOp, ast.BinOp, ast.UnaryOp, ast.IfExp, ast.Dict, ast.Compare, ast.Call, ast.Constant, ast.Attribute,
    ast.Subscript, ast.Starred, ast.Name, ast.List, ast.Tuple, ast.Slice, ast.Import, ast.alias, ast.keyword, ast.expr_context,
    ast.boolop, ast.operator, ast.unaryop, ast.cmpop,
)
# fmt: on


def _check_setstate(trees: Mapping[str, ast.Module], source: str) -> None:
    """Refuse recurrent operators with packed sequences in what ``__setstate__`` may call: it runs before torch's graph is looked at."""
    functions: dict[str, list[ast.FunctionDef]] = {}
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                functions.setdefault(node.name, []).append(node)
    seen, pending = {"__setstate__"}, ["__setstate__"]
    while pending:
        calls = [n for f in functions.get(pending.pop(), ()) for n in ast.walk(f) if isinstance(n, ast.Call)]
        for call in calls:
            name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            if name in RECURRENT and not _is_plain_recurrent(call):
                raise PolicyError(
                    f"'{source}' was not loaded: its code uses {name}() with packed sequences while it is loaded"
                )
            if name not in seen:
                seen.add(name)
                pending.append(name)


def _is_plain_recurrent(call: ast.Call) -> bool:
    """Return whether a recurrent operator is called with input, state, weights and, as torch writes it, a plain True or False."""
    has_biases = call.args[3] if len(call.args) > 3 and not call.keywords else None
    return isinstance(has_biases, ast.Constant) and isinstance(has_biases.value, bool)


def _words(node: ast.expr) -> list[str] | None:
    """Return the words of a dotted name, None for an attribute of anything else."""
    words = []
    while isinstance(node, ast.Attribute):
        words.append(node.attr)
        node = node.value
    return [node.id, *reversed(words)] if isinstance(node, ast.Name) else None


def _own_functions(function: ast.FunctionDef) -> frozenset[str]:
    """Return variables to which a function assigns classes and functions of the archive, by their names, and nothing else."""
    own: list[ast.Name] = []
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
            words = _words(node.value)
            if words is not None and len(words) > 1 and words[0] == _OWN:
                own.append(node.targets[0])
    places = set(map(id, own))
    others = {
        node.id
        for node in ast.walk(function)
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load) and id(node) not in places
    }
    others |= {node.arg for node in ast.walk(function) if isinstance(node, ast.arg)}
    return frozenset({name.id for name in own} - others)


def _names_attribute(call: ast.Call) -> bool:
    return len(call.args) > 1 and isinstance(call.args[1], ast.Constant) and isinstance(call.args[1].value, str)


def _attributes(trees: Iterable[ast.Module]) -> Iterable[str]:
    """Yield the attributes that the classes declare: ``history : Tensor``, or ``__annotations__["0"] = Tensor`` for what is no name."""
    for tree in trees:
        for made in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
            for line in made.body:
                if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                    yield line.target.id
                elif isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Subscript):
                    key: Any = line.targets[0].slice
                    if isinstance(key, ast.Constant) and isinstance(key.value, str):
                        yield key.value


def _check_pickle(records: Mapping[str, bytes], name: str, source: str) -> None:
    content = records.get(f"{name}.pkl")
    if content is None:
        raise PolicyError(f"'{source}' is a damaged TorchScript file: it has no {name}.pkl")
    reading = read_pickle(content, source=source)
    for words in reading.names:
        dotted = words.replace(" ", ".")
        own = dotted.startswith(f"{_OWN}.") and not _CUSTOM_CLASS.match(dotted)
        if not own and not _PLAIN_NAMES.fullmatch(words):
            raise PolicyError(
                f"'{source}' was not loaded: its data hold '{dotted}', which is neither a tensor nor a module of its own"
            )
    for text in _texts(reading.calls):
        if _CUSTOM_CLASS.search(text):
            raise PolicyError(f"'{source}' was not loaded: its data hold '{text}', a class that is not its own")
    sizes = {key.partition("/")[2]: len(data) for key, data in records.items() if key.startswith(f"{name}/")}
    tensors = (call for call in reading.calls if call.function.name in (REBUILD_TENSOR, REBUILD_QUANTIZED))
    check_tensors(tensors, sizes, source=source)


def _texts(calls: Iterable[Call]) -> Iterable[str]:
    """Yield the texts among the arguments of calls: types are named there."""
    for call in calls:
        yield from (a for a in call.arguments if isinstance(a, str))
