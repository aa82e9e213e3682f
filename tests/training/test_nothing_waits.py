"""A rollout only asks the device for work. Whatever waits for an answer lets the device stand still until the host has asked for more
(docs/reports/2026-11-27-performance.md has what one such wait a control step was worth).
"""

import pytest
import torch
from gaitgauge.training.configuration import METHODS
from gaitgauge.training.run.runner import TrainingRunner
from small_environment import STAIRS, make
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from toy_training import toy_configuration

WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "lift_fresh")
"""Operations whose result or argument is on the host."""
CHECKED_ON_THE_HOST = ("normal.Tensor_Tensor", "normal.float_Tensor")
"""Operations that look at their arguments: torch.normal refuses negative deviations."""


class Waits(TorchDispatchMode):
    """Collects the operations that would wait for a GPU."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        name = function.__name__
        counts = name.split(".")[0] in ("index", "index_put", "index_put_") and any(
            index is not None and index.dtype == torch.bool for index in arguments[1]
        )
        if name.split(".")[0] in WAITS or name in CHECKED_ON_THE_HOST or counts:
            self.found.append(name)
        return function(*arguments, **(options or {}))


def outside(function):
    """The physics, which is no GPU's here, is not looked at."""

    def call(*arguments, **options):
        with _disable_current_modes():
            return function(*arguments, **options)

    return call


@pytest.mark.parametrize("method", METHODS)
def test_a_rollout_never_waits_for_the_device(method):
    env = make(8, terrain=STAIRS)
    for name in ("step", "reset", "push", "randomize"):
        setattr(env.backend, name, outside(getattr(env.backend, name)))
    configuration = toy_configuration(encoder="mlp", steps=4, algorithm={"method": method})
    runner = TrainingRunner(env, configuration, contract=env.contract, task="toy")
    obs = env.get_observations()
    with torch.inference_mode(), Waits() as waits:
        for _ in range(4):
            obs = runner.rollout_step(obs)
    assert waits.found == []


def test_waits_are_seen():
    with Waits() as waits:
        torch.normal(torch.zeros(3), torch.ones(3))
        torch.ones(3)[torch.ones(3) > 0]
        torch.ones(3).sum().item()
    assert waits.found == ["normal.Tensor_Tensor", "index.Tensor", "_local_scalar_dense.default"]
