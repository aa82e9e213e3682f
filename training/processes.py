"""Join the processes of one run, one for each GPU as ``starting`` or torchrun starts them, and choose each one's GPU.

CPU tensors travel through gloo, which notices at once that a process is gone; GPU tensors through NCCL, which waits for it instead:
``run.rescue`` gives up in the end.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import distributed

from ..backends.registry import choose_device
from ..files.parsing import one_line, shown
from .configuration import ConfigurationError

RUN_TOLD = "GAITGAUGE_RUN_TOLD"
"""Environment variable that names the file in which the first of several processes writes its run directory, for ``starting``."""
RUN_BEGAN = "GAITGAUGE_RUN_BEGAN"
"""Environment variable with the time, on this machine's ``time.monotonic()``, at which the command began that started the processes."""


def told_number(name: str, default: int) -> int:
    """Return a number that torchrun tells its processes in their environment. Raises ConfigurationError: it is none."""
    text = os.environ.get(name, str(default))
    if not (text.isascii() and text.isdecimal() and len(text) < 7):
        raise ConfigurationError(
            f"the environment variable {name} is {shown(text)}; it must be a whole number, as torchrun makes it: unset it, or start "
            "the run with torchrun"
        )
    return int(text)


class ProcessLostError(RuntimeError):
    """Another process of the run does not answer any more."""


@dataclass(frozen=True, kw_only=True)
class Processes:
    """Rank of this process, and messages to the others."""

    rank: int = 0
    """Number of this process; the first one speaks, logs and writes."""
    count: int = 1
    """Processes of the run."""

    @classmethod
    def told(cls) -> Processes:
        """Read the variables that torchrun sets; no process is joined. Raises ConfigurationError: it is nonsense."""
        here = cls(rank=told_number("RANK", 0), count=told_number("WORLD_SIZE", 1))
        if here.rank >= here.count:
            raise ConfigurationError(
                f"the environment variable RANK is {here.rank} and WORLD_SIZE {here.count}; ranks count from 0 and are smaller: "
                "unset both, or start the run with torchrun"
            )
        return here

    @classmethod
    def join(cls, device: torch.device | str) -> Processes:
        """Join the processes that torchrun started, if it did.

        Raises:
            ConfigurationError: torchrun's variables are wrong, or no process answers.
        """
        here = cls.told()
        if here.several:
            on_gpu = torch.device(device).type == "cuda"
            if on_gpu:
                torch.cuda.set_device(device)
            try:
                distributed.init_process_group("cpu:gloo,cuda:nccl" if on_gpu else "gloo")
            except (ValueError, RuntimeError) as error:
                raise ConfigurationError(
                    f"the other processes of the run cannot be joined: {one_line(error)}; start all of them with torchrun, or "
                    "unset WORLD_SIZE"
                ) from error
        return here

    def leave(self) -> None:
        """Leave the group in order; a process that lost another one just ends."""
        if self.several and distributed.is_initialized():
            distributed.destroy_process_group()

    @property
    def several(self) -> bool:
        """True if there are other processes."""
        return self.count > 1

    def average(self, values: torch.Tensor) -> None:
        """Replace a tensor by its mean over the processes."""
        if self.several:
            with _heard():
                distributed.all_reduce(values)
            values /= self.count

    def copy_first(self, tensors: Iterable[torch.Tensor]) -> None:
        """Give every process the first one's tensors."""
        if self.several:
            with _heard():
                for tensor in tensors:
                    distributed.broadcast(tensor.data, src=0)

    def largest(self, number: int) -> int:
        """Return the largest of the processes' numbers."""
        if not self.several:
            return number
        shared = torch.tensor(number)
        with _heard():
            distributed.all_reduce(shared, op=distributed.ReduceOp.MAX)
        return int(shared)

    def firsts(self, value: Any) -> Any:
        """Return the first process's value, plain data."""
        shared = [value]
        if self.several:
            with _heard():
                distributed.broadcast_object_list(shared, src=0, device=torch.device("cpu"))
        return shared[0]


@contextmanager
def _heard() -> Iterator[None]:
    """Tell a lost connection from other errors."""
    try:
        yield
    except RuntimeError as error:
        words = str(error).partition("\n")[0].partition(". ")[0]
        raise ProcessLostError(f"another process has gone: {(words.partition('] ')[2] or words)[:200]}") from error


def own_device(asked: str | None, backend: str) -> str:
    """Return the torch device of this process. Raises ConfigurationError: there is no such device here."""
    asked = choose_device(backend) if asked is None else asked
    place, gpus = told_number("LOCAL_RANK", 0), torch.cuda.device_count()
    if asked == "cuda" and place >= gpus > 0:
        raise ConfigurationError(
            f"torchrun started more processes than this machine has GPUs ({gpus}); give --nproc-per-node {gpus}"
        )
    return choose_device(backend, f"cuda:{place}" if asked == "cuda" and gpus > 0 else asked)
