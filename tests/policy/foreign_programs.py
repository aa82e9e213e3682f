"""Small TorchScript programs, and how a file that is refused is loaded."""

import io
import warnings
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.loading import load_policy
from torch import nn


class Plain(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(45, 12)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(observation)


def script(module: nn.Module) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(module.eval()), buffer)
    return buffer.getvalue()


def refused(path: Path, named: str, **options: bool) -> str:
    with pytest.raises(PolicyError, match=named) as caught:
        load_policy(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)
