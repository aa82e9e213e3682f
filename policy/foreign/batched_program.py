"""Foreign networks rebuilt: a program of known tensor operators for one robot, played for many robots at once.

A TorchScript or ONNX file is written for one robot, and its code may have that one in its shapes. It is read as data, and
what it does to one observation is followed operator by operator (``torchscript_program.py``, ``onnx_program.py``). torch's
``vmap`` turns that function of one robot into the function of many, in which by construction no robot can influence another,
and the outcome is recorded as one flat sequence of operations with the number of robots in its shapes. A file whose program
is not understood from end to end is not rebuilt.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch._guards import TracingContext, tracing
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx
from torch.nn import functional

from ..base import PolicyError, PolicySession, check_observation, checked_action
from ..contract import PolicyContract
from ..native import PROGRAM_ERRORS, first_line

MOST_ELEMENTS = 1 << 24
"""Entries of one tensor of a program."""
MOST_WORK = 1 << 30
"""Multiplications and entries that one run of a program for one robot may take."""
MOST_OPERATORS = 20_000
"""Operators that one run of a program may call."""


class NotUnderstoodError(Exception):
    """A program does something that it is not rebuilt with; the message says what."""


class Budget:
    """What a program may still use while it is followed without being calculated, on torch's ``meta`` device."""

    def __init__(self) -> None:
        self._work, self._operators = MOST_WORK, MOST_OPERATORS

    def charge(self, result: Any, arguments: Sequence[Any] = ()) -> None:
        """Take an operator with this result and these arguments from the budget.

        Raises:
            NotUnderstoodError: the budget does not suffice.
        """
        self._operators -= 1
        for made in result if isinstance(result, (list, tuple)) else [result]:
            if isinstance(made, torch.Tensor):
                inner = max((a.shape[-1] for a in arguments if isinstance(a, torch.Tensor) and a.dim() > 1), default=1)
                self._work -= made.numel() * max(inner, 1)
                if made.numel() > MOST_ELEMENTS:
                    self._work = -1
        if self._work < 0 or self._operators < 0:
            raise NotUnderstoodError("it takes more memory or time than a policy's network does")


class _Linear(torch.autograd.Function):
    """``functional.linear``, which vmap would take apart into a product and a sum."""

    @staticmethod
    def forward(input: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        return functional.linear(input, weight, bias)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Nothing is kept: nothing is differentiated."""

    @staticmethod
    def vmap(info: Any, dims: tuple[int | None, ...], input: Any, weight: Any, bias: Any) -> tuple[torch.Tensor, int]:
        if dims[1] is not None or dims[2] is not None:
            raise NotUnderstoodError("a layer's weights depend on the observation")
        rows = input if dims[0] == 0 else input.movedim(dims[0], 0)
        flat = (
            torch.addmm(bias, rows.flatten(0, -2), weight.t()) if bias is not None else rows.flatten(0, -2) @ weight.t()
        )
        return flat.unflatten(0, rows.shape[:-1]), 0


class _GroupedProduct(torch.autograd.Function):
    """``input`` (G, M, I) times constant ``weight`` (G, I, O), for which vmap would copy the weights for every robot."""

    @staticmethod
    def forward(input: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        return torch.bmm(input, weight)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Nothing is kept: nothing is differentiated."""

    @staticmethod
    def vmap(info: Any, dims: tuple[int | None, int | None], input: Any, weight: Any) -> tuple[torch.Tensor, int]:
        if dims[0] is None or dims[1] is not None:
            a = input.movedim(dims[0], 0) if dims[0] is not None else input.expand(info.batch_size, *input.shape)
            b = weight.movedim(dims[1], 0) if dims[1] is not None else weight
            return torch.matmul(a, b), 0
        rows = input.movedim(dims[0], 1)
        return torch.bmm(rows.flatten(1, 2), weight).unflatten(1, rows.shape[1:3]), 1


def linear(input: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    """``functional.linear`` with the same products for many robots as a network of ``networks.py``."""
    if input.dim() == 0 or weight.dim() != 2 or (bias is not None and bias.dim() != 1):
        return functional.linear(input, weight, bias)
    return _Linear.apply(input, weight, bias)


def matmul(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """``torch.matmul``; products of as many matrices each are ``bmm``."""
    if a.dim() == b.dim() == 3 and a.shape[0] == b.shape[0]:
        return _GroupedProduct.apply(a, b)
    return torch.matmul(a, b)


def convolution(
    input: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None = None,
    stride: Sequence[int] = (1,),
    padding: Sequence[int] = (0,),
    dilation: Sequence[int] = (1,),
    groups: int = 1,
) -> torch.Tensor:
    """One-dimensional convolution. Over a single position it is one linear layer for each group, as exports of mixtures
    write the heads of their experts, and is calculated as such.
    """
    batched, single = input.dim() == 3, input.shape[-1] == 1 and weight.shape[-1] == 1
    if not batched or not single or any(p != 0 for p in padding) or any(s != 1 for s in stride):
        return functional.conv1d(input, weight, bias, list(stride), list(padding), list(dilation), groups)
    rows = input.shape[0]
    heads = weight.reshape(groups, -1, weight.shape[1]).transpose(1, 2)
    parts = _GroupedProduct.apply(input.reshape(rows, groups, -1).transpose(0, 1), heads)
    result = parts.transpose(0, 1).reshape(rows, -1, 1)
    return result if bias is None else result + bias[:, None]


class Program:
    """A network as a function of one robot's observation and of what it remembers."""

    def __init__(
        self, step: Callable[..., tuple[torch.Tensor, ...]], initial: Sequence[torch.Tensor], *, source: str
    ) -> None:
        """Keep the function.

        Args:
            step: observation (1, F) float32, then each memory, to action and then each memory.
            initial: the memories of a robot that has just begun.
        """
        self._step = step
        self.initial = tuple(value.detach().clone() for value in initial)
        self.source = source
        self._recorded: dict[tuple[int, int, str], Any] = {}

    def recorded(self, num_episodes: int, width: int) -> GraphModule:
        """The function of many robots: observations (N, 1, F) and memories (N, …) to actions (N, 1, J) and memories.

        Args:
            num_episodes: robots N.
            width: entries of an observation F.

        Raises:
            NotUnderstoodError: the function of one robot cannot be made one of many.
        """
        made: GraphModule = self._kept(num_episodes, width, "recorded", self._many)
        return made

    def scripted(self, num_episodes: int, width: int) -> Any:
        """The same on the CPU without Python between the operations, where that gives the same to the last bit."""
        return self._kept(
            num_episodes, width, "scripted", lambda n, f: _scripted(self.recorded(n, f), self._inputs(n, f))
        )

    def remembering(self, num_episodes: int, width: int) -> Any:
        """The same without the actions."""

        def make(n: int, f: int) -> Any:
            return _scripted(_without_actions(self.recorded(n, f)), self._inputs(n, f))

        return self._kept(num_episodes, width, "remembering", make)

    def _kept(self, num_episodes: int, width: int, kind: str, make: Callable[[int, int], Any]) -> Any:
        key = (num_episodes, width, kind)
        if key not in self._recorded:
            try:
                with torch.no_grad(), warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # torch announces the retirement of what replays without Python
                    self._recorded[key] = make(num_episodes, width)
            except PROGRAM_ERRORS as error:
                raise NotUnderstoodError(first_line(error)) from error
        return self._recorded[key]

    def _inputs(self, num_episodes: int, width: int) -> list[torch.Tensor]:
        observation = torch.randn(num_episodes, 1, width, generator=torch.Generator().manual_seed(0))
        return [observation, *(value.expand(num_episodes, *value.shape).clone() for value in self.initial)]

    def _many(self, num_episodes: int, width: int) -> GraphModule:
        many = make_fx(torch.vmap(lambda *one: self._step(*one)))
        # Without a mode to share, the recorder makes one for every operation, which takes half its time.
        with tracing(TracingContext(FakeTensorMode(allow_fallback_kernels=True))):
            return _with_layers(many(*self._inputs(num_episodes, width)))


def _without_actions(flat: GraphModule) -> GraphModule:
    kept = copy.copy(flat)
    kept.graph = copy.deepcopy(flat.graph)
    (output,) = (node for node in kept.graph.nodes if node.op == "output")
    output.args = (tuple(output.args[0][1:]),)
    kept.graph.eliminate_dead_code()
    kept.recompile()
    return kept


def _with_layers(flat: GraphModule) -> GraphModule:
    """The same with each product and sum of a layer as one operation again, as it is in the networks of ``networks.py``."""
    aten = torch.ops.aten
    for node in flat.graph.nodes:
        if node.target is aten.addmm.default and not node.kwargs and node.args[2].target is aten.t.default:
            bias, input, weight = node.args
            node.target, node.args = aten.linear.default, (input, weight.args[0], bias)
    flat.graph.eliminate_dead_code()
    flat.recompile()
    return flat


def _scripted(flat: GraphModule, inputs: Sequence[torch.Tensor]) -> Any:
    """The same operations without Python between them."""
    traced = torch.jit.freeze(torch.jit.trace(flat.eval(), tuple(inputs), check_trace=False))
    expected = flat(*inputs)
    for _ in range(2):  # the second call is the one that its executor has optimized
        if not all(torch.equal(a, b) for a, b in zip(traced(*inputs), expected, strict=True)):
            return flat
    return traced


class ProgramSession(PolicySession):
    """Plays a rebuilt program for a fixed number of episodes."""

    def __init__(self, program: Program, num_episodes: int, contract: PolicyContract, device: torch.device) -> None:
        """Record the program for so many episodes.

        Raises:
            NotUnderstoodError: that cannot be done.
        """
        self._program, self._contract, self._num_episodes = program, contract, num_episodes
        on_cpu = device.type == "cpu"
        self._network = (
            program.scripted(num_episodes, contract.observation_width)
            if on_cpu
            else _moved(program.recorded(num_episodes, contract.observation_width), device)
        )
        self._few_rows_pay = on_cpu
        self._initial = [v.to(device).expand(num_episodes, *v.shape) for v in program.initial]
        self._memories = [value.clone() for value in self._initial]

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``."""
        if episodes is None:
            self._memories = [value.clone() for value in self._initial]
            return
        self._memories = [
            torch.where(episodes.reshape(-1, *[1] * (new.dim() - 1)), new, old)
            for new, old in zip(self._initial, self._memories, strict=True)
        ]

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        source = self._program.source
        check_observation(observation, self._num_episodes, self._contract, source)
        try:
            with torch.no_grad():
                if rows is not None and self._few_rows_pay:
                    return self._act_of(rows, observation)
                action, *self._memories = self._network(observation.unsqueeze(1), *self._memories)
        except RuntimeError as error:
            raise PolicyError(f"'{source}' failed: {first_line(error)}") from error
        return checked_action(action.flatten(1), self._num_episodes, self._contract, source)

    def _act_of(self, rows: torch.Tensor, observation: torch.Tensor) -> torch.Tensor:
        """Actions of some rows, zeros for the others; all remember."""
        width, memories = self._contract.observation_width, self._memories
        network = self._program.scripted(len(rows), width)
        some, *_ = network(observation[rows].unsqueeze(1), *(value[rows] for value in memories))
        if memories:
            remember = self._program.remembering(self._num_episodes, width)
            self._memories = list(remember(observation.unsqueeze(1), *memories))
        some = checked_action(some.flatten(1), len(rows), self._contract, self._program.source)
        return some.new_zeros(self._num_episodes, some.shape[1]).index_copy_(0, rows, some)


def _moved(flat: GraphModule, device: torch.device) -> GraphModule:
    """A copy on another device, where it also makes its new tensors."""
    moved = copy.deepcopy(flat)
    for node in moved.graph.nodes:
        if "device" in node.kwargs:
            node.kwargs = {**node.kwargs, "device": device}
    moved.recompile()
    return moved.to(device)
