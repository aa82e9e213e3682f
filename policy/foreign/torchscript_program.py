"""The network in a TorchScript file, followed from its code without TorchScript.

The code in an archive is a small part of Python: calls of operators, attributes, and control flow. It is followed with
torch's own operators, those of ``OPERATORS`` and no others. Branches and loops may depend on numbers of the file and on
shapes; one that depends on an observation, or on a number that the module counts up, is not understood, and then the file is
not rebuilt.
"""

from __future__ import annotations

import ast
import copy
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from ..native import PROGRAM_ERRORS
from .batched_program import Budget, NotUnderstoodError, Program, convolution, linear, matmul
from .fence.script import RESET_METHODS
from .torchscript_archive import Archive, ScriptObject, read_archive

_MOST_DEPTH = 50
_MOST_STATEMENTS = 100_000

_OPERATOR_NAMES = """
    abs add add_ addcdiv addcmul addmm baddbmm ceil clamp clamp_ clamp_max clamp_min clip copy_ cos cosh div div_ einsum exp
    fill_ floor frac log log1p lerp maximum minimum mul mul_ neg pow reciprocal relu_ remainder round rsqrt rsub sign sin
    sqrt square sub sub_ tan trunc zero_

    celu elu elu_ gelu glu hardsigmoid hardswish hardtanh leaky_relu log_sigmoid log_softmax mish prelu relu relu6 selu
    sigmoid silu softmax softplus softsign tanh tanh_ batch_norm group_norm layer_norm linalg_vector_norm norm frobenius_norm

    all amax amin any argmax argmin cumsum logsumexp max mean min prod std sum topk var where
    bitwise_and bitwise_not bitwise_or eq ge gt isfinite isnan le logical_and logical_not logical_or lt nan_to_num ne

    alias broadcast_to cat chunk clone concat contiguous detach expand expand_as flatten flip gather hstack index_select
    movedim narrow permute repeat reshape reshape_as roll select slice split split_with_sizes squeeze stack swapaxes t
    tile to transpose type_as unbind unflatten unsqueeze view view_as vstack

    arange eye full full_like new_full new_ones new_zeros ones ones_like scalar_tensor zeros zeros_like
"""
_FRESH = frozenset({"arange", "eye", "full", "ones", "scalar_tensor", "zeros"})
OPERATORS = frozenset(_OPERATOR_NAMES.split())
"""Operators of torch that a program may call; all depend on their arguments alone."""

_SAME_NAMES = "add sub mul floordiv neg eq ne lt le gt ge __not__ __and__ __or__ __getitem__ __contains__"
_NUMBERS: Mapping[str, Callable[..., Any]] = {
    **{name: getattr(operator, name) for name in _SAME_NAMES.split()},
    **{"div": operator.truediv, "remainder": operator.mod, "abs": abs, "len": len, "list": list},
    **{"max": max, "min": min, "prim_max": max, "prim_min": min},
}


def torchscript_program(data: bytes, width: int, *, source: str) -> Program:
    """Follow a TorchScript file's ``forward`` on one observation.

    Args:
        width: entries of an observation.

    Returns:
        The program. Its memories are what ``forward`` changes.

    Raises:
        NotUnderstoodError: it does something that is not known to be a function of the observations alone.
    """
    archive = read_archive(data)
    try:
        with torch.no_grad():
            return _followed(archive, width, source)
    except PROGRAM_ERRORS as error:
        raise NotUnderstoodError(f"its code cannot be followed ({type(error).__name__})") from error


def _followed(archive: Archive, width: int, source: str) -> Program:
    # first without numbers: what does it change, and can it be afforded
    trial = _Machine(archive, torch.device("meta"))
    trial.reset()
    before = trial.memory.tensors()
    versions = {place: value._version for place, value in before.items()}
    trial.forward(torch.zeros(1, width, device="meta"))
    if trial.constants_changed:
        raise NotUnderstoodError("it changes a constant")
    after = trial.memory.tensors()
    changed = [p for p, value in after.items() if value is not before[p] or value._version != versions[p]]
    if any(after[p].shape != before[p].shape or after[p].dtype != before[p].dtype for p in changed):
        raise NotUnderstoodError("it remembers something whose shape changes")
    if not archive.shared.isdisjoint(changed):
        raise NotUnderstoodError("it remembers something under two names")
    fresh = _Machine(archive, torch.device("cpu"))
    fresh.reset()
    values = fresh.memory.tensors()

    def step(observation: torch.Tensor, *memories: torch.Tensor) -> tuple[torch.Tensor, ...]:
        machine = copy.copy(fresh)
        machine.memory = fresh.memory.copy()
        for place, memory in zip(changed, memories, strict=True):
            machine.memory.place(place, memory.clone())
        action = machine.forward(observation)
        kept = machine.memory.tensors()
        return action, *(kept[place] for place in changed)

    return Program(step, [values[place] for place in changed], source=source)


class _Path:
    """A dotted name that is no variable: an operator, or a function of the archive."""

    def __init__(self, name: str) -> None:
        self.name = name


class _Machine:
    """Follows an archive's code."""

    def __init__(self, archive: Archive, device: torch.device) -> None:
        self._archive, self._device = archive, device
        self._budget, self._steps, self._depth = Budget(), _MOST_STATEMENTS, 0
        self._chosen: dict[int, tuple[torch.Tensor, ...]] = {}
        self.memory = archive.memory.copy(self._moved)
        self._constants = tuple(self._moved(c) if isinstance(c, torch.Tensor) else c for c in archive.constants)

    def _moved(self, value: torch.Tensor) -> torch.Tensor:
        moved = value.to(self._device, copy=True)
        if value.dtype == torch.bool:
            # where it is true: a mask that chooses entries must say how many before anything is calculated
            self._chosen[id(moved)] = tuple(i.to(self._device) for i in value.nonzero(as_tuple=True))
        return moved

    @property
    def constants_changed(self) -> bool:
        """Whether an operator has written into a constant."""
        return any(c._version for c in self._constants if isinstance(c, torch.Tensor))

    # ---- what is asked of it --------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Run the module's own reset, if it has one."""
        root = self.memory.root
        for name in RESET_METHODS:
            if name in self._archive.methods.get(root.qualified_name, {}):
                self._method(root, name, [])

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """The action for an observation (1, F), float32 (1, J)."""
        output = self._method(self.memory.root, "forward", [observation])
        while isinstance(output, (tuple, list)) and output:
            output = output[0]
        if not isinstance(output, torch.Tensor) or output.dtype != torch.float32 or not 1 <= output.dim() <= 2:
            raise NotUnderstoodError("its output is no row of actions")
        return output.reshape(1, -1)

    # ---- functions and statements ---------------------------------------------------------------------------------

    def _method(self, on: ScriptObject, name: str, arguments: list[Any]) -> Any:
        methods = self._archive.methods.get(on.qualified_name, {})
        if name not in methods:
            raise NotUnderstoodError(f"it calls '{name}' of a '{on.qualified_name}'")
        return self._call(methods[name], [on, *arguments])

    def _call(self, function: ast.FunctionDef, arguments: list[Any]) -> Any:
        parameters = [a.arg for a in function.args.args]
        defaults = [self._value(d, {}) for d in function.args.defaults]
        missing = len(parameters) - len(arguments)
        if missing < 0 or missing > len(defaults):
            raise NotUnderstoodError(f"it calls '{function.name}' with other arguments than it takes")
        names = dict(zip(parameters, arguments + defaults[len(defaults) - missing :], strict=True))
        self._depth += 1
        if self._depth > _MOST_DEPTH:
            raise NotUnderstoodError("its functions call each other without end")
        result = self._block(function.body, names)
        self._depth -= 1
        return result[0] if result else None

    def _block(self, statements: Sequence[ast.stmt], names: dict[str, Any]) -> tuple[Any] | None:
        """What a ``return`` among the statements returns, as a tuple of one; None if the end was reached."""
        result: tuple[Any] | None = None
        for statement in statements:
            self._count()
            if isinstance(statement, ast.Assign) and len(statement.targets) == 1:
                self._assign(statement.targets[0], self._value(statement.value, names), names)
            elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
                self._assign(statement.target, self._value(statement.value, names), names)
            elif isinstance(statement, ast.Return):
                return (None if statement.value is None else self._value(statement.value, names),)
            elif isinstance(statement, ast.If):
                result = self._block(statement.body if self._truth(statement.test, names) else statement.orelse, names)
            elif isinstance(statement, ast.For) and not statement.orelse:
                for value in self._iterated(self._value(statement.iter, names)):
                    self._count()
                    self._assign(statement.target, value, names)
                    if result := self._block(statement.body, names):
                        break
            elif isinstance(statement, ast.While) and not statement.orelse:
                while self._truth(statement.test, names):
                    self._count()
                    if result := self._block(statement.body, names):
                        break
            elif isinstance(statement, ast.Expr):
                self._value(statement.value, names)
            elif not isinstance(statement, ast.Pass):
                raise NotUnderstoodError(f"its code has a statement of the kind {type(statement).__name__}")
            if result:
                return result
        return None

    def _count(self) -> None:
        self._steps -= 1
        if self._steps < 0:
            raise NotUnderstoodError("its code takes too long")

    def _truth(self, expression: ast.expr, names: dict[str, Any]) -> bool:
        value = self._value(expression, names)
        if not isinstance(value, (bool, int, float)):
            raise NotUnderstoodError("its course depends on what it observes")
        return bool(value)

    def _iterated(self, values: Any) -> Any:
        if not isinstance(values, (range, list, tuple)):
            raise NotUnderstoodError(f"it goes through the parts of a {type(values).__name__}")
        return values

    def _assign(self, target: ast.expr, value: Any, names: dict[str, Any]) -> None:
        if isinstance(target, ast.Name):
            names[target.id] = value
        elif isinstance(target, (ast.Tuple, ast.List)):
            parts = list(value) if isinstance(value, (tuple, list)) else []
            if len(parts) != len(target.elts):
                raise NotUnderstoodError("it takes apart something that has other parts")
            for part, one in zip(target.elts, parts, strict=True):
                self._assign(part, one, names)
        elif isinstance(target, ast.Attribute):
            on = self._value(target.value, names)
            old = on.state.get(target.attr) if isinstance(on, ScriptObject) else None
            if not isinstance(value, torch.Tensor) or not isinstance(old, torch.Tensor):
                raise NotUnderstoodError(f"it changes '{target.attr}', which is no tensor")
            on.state[target.attr] = value
        else:
            raise NotUnderstoodError(f"it assigns to a {type(target).__name__}")

    # ---- expressions ----------------------------------------------------------------------------------------------

    def _value(self, expression: ast.expr, names: dict[str, Any]) -> Any:
        self._count()
        if isinstance(expression, ast.Constant):
            return expression.value
        if isinstance(expression, ast.Name):
            return self._named(expression.id, names)
        if isinstance(expression, ast.Attribute):
            return self._attribute(self._value(expression.value, names), expression.attr)
        if isinstance(expression, ast.Call):
            return self._called(expression, names)
        if isinstance(expression, ast.List):
            return [self._value(e, names) for e in expression.elts]
        if isinstance(expression, ast.Tuple):
            return tuple(self._value(e, names) for e in expression.elts)
        if isinstance(expression, ast.Subscript):
            parts, index = self._value(expression.value, names), self._value(expression.slice, names)
            if isinstance(parts, (list, tuple)) and isinstance(index, int):
                return parts[index]
        if isinstance(expression, ast.UnaryOp) and isinstance(expression.op, (ast.USub, ast.Not)):
            if isinstance(expression.op, ast.Not):
                return not self._truth(expression.operand, names)
            return self._numbers("neg", [self._value(expression.operand, names)])
        if isinstance(expression, ast.IfExp):
            return self._value(expression.body if self._truth(expression.test, names) else expression.orelse, names)
        raise NotUnderstoodError(f"its code has an expression of the kind {type(expression).__name__}")

    def _named(self, name: str, names: dict[str, Any]) -> Any:
        if name in names:
            return names[name]
        if name in ("inf", "nan"):
            return float(name)
        return _Path(name)

    def _attribute(self, on: Any, name: str) -> Any:
        if isinstance(on, _Path):
            if on.name == "CONSTANTS":
                return self._constants[int(name.removeprefix("c"))]
            return _Path(f"{on.name}.{name}")
        if isinstance(on, ScriptObject) and name in on.state:
            return on.state[name]
        raise NotUnderstoodError(f"it asks a {type(on).__name__} for '{name}'")

    def _called(self, call: ast.Call, names: dict[str, Any]) -> Any:
        if isinstance(call.func, ast.Attribute):
            on = self._value(call.func.value, names)
            if isinstance(on, ScriptObject):
                return self._method(on, call.func.attr, [self._value(a, names) for a in call.args])
            function = self._attribute(on, call.func.attr)
        else:
            function = self._value(call.func, names)
        if not isinstance(function, _Path):
            raise NotUnderstoodError("it calls something that is no function")
        path = function.name
        if path in ("annotate", "unchecked_cast"):
            return self._value(call.args[1], names)  # the first one is a type
        if path == "uninitialized":
            return None
        arguments = [self._value(a, names) for a in call.args]
        keywords = {k.arg: self._value(k.value, names) for k in call.keywords if k.arg is not None}
        if path in self._archive.functions:
            return self._call(self._archive.functions[path], arguments)
        if path.startswith(("torch.", "ops.aten.")):
            return self._operator(path.rpartition(".")[2], arguments, keywords)
        return self._builtin(path.removeprefix("ops.prim."), arguments)

    def _builtin(self, name: str, arguments: list[Any]) -> Any:
        if name == "getattr" and len(arguments) == 2:
            return self._attribute(arguments[0], str(arguments[1]))
        if any(isinstance(a, torch.Tensor) for a in arguments):
            tensor = arguments[0]
            if name == "dtype" and isinstance(tensor, torch.Tensor):
                return tensor.dtype
            if name == "device":
                return self._device
            if name in ("is_cpu", "is_cuda"):
                return name == "is_cpu"  # where a file's own code is run
            raise NotUnderstoodError("its course depends on what it observes")
        if name in ("bool", "int", "float") and len(arguments) == 1 and isinstance(arguments[0], (bool, int, float)):
            return {"bool": bool, "int": int, "float": float}[name](arguments[0])
        if name == "NumToTensor":
            return arguments[0]
        if name == "range" and all(isinstance(a, int) for a in arguments):
            return range(*arguments)
        if name in ("min", "max"):
            return self._numbers(name, arguments)
        raise NotUnderstoodError(f"it calls '{name}'")

    # ---- operators ------------------------------------------------------------------------------------------------

    def _operator(self, name: str, arguments: list[Any], keywords: dict[str, Any]) -> Any:
        if name in ("__is__", "__isnot__"):
            return (arguments[0] is arguments[1]) == (name == "__is__")
        if name == "device":
            return self._device
        if name == "append" and isinstance(arguments[0], list):
            arguments[0].append(arguments[1])
            return arguments[0]
        keywords = {k: v for k, v in keywords.items() if k not in ("layout", "pin_memory") and v is not None}
        if "device" in keywords or name in _FRESH:
            keywords["device"] = self._device
        tensors = [a for a in arguments if isinstance(a, torch.Tensor)]
        listed = [t for a in arguments if isinstance(a, (list, tuple)) for t in a if isinstance(t, torch.Tensor)]
        if not tensors and (name in _NUMBERS and not keywords) and not (listed and name not in ("len", "__getitem__")):
            return self._numbers(name, arguments)
        result = self._tensor_operator(name, arguments, keywords)
        if self._device.type == "meta":
            self._budget.charge(result, tensors)
        return result

    def _numbers(self, name: str, arguments: list[Any]) -> Any:
        """An operator of numbers, lists and words."""
        lists = [a for a in arguments if isinstance(a, (list, tuple))]
        if name not in ("len", "__getitem__", "list", "eq", "ne", "__contains__", "min", "max") and (
            lists or not all(isinstance(a, (bool, int, float)) for a in arguments)
        ):
            raise NotUnderstoodError(f"it uses '{name}' on something that is no number")
        result = _NUMBERS[name](*arguments)
        if isinstance(result, int) and abs(result) >= 1 << 63:
            raise NotUnderstoodError("a number is too large")
        return result

    def _tensor_operator(self, name: str, arguments: list[Any], keywords: dict[str, Any]) -> Any:
        if name == "size":
            return list(arguments[0].shape) if len(arguments) == 1 else arguments[0].shape[arguments[1]]
        if name in ("dim", "numel"):
            return getattr(arguments[0], name)()
        if name == "len":
            return len(arguments[0])
        if name in ("dropout", "feature_dropout") and len(arguments) == 3 and arguments[2] is False:
            return arguments[0]
        if name in ("batch_norm",) and arguments[5] is not False:
            raise NotUnderstoodError("it normalizes over what it observes")
        if name == "index":
            return self._indexed(*arguments)
        if name == "linear":
            return linear(*arguments, **keywords)
        if name in ("matmul", "bmm"):
            return matmul(*arguments)
        if name == "conv1d":
            return convolution(*arguments, **keywords)
        if name not in OPERATORS:
            raise NotUnderstoodError(f"it calls the operator '{name}'")
        return getattr(torch.ops.aten, name)(*arguments, **keywords)

    def _indexed(self, tensor: torch.Tensor, indices: Sequence[torch.Tensor | None]) -> torch.Tensor:
        spelled: list[torch.Tensor | None] = []
        for index in indices:
            if index is not None and index.dtype == torch.bool:
                if id(index) not in self._chosen:
                    raise NotUnderstoodError("what it chooses depends on what it observes")
                spelled += self._chosen[id(index)]
            else:
                spelled.append(index)
        return torch.ops.aten.index(tensor, spelled)
