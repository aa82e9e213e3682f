"""TorchScript programs where they run: batched over episodes even where the file was exported for a batch of one.

An export with a history inside keeps it in tensors that ``forward`` changes, with an axis of length one for the batch.
Such tensors are found by watching a run, and given one row per episode. Whether the file can be run that way is proved
at load time: a batch is compared with as many copies of the module, over several steps and through a reset of some
rows. Where that fails, every episode gets a copy of its own, which is always right but slower.
"""

from __future__ import annotations

import copy
import io
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch

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
from ..native import LOAD_ERRORS, said_lines
from .fence.operators import OPERATORS, RECURRENT
from .fence.script import RESET_METHODS

MOST_WIDTHS_TRIED = 20
"""Widths of matrices in a module that are tried as its input's."""


@contextmanager
def _plain_execution() -> Iterator[None]:
    """Run without gradients, and without the JIT's specialization to the shapes it has seen.

    That would make the first calls slow, and calls before and after it may round differently.
    """
    with torch.no_grad(), torch.jit.optimized_execution(False):
        yield


@dataclass(frozen=True, kw_only=True)
class Memory:
    """A tensor that ``forward`` changes."""

    module: str
    """Dotted path of the submodule that holds it, empty for the module itself."""
    name: str
    axis: int
    """Batch axis."""


@dataclass(frozen=True, kw_only=True)
class Wiring:
    """Hold how an observation becomes the arguments of ``forward``."""

    widths: tuple[int, ...]
    """Width of each input in the observation."""
    order: tuple[int, ...]
    """The input that each argument is."""
    dtype: torch.dtype
    """Type of the module's weights."""

    def arguments(self, observation: torch.Tensor) -> Sequence[torch.Tensor]:
        """Return the arguments for observations (N, W)."""
        observation = observation.to(self.dtype)
        if len(self.order) == 1:
            return (observation,)
        parts = observation.split(self.widths, dim=1)
        return [parts[place] for place in self.order]


def load_module(data: bytes, *, source: str) -> Any:
    """Load a TorchScript module on the CPU, in evaluation mode and freshly reset.

    Args:
        data: the archive, after ``fence.script.check_script``: loading it may run code of its own.

    Raises:
        PolicyError: the archive is damaged, or its methods use an operator that is not on the list.
    """
    try:
        with warnings.catch_warnings():
            # torch announces TorchScript's retirement at every load; users of old exports can do nothing about it.
            warnings.simplefilter("ignore", DeprecationWarning)
            module = torch.jit.load(io.BytesIO(data), map_location="cpu")
    except LOAD_ERRORS as error:
        raise PolicyError(f"'{source}' is a damaged TorchScript file: {last_line(error)}") from error
    _check_operators(module, source=source)
    module.eval()
    for parameter in module.parameters():
        parameter.requires_grad_(False)
    try:
        _reset(module)
    except LOAD_ERRORS as error:
        raise PolicyError(f"'{source}' fails in its own reset(): {last_line(error)}") from error
    return module


def _check_operators(module: Any, *, source: str) -> None:
    """Check all operators once more, as torch has read them: nothing then hangs on how Python reads the code."""
    for node in _nodes(module.modules()):
        space, _, name = node.kind().partition("::")
        if name not in OPERATORS.get(space, frozenset()):
            raise PolicyError(
                f"'{source}' was not loaded: its code uses {node.kind()}, which is not on the list of tensor operators"
            )
    # torch's own layers hold the form for packed sequences too, and nothing calls it
    for node in _nodes([module]):
        if node.kind().partition("::")[2] in RECURRENT and "batch_sizes" in node.schema():
            raise PolicyError(f"'{source}' was not loaded: its code uses {node.kind()} with packed sequences")


def _nodes(parts: Iterable[Any]) -> Iterator[Any]:
    """Yield the nodes of all methods of some modules, with what they call in the place of the calls."""
    graphs = []  # nodes live as long as their graph does
    for part in parts:
        for name in part._c._method_names():
            graph = part._c._get_method(name).graph.copy()
            torch._C._jit_pass_inline(graph)
            graphs.append(graph)
    pending: list[Any] = list(graphs)
    while pending:
        for node in pending.pop().nodes():
            yield node
            pending.extend(node.blocks())


def input_width(module: Any, candidates: Sequence[int], *, source: str) -> int:
    """Return the first width that the module accepts as (1, width): of the candidates, then of the matrices in it.

    Raises:
        PolicyError: it accepts none, or takes several inputs.
    """
    reason = "it has no forward()"
    names = argument_names(module)
    if len(names) > 1:
        raise PolicyError(
            f"'{source}' takes {len(names)} inputs ({', '.join(names)}); give a contract.toml that says what each holds: layout = ["
            + ", ".join(f'{{ input = "{name}", length = FRAMES }}' for name in names)
            + "]"
        )
    inside = sorted({p.shape[1] for p in module.parameters() if p.dim() == 2} - set(candidates), reverse=True)
    for width in (*candidates, *inside[:MOST_WIDTHS_TRIED]):
        try:
            with _plain_execution():
                first_tensor(copy.deepcopy(module)(torch.zeros(1, width, dtype=_dtype(module))))
        except PolicyError as error:
            raise PolicyError(f"'{source}' {error}") from error
        except LOAD_ERRORS as error:
            reason = last_line(error)
        else:
            return width
    widths = ", ".join(str(w) for w in candidates[:3])
    raise PolicyError(
        f"'{source}' takes none of the standard observation widths ({widths} …): {reason}; "
        "give a contract.toml that describes its observation (gaitgauge contract new)"
    )


def argument_names(module: Any) -> list[str]:
    """Return the names of the arguments that ``forward`` must be given."""
    if not module._c._has_method("forward"):
        return []
    arguments = module._c._get_method("forward").schema.arguments[1:]
    return [argument.name for argument in arguments if not argument.has_default_value()]


def _dtype(module: Any) -> torch.dtype:
    """Return the floating-point type of a module's weights, float32 where it has none."""
    types = (tensor.dtype for tensor in (*module.parameters(), *module.buffers()) if tensor.is_floating_point())
    return next(types, torch.float32)


def first_tensor(output: Any) -> torch.Tensor:
    """Return the action in a module's output: the output itself, or the first entry of a tuple or list of any depth behind it.

    Raises:
        PolicyError: there is no tensor in that place.
    """
    if isinstance(output, (tuple, list)) and output:
        output = output[0]
    if not isinstance(output, torch.Tensor):
        raise PolicyError(
            f"returns a {type(output).__name__}; a tensor of actions, alone or first in a tuple, is needed"
        )
    kinds = {"quantized": output.is_quantized, "complex": output.is_complex(), "meta": output.is_meta}
    kinds |= {"nested": output.is_nested, "sparse": output.layout != torch.strided}
    if strange := [kind for kind, holds in kinds.items() if holds]:
        raise PolicyError(f"returns a {strange[0]} tensor; a plain tensor of actions is needed")
    return output


class ScriptProgram:
    """A TorchScript module at work for a policy."""

    def __init__(self, data: bytes, source: str) -> None:
        """Load the module from ``data`` after ``fence.script.check_script``; raise ``PolicyError`` where it cannot be loaded."""
        self.source = source
        self._module = load_module(data, source=source)
        self.contract: Interface
        self.memories: tuple[Memory, ...] | None = None

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Answer ``width`` with the width that the module takes, and ``prepare`` with whether it runs in batches, or with the width
        that it takes in place of the interface's.
        """
        if request["do"] == "inputs":
            return {"names": argument_names(self._module)}
        if request["do"] == "width":
            return {"width": input_width(self._module, request["candidates"], source=self.source)}
        interface = Interface.from_dict(request["interface"])
        try:
            self.prepare(interface, request["attributes"])
        except PolicyError:
            if len(interface.inputs) > 1 or (width := self._other_width(interface.observation_width)) is None:
                raise
            return {"width": width}
        return {"batched": self.memories is not None, "num_joints": self.contract.num_joints}

    def prepare(self, contract: Interface, attributes: Collection[str]) -> None:
        """Find out how to run the module in batches.

        Args:
            contract: its inputs, and its output where that is known; inputs that have names are put in the order of its
                arguments.
            attributes: names of all attributes that the archive's classes declare; torch itself lists only parameters and
                buffers.

        Raises:
            PolicyError: the module fails on zeros, or its input or output has the wrong width.
        """
        self._attributes = frozenset(attributes)
        names = argument_names(self._module)
        wanted = [name for name in contract.inputs if name]
        if len(names) != len(contract.inputs) or (wanted and set(wanted) != set(names)):
            raise PolicyError(
                f"'{self.source}' takes {len(names)} inputs ({', '.join(names)}); its contract's layout has "
                f"{len(contract.inputs)} ({', '.join(wanted) or 'without a name'})"
            )
        order = [list(contract.inputs).index(name) for name in names] if wanted else [0]
        widths = list(contract.inputs.values())
        self._wiring = Wiring(widths=tuple(widths), order=tuple(order), dtype=_dtype(self._module))
        check = CopiesSession(self._module, 1, contract, self.source, self._wiring)
        action = timed_action(check, contract.observation_width, self.source)
        self.contract = replace(contract, num_joints=action.shape[1])
        self.memories = self._find_memories()

    def _other_width(self, width: int) -> int | None:
        """Return the width that the module takes in place of this one, None where it takes none or this one."""
        try:
            found = input_width(self._module, (width,), source=self.source)
        except PolicyError:
            return None
        return None if found == width else found

    def session(self, rows: int, *, rowwise: bool = False) -> PolicySession:
        """Start work on so many episodes with a copy of the module, all at once or each alone."""
        if rowwise:
            return RowwiseSession(self.session, rows)
        if self.memories is None:
            return CopiesSession(self._module, rows, self.contract, self.source, self._wiring)
        return BatchSession(self._module, rows, self.contract, self.source, self._wiring, self.memories)

    def _find_memories(self) -> tuple[Memory, ...] | None:
        """Return the module's memories, such that a batch proves equal to single runs; None if there is no such way."""
        changed = self._changed_tensors()
        if changed is None:
            return None
        if not changed:
            return () if self._proved(()) else None
        # All memories of a file have their batch on one axis: the first for histories, the second for recurrent states.
        for axis in range(max(value.dim() for _, _, value in changed)):
            if all(axis < value.dim() and value.shape[axis] == 1 for _, _, value in changed):
                memories = tuple(Memory(module=m, name=n, axis=axis) for m, n, _ in changed)
                if self._proved(memories):
                    return memories
        return None

    def _changed_tensors(self) -> list[tuple[str, str, torch.Tensor]] | None:
        """Return tensors that a run changes, with their initial values; None if it changes anything else."""
        module = copy.deepcopy(self._module)
        before = self._snapshot(module)
        generator = torch.Generator().manual_seed(0)
        with _plain_execution():
            for _ in range(2):
                observation = torch.randn(1, self.contract.observation_width, generator=generator)
                module(*self._wiring.arguments(observation))
        changed = []
        for key, value in self._snapshot(module).items():
            old = before[key]
            if isinstance(value, torch.Tensor) and isinstance(old, torch.Tensor):
                if value.shape != old.shape or not torch.equal(value, old):
                    changed.append((*key, old))
            elif value != old:
                return None
        return changed

    def _snapshot(self, module: Any) -> dict[tuple[str, str], Any]:
        """Return copies of all tensors, and the values of all plain attributes, of a module and its submodules."""
        found: dict[tuple[str, str], Any] = {}
        for path, part in module.named_modules():
            for name in self._attributes:
                if not part._c.hasattr(name):
                    continue
                value = part._c.getattr(name)
                if isinstance(value, torch.Tensor):
                    found[path, name] = value.detach().clone()
                elif isinstance(value, (int, float, bool, str, list, tuple, dict)) or value is None:
                    found[path, name] = repr(value)
        return found

    def _proved(self, memories: tuple[Memory, ...]) -> bool:
        """Return whether a batch acts as single copies do."""
        batch = BatchSession(self._module, PROBE_EPISODES, self.contract, self.source, self._wiring, memories)
        copies = CopiesSession(self._module, PROBE_EPISODES, self.contract, self.source, self._wiring)
        return act_alike(copies, batch, self.contract.observation_width)


class BatchSession(PolicySession):
    """One module for all episodes; its memories have a row per episode."""

    def __init__(
        self,
        module: Any,
        num_episodes: int,
        contract: Interface,
        source: str,
        wiring: Wiring,
        memories: Sequence[Memory],
    ) -> None:
        self._module = copy.deepcopy(module)
        self._num_episodes, self._contract, self._source, self._wiring = num_episodes, contract, source, wiring
        parts = dict(self._module.named_modules())
        self._memories: list[tuple[Any, Memory, torch.Tensor]] = []
        for memory in memories:
            part = parts[memory.module]
            value = part._c.getattr(memory.name).detach()
            shape = list(value.shape)
            shape[memory.axis] = num_episodes
            self._memories.append((part, memory, value.expand(shape).clone()))
        self.reset()

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``."""
        for part, memory, initial in self._memories:
            if episodes is None:
                value = initial.clone()
            else:
                mask = episodes.reshape([-1 if axis == memory.axis else 1 for axis in range(initial.dim())])
                value = torch.where(mask, initial, part._c.getattr(memory.name))
            part._c.setattr(memory.name, value)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        return _run(self._module, observation, self._num_episodes, self._contract, self._source, self._wiring)


class CopiesSession(PolicySession):
    """One copy of the module for each episode, run one after another."""

    def __init__(self, module: Any, num_episodes: int, contract: Interface, source: str, wiring: Wiring) -> None:
        """Copy the module, which must be freshly reset."""
        self._fresh = copy.deepcopy(module)
        self._contract, self._source, self._wiring = contract, source, wiring
        self._modules = [copy.deepcopy(self._fresh) for _ in range(num_episodes)]

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``."""
        rows = range(len(self._modules)) if episodes is None else episodes.nonzero().flatten().tolist()
        for row in rows:
            self._modules[row] = copy.deepcopy(self._fresh)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        check_observation(observation, len(self._modules), self._contract, self._source)
        pairs = zip(self._modules, observation.split(1), strict=True)
        return torch.cat([_run(module, row, 1, self._contract, self._source, self._wiring) for module, row in pairs])


def _run(
    module: Any, observation: torch.Tensor, rows: int, contract: Interface, source: str, wiring: Wiring
) -> torch.Tensor:
    check_observation(observation, rows, contract, source)
    try:
        with _plain_execution():
            action = first_tensor(module(*wiring.arguments(observation)))
    except PolicyError as error:
        raise PolicyError(f"'{source}' {error}") from error
    except LOAD_ERRORS as error:
        raise PolicyError(
            f"'{source}' fails on observations of shape {tuple(observation.shape)}: {last_line(error)}"
        ) from error
    return checked_action(action, rows, contract, source)


def last_line(error: BaseException) -> str:
    """Return the last line of an error: TorchScript puts its message behind the traceback."""
    return said_lines(error)[-1].rstrip(".")[:200]


def _reset(module: Any) -> None:
    for name in RESET_METHODS:
        if module._c._has_method(name):
            with _plain_execution():
                getattr(module, name)()
