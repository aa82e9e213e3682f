"""The global random generators: seeding them, and keeping their states in a checkpoint."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ...files.parsing import shown

_WORDS = 624
"""Words of the state of a Mersenne Twister."""


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, NumPy and PyTorch (CPU and all GPUs)."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def random_state(device: torch.device | str) -> dict[str, Any]:
    """Return the states of the global generators of Python, NumPy and PyTorch (CPU and ``device``), as tensors and plain data."""
    version, words, gauss = random.getstate()
    name, keys, position, has_gauss, cached = np.random.get_state()  # type: ignore[misc]
    words_of_numpy = np.asarray(keys).astype(np.int64)
    state: dict[str, Any] = {
        "python": [version, list(words), gauss],
        "numpy": [str(name), torch.from_numpy(words_of_numpy), int(position), int(has_gauss), float(cached)],
        "torch": torch.get_rng_state(),
    }
    if torch.device(device).type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def restore_random_state(state: Mapping[str, Any], device: torch.device | str) -> None:
    """Put back a ``random_state``; a missing GPU state leaves that generator as it is.

    Raises:
        ValueError: NumPy's generator would read outside its own words.
        ArithmeticError, LookupError, RuntimeError, TypeError, AttributeError: it is no such state.
    """
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    name, keys, position, has_gauss, cached = state["numpy"]
    keys = keys.numpy().astype(np.uint32)
    if name != "MT19937" or keys.shape != (_WORDS,) or not 0 <= position <= _WORDS:  # NumPy does not look
        raise ValueError(f"NumPy's random state is at word {shown(position)} of {_WORDS}")
    np.random.set_state((name, keys, position, has_gauss, cached))
    torch.set_rng_state(state["torch"])
    if torch.device(device).type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)
