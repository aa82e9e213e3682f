"""Reads ONNX files before onnxruntime sees them: their operators, and the place of their weights."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import onnx
from google.protobuf.message import DecodeError

from ....files.parsing import shown
from ...base import PolicyError
from .archive import LARGEST_FILE
from .operators import ONNX_CONTRIBUTED, ONNX_OPERATORS

MOST_NODES = 100_000
"""Most nodes of all graphs of a file."""
ACTION_NAMES = ("actions", "action")
"""Name of an output with the actions."""
_DEEPEST = 16
_OWN_SETS = ("", "ai.onnx")
# Where onnxruntime has operators of its own: those go before a file's functions of the same name.
_TAKEN_SETS = ("ai.onnx", "com.microsoft", "com.ms", "org.pytorch")


def action_output(names: Sequence[str]) -> str:
    """Return the output that holds the actions: the one of that name, else the first."""
    return next((name for name in ACTION_NAMES if name in names), names[0])


def check_graph(data: bytes, *, source: str, folder: Path | None) -> onnx.ModelProto:
    """Read an ONNX file with the weights that lie beside it, and refuse it if it could do anything but compute.

    Args:
        folder: where weights stored beside the file are; None: none may be.

    Raises:
        PolicyError: it is damaged, too large, uses an operator that is not on the list, or weights outside its folder.
    """
    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except (DecodeError, ValueError, RecursionError) as error:
        raise PolicyError(f"'{source}' is a damaged ONNX file") from error
    if not model.HasField("graph"):
        raise PolicyError(f"'{source}' is a damaged ONNX file: it has no graph")
    functions = {(function.domain, function.name) for function in model.functions}
    for number, node in enumerate(_nodes(model, source)):
        if number > MOST_NODES:
            raise PolicyError(f"'{source}' has over {MOST_NODES:,} nodes, the most that are read")
        known = (
            (node.domain in _OWN_SETS and node.op_type in ONNX_OPERATORS)
            or (node.domain == "com.microsoft" and node.op_type in ONNX_CONTRIBUTED)
            or (node.domain, node.op_type) in functions
        )
        if not known:
            name = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
            raise PolicyError(
                f"'{source}' was not loaded: it uses {name}, which is not on the list of tensor operators"
            )
    _load_weights(model, source, folder)
    return model


def _nodes(model: onnx.ModelProto, source: str) -> Iterator[onnx.NodeProto]:
    """Yield all nodes, those of functions and of graphs inside nodes included."""
    for function in model.functions:
        if not function.domain or function.domain.lower().startswith(_TAKEN_SETS):
            where = f" in '{function.domain}'" if function.domain else ""
            raise PolicyError(
                f"'{source}' was not loaded: it defines {function.name}{where} anew, which is not the file's own set"
            )
        yield from _inside(function.node, source, 0)
        yield from _graphs_of(function.attribute_proto, source, 0)
    for training in model.training_info:
        yield from _inside(training.initialization.node, source, 0)
        yield from _inside(training.algorithm.node, source, 0)
    yield from _inside(model.graph.node, source, 0)


def _inside(nodes: Iterable[onnx.NodeProto], source: str, depth: int) -> Iterator[onnx.NodeProto]:
    if depth > _DEEPEST:
        raise PolicyError(f"'{source}' has graphs inside graphs over {_DEEPEST} deep")
    for node in nodes:
        yield node
        yield from _graphs_of(node.attribute, source, depth)


def _graphs_of(attributes: Iterable[onnx.AttributeProto], source: str, depth: int) -> Iterator[onnx.NodeProto]:
    for attribute in attributes:
        for graph in (attribute.g, *attribute.graphs):
            yield from _inside(graph.node, source, depth + 1)


def _load_weights(model: onnx.ModelProto, source: str, folder: Path | None) -> None:
    """Take the weights beside the file into it, the main graph's alone: other tensors are small and never stored elsewhere."""
    outside = [tensor for tensor in model.graph.initializer if tensor.data_location == onnx.TensorProto.EXTERNAL]
    elsewhere = [t for t in _tensors(model, source) if t.data_location == onnx.TensorProto.EXTERNAL]
    if elsewhere:
        raise PolicyError(f"'{source}' was not loaded: tensors of its nodes are said to lie in other files")
    if not outside:
        return
    if folder is None:
        raise PolicyError(f"'{source}' was not loaded: its weights are said to lie in other files")
    total = 0
    for tensor in outside:
        entries = {entry.key: entry.value for entry in tensor.external_data}
        path = _beside(entries.get("location", ""), folder, source)
        size = path.stat().st_size
        begin = _number(entries, "offset", 0, source)
        length = _number(entries, "length", size - begin, source)
        if begin + length > size or length < 0:
            raise PolicyError(f"'{source}' lacks weights: '{path.name}' beside it is shorter than it says")
        total += length
        if total > LARGEST_FILE:
            raise PolicyError(f"'{source}' has weights of over {LARGEST_FILE // 2**20} MiB, the most that is read")
        try:
            with path.open("rb") as file:
                file.seek(begin)
                tensor.raw_data = file.read(length)
        except OSError as error:
            raise PolicyError(f"'{path}' cannot be read: {error.strerror}") from error
        del tensor.external_data[:]
        tensor.data_location = onnx.TensorProto.DEFAULT


def _tensors(model: onnx.ModelProto, source: str) -> Iterator[onnx.TensorProto]:
    """Yield all tensors but the main graph's own weights."""
    for sparse in model.graph.sparse_initializer:
        yield from (sparse.values, sparse.indices)
    nodes = (node.attribute for node in _nodes(model, source))
    for attributes in (*(function.attribute_proto for function in model.functions), *nodes):
        for attribute in attributes:
            yield attribute.t
            yield from attribute.tensors
            for sparse in (attribute.sparse_tensor, *attribute.sparse_tensors):
                yield from (sparse.values, sparse.indices)
            for graph in (attribute.g, *attribute.graphs):
                yield from graph.initializer
                for sparse in graph.sparse_initializer:
                    yield from (sparse.values, sparse.indices)


def _beside(location: str, folder: Path, source: str) -> Path:
    """Return the file of this name, which must really lie in the folder; raise ``PolicyError`` where it does not."""
    try:
        path = (folder / location).resolve()
        if not location or not path.is_relative_to(folder.resolve()):
            raise PolicyError(
                f"'{source}' was not loaded: its weights are said to lie outside its folder, in '{location}'"
            )
        if not path.is_file():
            raise PolicyError(f"'{source}' lacks its weights: there is no file '{location}' beside it")
    except (OSError, RuntimeError, ValueError) as error:  # a name that leads in circles, holds a null character …
        if isinstance(error, PolicyError):
            raise
        raise PolicyError(f"'{source}' lacks its weights: {shown(location)} cannot be read") from error
    return path


def _number(entries: dict[str, str], key: str, missing: int, source: str) -> int:
    text = entries.get(key)
    if text is None:
        return missing
    if not text.isascii() or not text.isdecimal() or len(text) > 18:
        raise PolicyError(f"'{source}' is a damaged ONNX file: '{text}' is no {key} of weights")
    return int(text)
