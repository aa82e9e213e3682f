"""The network in an ONNX file, followed from its graph with torch's operators instead of onnxruntime's.

What depends on the file alone (weights, shapes, indices) is calculated once; what depends on an observation is followed
operator by operator, those of ``onnx_operators.py`` and no others.
"""

from __future__ import annotations

import math
from typing import Any

import onnx
import torch
from google.protobuf.message import DecodeError
from onnx import numpy_helper

from ..native import PROGRAM_ERRORS
from .batched_program import MOST_ELEMENTS, Budget, NotUnderstoodError, Program
from .fence.graph import action_output
from .onnx_operators import DTYPES, OPERATORS, Node

_MOST_NUMBERS = 1 << 16
"""Entries of a constant that may be a shape or a list of places."""


def onnx_program(data: bytes, width: int, *, source: str) -> Program:
    """Follow an ONNX file's graph on one observation; the program has no memory.

    Args:
        data: the file, its weights inside.
        width: entries of an observation.

    Raises:
        NotUnderstoodError: the graph has an operator that is not known, or a shape that depends on the observation.
    """
    try:
        with torch.no_grad():
            graph = _Graph(onnx.load_model_from_string(data))
            graph.prepare(width)
    except (DecodeError, *PROGRAM_ERRORS) as error:
        raise NotUnderstoodError(f"its graph cannot be followed ({type(error).__name__})") from error
    return Program(graph.step, (), source=source)


class _Graph:
    """A graph in which everything that the file determines is calculated beforehand."""

    def __init__(self, model: onnx.ModelProto) -> None:
        graph = model.graph
        opsets = {o.domain: o.version for o in model.opset_import}
        self._opset = opsets.get("", opsets.get("ai.onnx", 0))
        if graph.sparse_initializer:
            raise NotUnderstoodError("it has sparse weights")
        self._elements = 0
        self._constants = {t.name: self._tensor(t) for t in graph.initializer}
        inputs = [i.name for i in graph.input if i.name not in self._constants]
        if len(inputs) != 1 or not graph.output:
            raise NotUnderstoodError("it has more inputs than an observation")
        self._input = inputs[0]
        self._output = action_output([o.name for o in graph.output])
        self._nodes = self._needed(list(graph.node))
        self._known = [self._described(node) for node in self._nodes]

    def _tensor(self, stored: onnx.TensorProto) -> torch.Tensor:
        self._elements += math.prod(stored.dims)
        external = stored.data_location == onnx.TensorProto.EXTERNAL
        if (
            external
            or stored.data_type not in DTYPES
            or min(stored.dims, default=0) < 0
            or self._elements > MOST_ELEMENTS
        ):
            raise NotUnderstoodError("its weights are not those of a policy")
        return torch.from_numpy(numpy_helper.to_array(stored).copy())

    def _needed(self, nodes: list[onnx.NodeProto]) -> list[onnx.NodeProto]:
        """The nodes on which the action depends, in the order of the file."""
        wanted, kept = {self._output}, []
        for node in reversed(nodes):
            if wanted.isdisjoint(node.output):
                continue
            if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
                raise NotUnderstoodError(f"it calls the operator '{node.op_type}'")
            wanted.update(node.input)
            kept.append(node)
        return kept[::-1]

    def _described(self, node: onnx.NodeProto) -> dict[str, Any]:
        values = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        return {n: self._tensor(v) if isinstance(v, onnx.TensorProto) else v for n, v in values.items()}

    def prepare(self, width: int) -> None:
        """Calculate what the file determines, and see without numbers that the rest can be afforded.

        Raises:
            NotUnderstoodError: see ``onnx_program``.
        """
        budget = Budget()
        shapes = {name: value.to("meta") for name, value in self._constants.items()}
        shapes[self._input] = torch.zeros(1, width, device="meta")
        self._numbers: dict[str, list[Any]] = {}
        for name, value in self._constants.items():
            self._note(name, value)
        for node, attributes in zip(self._nodes, self._known, strict=True):
            given = [shapes[name] if name else None for name in node.input]
            determined = node.op_type == "Shape" or all(not n or n in self._constants for n in node.input)
            if node.op_type == "NonZero":  # the one whose result has no shape without its numbers
                results = [torch.empty(0, device="meta")]
                if not determined or self._constants[node.input[0]].numel() > _MOST_NUMBERS:
                    raise NotUnderstoodError("what it chooses depends on what it observes")
            else:
                results = self._run(node, attributes, given)
            budget.charge(results, given)
            if determined:
                real = [self._constants.get(name, shapes[name]) if name else None for name in node.input]
                results = self._run(node, attributes, real)
                for name, value in zip(node.output, results, strict=False):
                    self._constants[name] = value
                    self._note(name, value)
            for name, value in zip(node.output, results, strict=False):
                shapes[name] = value.to("meta")
        if shapes[self._output].dim() not in (1, 2) or shapes[self._output].dtype != torch.float32:
            raise NotUnderstoodError("its output is no row of actions")
        left = zip(self._nodes, self._known, strict=True)
        self._left = [(n, a) for n, a in left if not all(o in self._constants for o in n.output)]

    def _note(self, name: str, value: torch.Tensor) -> None:
        if value.numel() <= _MOST_NUMBERS and not value.is_floating_point():
            self._numbers[name] = value.reshape(-1).tolist()

    def _run(self, node: onnx.NodeProto, attributes: dict[str, Any], given: list[Any]) -> list[torch.Tensor]:
        # a weight is known as well, though not as a list
        numbers = [self._numbers.get(n, [] if n in self._constants else None) for n in node.input]
        told = Node(attributes=attributes, opset=self._opset, outputs=len(node.output), numbers=numbers)
        result = OPERATORS[node.op_type](told, given)
        return [result] if isinstance(result, torch.Tensor) else list(result)

    def step(self, observation: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The action (1, J) for an observation (1, F)."""
        values = {**self._constants, self._input: observation}
        for node, attributes in self._left:
            given = [values[name] if name else None for name in node.input]
            values.update(zip(node.output, self._run(node, attributes, given), strict=False))
        return (values[self._output].reshape(1, -1),)
