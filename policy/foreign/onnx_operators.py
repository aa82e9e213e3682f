"""ONNX operators as torch's, by the ONNX operator specification; those that can depend on one robot's observation alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import onnx
import torch
from torch.nn import functional

from .batched_program import NotUnderstoodError, convolution, linear, matmul

DTYPES = {
    onnx.TensorProto.FLOAT: torch.float32,
    onnx.TensorProto.DOUBLE: torch.float64,
    onnx.TensorProto.INT32: torch.int32,
    onnx.TensorProto.INT64: torch.int64,
    onnx.TensorProto.BOOL: torch.bool,
}
Inputs = Sequence[Any]
"""Tensors; None for an input that is left out."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """What an operator is told beside its inputs."""

    attributes: Mapping[str, Any]
    opset: int
    """Version of the operator set."""
    outputs: int
    """How many outputs it has."""
    numbers: Sequence[list[Any] | None]
    """Of each input that the file determines, its entries; None for the others."""

    def get(self, name: str, default: Any = None) -> Any:
        """An attribute, or the default."""
        return self.attributes.get(name, default)

    def listed(self, place: int, name: str | None = None) -> list[int] | None:
        """Whole numbers that are an input, or in older operator sets an attribute; None if they are left out.

        Raises:
            NotUnderstoodError: they depend on the observation.
        """
        if name is not None and name in self.attributes:
            return list(self.attributes[name])
        if place >= len(self.numbers):
            return None
        if self.numbers[place] is None:
            raise NotUnderstoodError("a shape or a place in it depends on what it observes")
        return self.numbers[place]


def _gemm(node: Node, inputs: Inputs) -> torch.Tensor:
    a, b = inputs[0], inputs[1]
    c = inputs[2] if len(inputs) > 2 else None
    weight = b if node.get("transB", 0) else b.t()
    plain = node.get("alpha", 1.0) == 1.0 and node.get("beta", 1.0) == 1.0 and not node.get("transA", 0)
    if plain and (c is None or c.numel() == weight.shape[0]):
        return linear(a, weight, None if c is None else c.reshape(-1))
    product = node.get("alpha", 1.0) * linear(a.t() if node.get("transA", 0) else a, weight)
    return product if c is None else product + node.get("beta", 1.0) * c


def _matmul(node: Node, inputs: Inputs) -> torch.Tensor:
    a, b = inputs
    return linear(a, b.t()) if b.dim() == 2 and node.numbers[1] is not None else matmul(a, b)


def _conv(node: Node, inputs: Inputs) -> torch.Tensor:
    pads = list(node.get("pads", [0, 0]))
    if inputs[1].dim() != 3 or node.get("auto_pad", b"NOTSET") != b"NOTSET" or pads[:1] != pads[1:]:
        raise NotUnderstoodError("it has a convolution over more than one axis, or with uneven margins")
    bias = inputs[2] if len(inputs) > 2 else None
    strides, dilations = node.get("strides", [1]), node.get("dilations", [1])
    return convolution(inputs[0], inputs[1], bias, strides, pads[:1], dilations, node.get("group", 1))


def _softmax(function: Callable[..., torch.Tensor]) -> Callable[[Node, Inputs], torch.Tensor]:
    def run(node: Node, inputs: Inputs) -> torch.Tensor:
        axis = node.get("axis", -1 if node.opset >= 13 else 1) % inputs[0].dim()
        if node.opset < 13 and axis != inputs[0].dim() - 1:
            raise NotUnderstoodError("it has a softmax over several axes")
        return function(inputs[0], dim=axis)

    return run


def _clip(node: Node, inputs: Inputs) -> torch.Tensor:
    limits = [*inputs[1:], None, None][:2] if node.opset >= 11 else [node.get("min"), node.get("max")]
    result = inputs[0]
    for limit, function in zip(limits, (torch.maximum, torch.minimum), strict=True):
        if limit is not None:
            result = function(result, torch.as_tensor(limit, dtype=result.dtype, device=result.device))
    return result


def _reduce(function: Callable[..., torch.Tensor]) -> Callable[[Node, Inputs], torch.Tensor]:
    """``function(input, axes, keepdim)``."""

    def run(node: Node, inputs: Inputs) -> torch.Tensor:
        axes = node.listed(1, "axes")
        if not axes:
            if node.get("noop_with_empty_axes", 0):
                return inputs[0]
            axes = list(range(inputs[0].dim()))
        return function(inputs[0], axes, bool(node.get("keepdims", 1)))

    return run


def _lp_normalization(node: Node, inputs: Inputs) -> torch.Tensor:
    length = torch.linalg.vector_norm(inputs[0], float(node.get("p", 2)), [node.get("axis", -1)], True)
    return torch.where(length == 0.0, torch.zeros_like(inputs[0]), inputs[0] / length)


def _slice(node: Node, inputs: Inputs) -> torch.Tensor:
    starts, ends = node.listed(1, "starts"), node.listed(2, "ends")
    if starts is None or ends is None:
        raise NotUnderstoodError("it has a slice without ends")
    axes, steps = node.listed(3, "axes") or list(range(len(starts))), node.listed(4) or [1] * len(starts)
    result = inputs[0]
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        length = result.shape[axis]
        last = end if step > 0 or end >= -length else None  # backwards past the first entry
        chosen = range(*slice(start, last, step).indices(length))
        if step == 1:
            result = result.narrow(axis, chosen.start, len(chosen))
        else:
            result = result.index_select(axis, torch.tensor(list(chosen), dtype=torch.int64, device=result.device))
    return result


def _gather(node: Node, inputs: Inputs) -> torch.Tensor:
    data, axis = inputs[0], node.get("axis", 0) % max(inputs[0].dim(), 1)
    found = node.listed(1) or []
    indices = [i + data.shape[axis] if i < 0 else i for i in found]
    if inputs[1].dim() == 0:
        return data.select(axis, indices[0])
    chosen = data.index_select(axis, torch.tensor(indices, dtype=torch.int64, device=data.device))
    return chosen.unflatten(axis, inputs[1].shape) if inputs[1].dim() > 1 else chosen


def _gather_nd(node: Node, inputs: Inputs) -> torch.Tensor:
    data, shape = inputs[0], inputs[1].shape
    if node.get("batch_dims", 0) or node.listed(1) is None:
        raise NotUnderstoodError("it gathers along several axes of a batch")
    places = torch.tensor(node.listed(1), dtype=torch.int64, device=data.device).reshape(shape)
    return data[tuple(places.unbind(-1))]


def _reshape(node: Node, inputs: Inputs) -> torch.Tensor:
    shape = node.listed(1, "shape") or []
    keep = not node.get("allowzero", 0)
    return inputs[0].reshape([inputs[0].shape[i] if s == 0 and keep else s for i, s in enumerate(shape)])


def _flatten(node: Node, inputs: Inputs) -> torch.Tensor:
    axis, shape = node.get("axis", 1), inputs[0].shape
    axis = axis + len(shape) if axis < 0 else axis
    return inputs[0].reshape(math.prod(shape[:axis]), math.prod(shape[axis:]))


def _squeeze(node: Node, inputs: Inputs) -> torch.Tensor:
    axes = node.listed(1, "axes")
    return inputs[0].squeeze() if axes is None else inputs[0].squeeze(axes)


def _unsqueeze(node: Node, inputs: Inputs) -> torch.Tensor:
    axes = node.listed(1, "axes") or []
    rank, result = inputs[0].dim() + len(axes), inputs[0]
    for axis in sorted(a % rank for a in axes):
        result = result.unsqueeze(axis)
    return result


def _split(node: Node, inputs: Inputs) -> Sequence[torch.Tensor]:
    axis = node.get("axis", 0)
    sizes = node.listed(1, "split")
    if sizes is None:
        size = -(-inputs[0].shape[axis] // node.get("num_outputs", node.outputs))
        return inputs[0].split(size, axis)
    return inputs[0].split(sizes, axis)


def _shape(node: Node, inputs: Inputs) -> torch.Tensor:
    return torch.tensor(list(inputs[0].shape)[node.get("start", 0) : node.get("end")], dtype=torch.int64)


def _constant_of_shape(node: Node, inputs: Inputs) -> torch.Tensor:
    value = node.get("value")
    fill = torch.zeros(1) if value is None else value
    return fill.to(inputs[0].device).expand(node.listed(0) or []).clone()


def _layer_normalization(node: Node, inputs: Inputs) -> torch.Tensor:
    shape = inputs[0].shape[node.get("axis", -1) % inputs[0].dim() :]
    bias = inputs[2] if len(inputs) > 2 else None
    return functional.layer_norm(inputs[0], shape, inputs[1], bias, node.get("epsilon", 1e-5))


def _batch_normalization(node: Node, inputs: Inputs) -> torch.Tensor:
    if node.get("training_mode", 0):
        raise NotUnderstoodError("it normalizes over what it observes")
    values, scale, bias, mean, variance = inputs
    return functional.batch_norm(values, mean, variance, scale, bias, False, 0.0, node.get("epsilon", 1e-5))


def _cast(node: Node, inputs: Inputs) -> torch.Tensor:
    if node.get("to") not in DTYPES:
        raise NotUnderstoodError("it uses numbers of a kind that policies do not use")
    return inputs[0].to(DTYPES[node.get("to")])


def _constant(node: Node, inputs: Inputs) -> torch.Tensor:
    for name, dtype in (("value_float", torch.float32), ("value_floats", torch.float32), ("value_int", torch.int64)):
        if name in node.attributes:
            return torch.tensor(node.get(name), dtype=dtype)
    if "value_ints" in node.attributes:
        return torch.tensor(node.get("value_ints"), dtype=torch.int64)
    if not isinstance(node.get("value"), torch.Tensor):
        raise NotUnderstoodError("it has a constant that is no tensor")
    return node.get("value")


def _plain(function: Callable[..., torch.Tensor], **defaults: float) -> Callable[[Node, Inputs], torch.Tensor]:
    """An operator whose attributes are the function's further arguments, in this order."""

    def run(node: Node, inputs: Inputs) -> torch.Tensor:
        return function(*inputs, *(node.get(name, default) for name, default in defaults.items()))

    return run


def _all_of(function: Callable[..., torch.Tensor]) -> Callable[[Node, Inputs], torch.Tensor]:
    def run(node: Node, inputs: Inputs) -> torch.Tensor:
        result = inputs[0]
        for other in inputs[1:]:
            result = function(result, other)
        return result

    return run


_SAME_NAMES = """
Abs Add Ceil Cos Erf Exp Floor Log Mul Neg Pow Reciprocal Relu Sigmoid Sign Sin Sqrt Sub Tan Tanh Where
"""
"""Operators that torch has by the same name and with the same inputs."""

OPERATORS: Mapping[str, Callable[[Node, Inputs], Any]] = {
    **{name: _plain(getattr(torch, name.lower())) for name in _SAME_NAMES.split()},
    "And": _plain(torch.logical_and),
    "BatchNormalization": _batch_normalization,
    "Cast": _cast,
    "Celu": _plain(functional.celu, alpha=1.0),
    "Clip": _clip,
    "Concat": lambda node, inputs: torch.cat(list(inputs), dim=node.get("axis")),
    "Constant": _constant,
    "ConstantOfShape": _constant_of_shape,
    "Conv": _conv,
    "Div": lambda node, inputs: torch.div(*inputs, rounding_mode=None if inputs[0].is_floating_point() else "trunc"),
    "Dropout": lambda node, inputs: inputs[0],
    "Elu": _plain(functional.elu, alpha=1.0),
    "Equal": _plain(torch.eq),
    "Expand": lambda node, inputs: inputs[0].expand(torch.broadcast_shapes(inputs[0].shape, node.listed(1) or [])),
    "Flatten": _flatten,
    "Gather": _gather,
    "GatherND": _gather_nd,
    "Gelu": lambda node, inputs: functional.gelu(inputs[0], approximate=node.get("approximate", b"none").decode()),
    "Gemm": _gemm,
    "Greater": _plain(torch.gt),
    "GreaterOrEqual": _plain(torch.ge),
    "HardSigmoid": _plain(lambda x, a, b: torch.clamp(a * x + b, 0.0, 1.0), alpha=0.2, beta=0.5),
    "HardSwish": _plain(functional.hardswish),
    "Identity": lambda node, inputs: inputs[0],
    "LayerNormalization": _layer_normalization,
    "LeakyRelu": _plain(functional.leaky_relu, alpha=0.01),
    "Less": _plain(torch.lt),
    "LessOrEqual": _plain(torch.le),
    "LogSoftmax": _softmax(torch.log_softmax),
    "LpNormalization": _lp_normalization,
    "MatMul": _matmul,
    "Max": _all_of(torch.maximum),
    "Min": _all_of(torch.minimum),
    "Mish": _plain(functional.mish),
    "Mod": lambda node, inputs: (torch.fmod if node.get("fmod", 0) else torch.remainder)(*inputs),
    "NonZero": lambda node, inputs: inputs[0].nonzero().t(),
    "Not": _plain(torch.logical_not),
    "Or": _plain(torch.logical_or),
    "PRelu": _plain(lambda x, slope: torch.where(x < 0.0, slope * x, x)),
    "ReduceL1": _reduce(lambda x, axes, keep: torch.linalg.vector_norm(x, 1, axes, keep)),
    "ReduceL2": _reduce(lambda x, axes, keep: torch.linalg.vector_norm(x, 2, axes, keep)),
    "ReduceLogSumExp": _reduce(torch.logsumexp),
    "ReduceMax": _reduce(torch.amax),
    "ReduceMean": _reduce(torch.mean),
    "ReduceMin": _reduce(torch.amin),
    "ReduceSum": _reduce(torch.sum),
    "ReduceSumSquare": _reduce(lambda x, axes, keep: torch.sum(x * x, axes, keep)),
    "Reshape": _reshape,
    "Selu": _plain(
        lambda x, alpha, gamma: gamma * torch.where(x > 0.0, x, alpha * torch.expm1(x)),
        alpha=1.67326319217681884765625,
        gamma=1.05070102214813232421875,
    ),
    "Shape": _shape,
    "Slice": _slice,
    "Softmax": _softmax(torch.softmax),
    "Softplus": _plain(functional.softplus),
    "Softsign": _plain(functional.softsign),
    "Split": _split,
    "Squeeze": _squeeze,
    "Sum": _all_of(torch.add),
    "Tile": lambda node, inputs: inputs[0].repeat(node.listed(1) or []),
    "Transpose": lambda node, inputs: inputs[0].permute(node.get("perm", list(range(inputs[0].dim()))[::-1])),
    "Unsqueeze": _unsqueeze,
    "Xor": _plain(torch.logical_xor),
}
"""Operators by name: what they make of a node and its inputs, one tensor or several."""
