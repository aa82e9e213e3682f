"""ONNX programs where they run: on the CPU by onnxruntime, in batches even where the file was exported for a batch of one.

The batch axis is made symbolic in a copy of the graph; where the exporter wrote the batch of one into reshapes, these
are opened as well. A copy is only used if it proves equal to running the original row by row; else that is what is
done, which is slower.

A recurrent state is an input whose new value is an output: it begins with zeros, and every episode has its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import numpy_helper
from onnxruntime.capi import onnxruntime_pybind11_state as runtime_state

from ..base import (
    PROBE_EPISODES,
    Interface,
    PolicyError,
    PolicySession,
    RowwiseSession,
    act_alike,
    check_observation,
    checked_action,
    timed_action,
)
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


def _with_open_batch(model: onnx.ModelProto, batch_axes: Mapping[str, int], *, open_reshapes: bool) -> bytes:
    """Return the file with a symbolic batch axis; ``batch_axes`` of inputs and outputs by name, -1 for one that lacks it."""
    changed = onnx.ModelProto()
    changed.CopyFrom(model)
    graph = changed.graph
    for value in (*graph.input, *graph.output):
        if value.name not in batch_axes:
            continue
        dimensions, axis = value.type.tensor_type.shape.dim, batch_axes[value.name]
        if axis < 0:
            kept = [d.dim_value for d in dimensions]
            del dimensions[:]
            for size in (1, *kept):
                dimensions.add().dim_value = size
        if len(dimensions) > max(axis, 0):
            dimensions[max(axis, 0)].dim_param = "batch"
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


_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
"""Types that an input may have."""


@dataclass(frozen=True, kw_only=True)
class _Input:
    """One input of a file."""

    name: str
    type: Any
    shape: tuple[int | None, ...]
    """Size of each axis, None for any."""
    output: str = ""
    """Of a recurrent state: the output with its next value."""

    @property
    def width(self) -> int | None:
        """Return the number of entries for one robot, None for any."""
        return self.shape[-1]

    def zeros(self, rows: int) -> np.ndarray:
        """Return the state at a reset."""
        shape = [size or 1 for size in self.shape]
        shape[self.axis] = rows
        return np.zeros(shape, self.type)

    @property
    def axis(self) -> int:
        """Return the batch axis: the second one of a recurrent layer's state (layers, N, width), the first one of all others."""
        return {1: -1, 3: 1}.get(len(self.shape), 0)


def _stem(name: str) -> str:
    """Return a state's name without what tells its input from its output: ``h`` of ``h_in``, ``h_out``, ``h0`` and ``hn``."""
    bare = re.sub(r"(?<![a-z])(in|out|new|next|prev|0|n|1)(?![a-z])", "", name.lower())
    return re.sub(r"(?<=[hc])(0|n|1)$", "", bare).strip("_.")


class GraphProgram:
    """Play an ONNX file."""

    def __init__(self, data: bytes, source: str) -> None:
        """Prepare the file's content with all its weights, after ``fence.graph.check_graph``.

        Raises:
            PolicyError: onnxruntime does not take it, or an input is no tensor of floats (batch, width) and no state.
        """
        self.source, self._data = source, data
        self.contract: Interface
        self._batch: bytes | None = None
        try:
            self._model = onnx.load_model_from_string(data)
            runtime = _runtime(data)
        except _RUN_ERRORS as error:
            raise PolicyError(f"'{source}' is not a usable ONNX file: {first_line(error)}") from error
        inputs = runtime.get_inputs()
        if not inputs or any(i.type not in _TYPES or not 1 <= len(i.shape) <= 3 for i in inputs):
            found = "; ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
            raise PolicyError(
                f"'{source}' must have float inputs of shape (batch, width) and recurrent states, but has: {found or 'none'}"
            )
        self._inputs = [
            _Input(name=i.name, type=_TYPES[i.type], shape=tuple(n if isinstance(n, int) else None for n in i.shape))
            for i in inputs
        ]
        self._outputs = [o.name for o in runtime.get_outputs()]
        if not self._outputs:
            raise PolicyError(f"'{source}' has no output")
        self._action = action_output(self._outputs)

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Answer ``width`` with the only input's width, None for any, and ``prepare`` with whether a batched form was found, or with
        the input's width where it is not the interface's.
        """
        if request["do"] == "inputs":
            return {"names": [i.name for i in self._sorted(())[0]]}
        if request["do"] == "width":
            return {"width": self._width()}
        interface = Interface.from_dict(request["interface"])
        seen, _ = self._sorted(interface.memory)
        if len(seen) == len(interface.inputs) == 1 and seen[0].width not in (None, interface.observation_width):
            return {"width": seen[0].width}
        self.prepare(interface)
        return {"batched": self._batch is not None, "num_joints": self.contract.num_joints}

    def _width(self) -> int | None:
        seen, _ = self._sorted(())
        if len(seen) == 1:
            return seen[0].width
        names = ", ".join(f"{i.name} of {i.width or 'any width'}" for i in seen)
        parts = ", ".join(f'{{ input = "{i.name}", length = FRAMES }}' for i in seen)
        raise PolicyError(
            f"'{self.source}' takes {len(seen)} inputs ({names}); give a contract.toml that says what each holds: layout = [{parts}]"
        )

    def _sorted(self, memory: Sequence[tuple[str, str]]) -> tuple[list[_Input], list[_Input]]:
        """Return the inputs that take observations, and the recurrent states: those that ``memory`` names, else found by name."""
        named = dict(memory)
        inputs = [i.name for i in self._inputs]
        if strange := [n for pair in memory for n in pair if n not in (*inputs, *self._outputs)]:
            raise PolicyError(
                f"'{self.source}' has no '{strange[0]}' that its contract's memory names; "
                f"inputs are {', '.join(inputs)}, outputs {', '.join(self._outputs)}"
            )
        if not memory:
            nexts = {_stem(name): name for name in self._outputs if name != self._action}
            named = {i.name: nexts[_stem(i.name)] for i in self._inputs if _stem(i.name) in nexts}
            if len(named) == len(self._inputs):
                named = {}
        states = [replace(i, output=named[i.name]) for i in self._inputs if i.name in named]
        return [i for i in self._inputs if i.name not in named], states

    def prepare(self, contract: Interface) -> None:
        """Try the file on zeros and find a batched form of it; raise ``PolicyError`` where it fails or has not the contract's widths."""
        seen, self._states = self._sorted(contract.memory)
        named = {i.name: i for i in seen}
        wanted = contract.inputs
        if set(wanted) != set(named) and not (len(wanted) == len(named) == 1 and "" in wanted):
            raise PolicyError(
                f"'{self.source}' takes {len(named)} inputs ({', '.join(named)}); its contract's layout has "
                f"{len(wanted)} ({', '.join(wanted).strip() or 'without a name'})"
            )
        self._seen = [named.get(name, seen[0]) for name in wanted]
        for given, width in zip(self._seen, wanted.values(), strict=True):
            if given.width is not None and given.width != width:
                raise PolicyError(
                    f"'{self.source}' takes {given.width} values as its input {given.name}; its contract's layout gives {width}"
                )
        self.contract = contract
        self._rows = self._runner(self._data, flat=any(len(i.shape) == 1 for i in self._inputs))
        action = timed_action(OnnxSession(self._rows, 1), contract.observation_width, self.source)
        self.contract = self._rows.contract = replace(contract, num_joints=action.shape[1])
        self._batch = self._proved_batch()

    def session(self, rows: int, *, rowwise: bool = False) -> PolicySession:
        """Start work on so many episodes, all at once or each alone."""
        if rowwise or (self._batch is None and rows > 1):
            return RowwiseSession(self.session, rows)
        return OnnxSession(self._rows if self._batch is None else self._runner(self._batch), rows)

    def _runner(self, data: bytes, *, flat: bool = False) -> _Runner:
        return _Runner(data, self._seen, self._states, self._action, self.contract, self.source, flat=flat)

    def _variants(self) -> Iterator[bytes]:
        """Yield the file as exported, if for any batch size, and rewritten for one, mildest change first."""
        if all(i.axis >= 0 and i.shape[i.axis] is None for i in self._inputs):
            yield self._data
        axes = {i.name: i.axis for i in self._inputs} | {i.output: i.axis for i in self._states}
        axes |= {name: self._seen[0].axis for name in self._outputs if name not in axes}
        for open_reshapes in (False, True):
            yield _with_open_batch(self._model, axes, open_reshapes=open_reshapes)

    def _proved_batch(self) -> bytes | None:
        """Return a form of the file that acts on a batch as it does on single rows, through a reset of some of them."""
        for variant in self._variants():
            try:
                together = OnnxSession(self._runner(variant), PROBE_EPISODES)
            except PolicyError:
                continue
            alone = RowwiseSession(lambda rows: OnnxSession(self._rows, rows), PROBE_EPISODES)
            if act_alike(alone, together, self.contract.observation_width):
                return variant
        return None


class _Runner:
    """Run one form of a file and check its output."""

    def __init__(
        self,
        data: bytes,
        seen: Sequence[_Input],
        states: Sequence[_Input],
        action: str,
        contract: Interface,
        source: str,
        *,
        flat: bool,
    ) -> None:
        """Prepare the form; ``flat``: its tensors have no batch axis."""
        try:
            self._runtime = _runtime(data)
        except _RUN_ERRORS as error:
            raise PolicyError(f"'{source}' cannot be prepared by onnxruntime: {first_line(error)}") from error
        self._seen, self.states, self._flat = seen, states, flat
        self._wanted = [action, *(state.output for state in states)]
        self.contract, self.source = contract, source
        self._cuts = np.cumsum(list(contract.inputs.values()))[:-1]

    def run(self, observation: np.ndarray, memory: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return actions (N, J) and the next states for observations (N, W) and the present states."""
        parts = [observation] if len(self._seen) == 1 else np.split(observation, self._cuts, axis=1)
        feeds = {
            i.name: np.ascontiguousarray(part[0] if self._flat else part, dtype=i.type)
            for i, part in zip(self._seen, parts, strict=True)
        }
        feeds.update(zip((state.name for state in self.states), memory, strict=True))
        try:
            action, *following = self._runtime.run(self._wanted, feeds)
        except _RUN_ERRORS as error:
            raise PolicyError(
                f"'{self.source}' fails on observations of shape {observation.shape}: {first_line(error)}"
            ) from error
        if not isinstance(action, np.ndarray) or action.dtype.kind not in "fiub":
            found = f"tensor of {action.dtype}" if isinstance(action, np.ndarray) else type(action).__name__
            raise PolicyError(f"'{self.source}' returns a {found}; a tensor of actions is needed")
        checked = checked_action(torch.from_numpy(action), observation.shape[0], self.contract, self.source)
        return checked.numpy(), following


class OnnxSession(PolicySession):
    """Run an ONNX file for all episodes at once, with the recurrent state of each."""

    def __init__(self, runner: _Runner, num_episodes: int) -> None:
        self._runner, self._num_episodes = runner, num_episodes
        self._memory = [state.zeros(num_episodes) for state in runner.states]

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``: the states of the episodes become zeros."""
        for place, (state, value) in enumerate(zip(self._runner.states, self._memory, strict=True)):
            kept = np.zeros(self._num_episodes, bool) if episodes is None else ~episodes.numpy()
            shape = [-1 if axis == state.axis else 1 for axis in range(value.ndim)]
            self._memory[place] = value * kept.reshape(shape).astype(value.dtype)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        check_observation(observation, self._num_episodes, self._runner.contract, self._runner.source)
        action, following = self._runner.run(observation.numpy(), self._memory)
        for state, value, new in zip(self._runner.states, self._memory, following, strict=True):
            if not isinstance(new, np.ndarray) or new.shape != value.shape or new.dtype != value.dtype:
                found = f"{new.dtype} {new.shape}" if isinstance(new, np.ndarray) else type(new).__name__
                raise PolicyError(
                    f"'{self._runner.source}' gives {found} as its state {state.output}; {value.dtype} {value.shape} is needed"
                )
        self._memory = following
        return torch.from_numpy(action)
