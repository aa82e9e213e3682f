"""Which GPU each process of a training takes."""

from __future__ import annotations

import os

import torch

from ..backends.registry import choose_device
from ..files.parsing import shown
from .configuration import ConfigurationError


def told_number(name: str, default: int) -> int:
    """A number that torchrun tells its processes in their environment.

    Raises:
        ConfigurationError: it is none.
    """
    text = os.environ.get(name, str(default))
    if not (text.isascii() and text.isdecimal() and len(text) < 7):
        raise ConfigurationError(
            f"the environment variable {name} is {shown(text)}; it must be a whole number, as torchrun makes it: unset it, or start "
            "the run with torchrun"
        )
    return int(text)


def own_device(asked: str | None, backend: str) -> str:
    """The torch device of this process.

    Raises:
        ConfigurationError: there is no such device here.
    """
    asked = choose_device(backend) if asked is None else asked
    place, gpus = told_number("LOCAL_RANK", 0), torch.cuda.device_count()
    if asked == "cuda" and place >= gpus > 0:
        raise ConfigurationError(
            f"torchrun started more processes than this machine has GPUs ({gpus}); give --nproc-per-node {gpus}"
        )
    return choose_device(backend, f"cuda:{place}" if asked == "cuda" and gpus > 0 else asked)


def idle_gpus(device: str) -> str:
    """A sentence on GPUs that no process of a run uses, empty if there are none."""
    processes = told_number("LOCAL_WORLD_SIZE", 0)
    gpus = torch.cuda.device_count() if device.startswith("cuda") else 0
    if not 0 < processes < gpus:
        return ""
    return (
        f"{processes} of {gpus} GPUs are used; --nproc-per-node {gpus} uses all, and CUDA_VISIBLE_DEVICES says which are "
        "meant."
    )
