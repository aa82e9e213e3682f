"""ONNX programs where they run: on the CPU by onnxruntime, in batches even where the file was exported for a batch of one.

The batch axis is made symbolic in a copy of the graph; where the exporter wrote the batch of one into reshapes, these
are opened as well. A copy is only used if it proves equal to running the original row by row; else that is what is
done, which is slower.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import numpy_helper
from onnxruntime.capi import onnxruntime_pybind11_state as runtime_state

from ..base import (
    PROBE_EPISODES,
    PROBE_TOLERANCE,
    PolicyError,
    PolicySession,
    RowwiseSession,
    check_observation,
    checked_action,
)
from ..contract import PolicyContract, other_width
from ..native import first_line
from .fence.graph import action_output

_RUN_ERRORS: tuple[type[Exception], ...] = (
    *(e for e in vars(runtime_state).values() if isinstance(e, type) and issubclass(e, Exception)),
    RuntimeError,
    ValueError,
)


def _runtime(data: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    # What goes wrong is reported by exceptions; the log would only repeat it on the user's terminal.
    options.log_severity_level = 4
    # Without its fall-back, which would only try the CPU again and print that it does.
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"], enable_fallback=0)


def _with_open_batch(model: onnx.ModelProto, input_name: str, *, open_reshapes: bool) -> bytes:
    changed = onnx.ModelProto()
    changed.CopyFrom(model)
    graph = changed.graph
    for value in (*(i for i in graph.input if i.name == input_name), *graph.output):
        dimensions = value.type.tensor_type.shape.dim
        if dimensions:
            dimensions[0].dim_param = "batch"
    # Shapes noted for inner values still say one.
    del graph.value_info[:]
    if open_reshapes:
        constants = {t.name: t for t in graph.initializer}
        for node in graph.node:
            if node.op_type == "Constant":
                constants.update((node.output[0], a.t) for a in node.attribute if a.name == "value")
        for number, node in enumerate(n for n in graph.node if n.op_type == "Reshape"):
            if len(node.input) > 1 and node.input[1] in constants:
                shape = numpy_helper.to_array(constants[node.input[1]]).copy()
                if len(shape) > 1 and shape[0] == 1 and 0 not in shape:
                    # -1 infers the axis, 0 keeps the input's; only one axis may be inferred.
                    shape[0] = 0 if -1 in shape[1:] else -1
                    name = f"open_batch_shape_{number}"
                    graph.initializer.append(numpy_helper.from_array(shape, name))
                    node.input[1] = name
                    kept = [a for a in node.attribute if a.name != "allowzero"]
                    del node.attribute[:]
                    node.attribute.extend(kept)
    return changed.SerializeToString()


class GraphProgram:
    """Play an ONNX file with one observation as its input."""

    def __init__(self, data: bytes, source: str) -> None:
        """Prepare the file's content with all its weights, after ``fence.graph.check_graph``.

        Raises:
            PolicyError: onnxruntime does not take it, or it has not exactly one float input of shape (batch, width).
        """
        self.source, self._data = source, data
        self.contract: PolicyContract
        self._batch: bytes | None = None
        try:
            self._model = onnx.load_model_from_string(data)
            runtime = _runtime(data)
        except _RUN_ERRORS as error:
            raise PolicyError(f"'{source}' is not a usable ONNX file: {first_line(error)}") from error
        inputs = runtime.get_inputs()
        if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(inputs[0].shape) != 2:
            found = "; ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
            raise PolicyError(
                f"'{source}' must have one float input of shape (batch, width), but has: {found or 'none'}"
            )
        outputs = [o.name for o in runtime.get_outputs()]
        if not outputs:
            raise PolicyError(f"'{source}' has no output")
        self._names: tuple[str, str] = (inputs[0].name, action_output(outputs))
        rows, width = inputs[0].shape
        self._width: int | None = width if isinstance(width, int) else None
        self._open_batch = not isinstance(rows, int)

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Answer ``width`` with the input's width, None for any, and ``prepare`` with whether a batched form was found."""
        if request["do"] == "width":
            return {"width": self._width}
        self.prepare(PolicyContract.from_json(request["contract"]))
        return {"batched": self._batch is not None}

    def prepare(self, contract: PolicyContract) -> None:
        """Try the file on zeros and find a batched form of it; raise ``PolicyError`` where it fails or has not the contract's widths."""
        self.contract = contract
        if self._width is not None and self._width != contract.observation_width:
            raise PolicyError(f"'{self.source}' takes {self._width} values, {other_width(contract, self._width)}")
        self._rows = self._runner(self._data)
        self._rows.run(np.zeros((1, contract.observation_width), np.float32))
        self._batch = self._proved_batch()

    def session(self, rows: int, *, rowwise: bool = False) -> PolicySession:
        """Start work on so many episodes, all at once or each alone."""
        if rowwise or (self._batch is None and rows > 1):
            return RowwiseSession(self.session, rows)
        return OnnxSession(self._rows if self._batch is None else self._runner(self._batch), rows)

    def _runner(self, data: bytes) -> _Runner:
        return _Runner(data, self._names, self.contract, self.source)

    def _variants(self) -> Iterator[bytes]:
        """Yield the file as exported, if for any batch size, and rewritten for one, mildest change first."""
        if self._open_batch:
            yield self._data
        for open_reshapes in (False, True):
            yield _with_open_batch(self._model, self._names[0], open_reshapes=open_reshapes)

    def _proved_batch(self) -> bytes | None:
        generator = np.random.default_rng(0)
        probe = generator.standard_normal((PROBE_EPISODES, self.contract.observation_width)).astype(np.float32)
        expected = np.concatenate([self._rows.run(probe[i : i + 1]) for i in range(PROBE_EPISODES)])
        for variant in self._variants():
            try:
                actual = self._runner(variant).run(probe)
            except PolicyError:
                continue
            if np.allclose(actual, expected, rtol=PROBE_TOLERANCE, atol=PROBE_TOLERANCE, equal_nan=True):
                return variant
        return None


class _Runner:
    """Run one form of a file and check its output."""

    def __init__(self, data: bytes, names: tuple[str, str], contract: PolicyContract, source: str) -> None:
        """Prepare the form; ``names`` are those of input and output."""
        try:
            self._runtime = _runtime(data)
        except _RUN_ERRORS as error:
            raise PolicyError(f"'{source}' cannot be prepared by onnxruntime: {first_line(error)}") from error
        (self._input, self._output), self.contract, self.source = names, contract, source

    def run(self, observation: np.ndarray) -> np.ndarray:
        try:
            (action,) = self._runtime.run([self._output], {self._input: observation})
        except _RUN_ERRORS as error:
            raise PolicyError(
                f"'{self.source}' fails on observations of shape {observation.shape}: {first_line(error)}"
            ) from error
        if not isinstance(action, np.ndarray) or action.dtype.kind not in "fiub":
            found = f"tensor of {action.dtype}" if isinstance(action, np.ndarray) else type(action).__name__
            raise PolicyError(f"'{self.source}' returns a {found}; a tensor of actions is needed")
        return checked_action(torch.from_numpy(action), observation.shape[0], self.contract, self.source).numpy()


class OnnxSession(PolicySession):
    """Run an ONNX file, which has no memory, for all episodes at once."""

    def __init__(self, runner: _Runner, num_episodes: int) -> None:
        self._runner, self._num_episodes = runner, num_episodes

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``: there is nothing to forget."""

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        check_observation(observation, self._num_episodes, self._runner.contract, self._runner.source)
        return torch.from_numpy(self._runner.run(observation.numpy()))
