"""An optimizer's moments out of a checkpoint: somebody else may have written it, and what does not fit is found before a step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch


def load_moments(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> float:
    """Take over what an Adam's ``state_dict()`` says of its moments; its settings stay those of this run.

    Args:
        optimizer: of the same parameters.
        state: from the checkpoint.

    Returns:
        The learning rate that it had, of the first group.

    Raises:
        ValueError: moments of other parameters or shapes, or an impossible learning rate.
        LookupError, TypeError, AttributeError: it is no such state.
    """
    own = optimizer.state_dict()["param_groups"]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = {}
    for number, saved in state["state"].items():
        if number not in range(len(parameters)):
            raise ValueError(f"there are moments of parameter {number!r}, of {len(parameters)}")
        shapes = {"step": (), "exp_avg": parameters[number].shape, "exp_avg_sq": parameters[number].shape}
        for name, shape in shapes.items():
            if saved[name].shape != shape:
                raise ValueError(
                    f"{name} of parameter {number} has shape {tuple(saved[name].shape)}, not {tuple(shape)}"
                )
        moments[number] = {name: saved[name] for name in shapes}
    rate = float(state["param_groups"][0]["lr"])
    if not 0.0 < rate < math.inf:
        raise ValueError(f"the learning rate is {rate:g}")
    optimizer.load_state_dict({"state": moments, "param_groups": own})
    return rate
