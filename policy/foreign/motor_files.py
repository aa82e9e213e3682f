"""Read actuator networks of others: the weights of a TorchScript file, without running its code, checked in the fence.

The file's pickle is read as data, its tensors become a ``MotorNetwork``, and the program, in a process of its own, must give the
same torques for random inputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ...files.parsing import one_line
from ...robots.motor_network import MotorNetwork, MotorNetworkError
from ..base import PolicyError, PolicySession
from .fence.archive import read_archive, read_limited
from .fence.child import Child
from .fence.pickles import REBUILD_TENSOR, Call, Storage, check_tensors, read_pickle
from .fence.script import check_script
from .torchscript_session import load_module

_TRIES = 32
_CALLS = 5


@dataclass(frozen=True, kw_only=True)
class Description:
    """How an actuator network is called."""

    error_sign: Literal[1, -1]
    """1: it takes target − position; −1: position − target."""
    activation: Literal["softsign", "tanh", "relu", "elu", "identity"] = "softsign"
    source: str = "a file of the user's"


KNOWN: Mapping[str, Description] = {
    "21e596737788d7328f28513643e88775a62ef60bf31bdbd0b8fc796928bdb135": Description(
        error_sign=1,
        source="leggedrobotics/legged_gym 8fa29ac, resources/actuator_nets/anydrive_v3_lstm.pt, BSD-3-Clause",
    ),
    "d7ae096eb4cbee2ff40e394bbee07c6d95fef340007531ca0eb97ea3367b1027": Description(
        error_sign=-1,
        activation="softsign",
        source="Improbable-AI/walk-these-ways 0e7236b, resources/actuator_nets/unitree_go1.pt, MIT",
    ),
}
"""Public networks by the SHA-256 of their files."""


def read_motor_file(path: Path, description: Description | None = None) -> MotorNetwork:
    """Read a TorchScript file of one linear layer or more, perhaps behind LSTM layers.

    Args:
        description: how it is called; None for a public file in ``KNOWN``.

    Raises:
        MotorNetworkError: an unknown file without a description, another shape, or a program that gives other torques.
        PolicyError: the file cannot be read, or its program fails or is refused.
    """
    source = one_line(path)
    data = read_limited(path)
    digest = sha256(data).hexdigest()
    description = description or KNOWN.get(digest)
    if description is None:
        raise MotorNetworkError(
            f"'{source}' is no public actuator network that is known; say how it is called with --error"
        )
    check_script(data, source=source)
    network = _network(_tensors(data, source), description, source)
    network = replace(network, source=f"{description.source}, sha256 {digest}")
    _compare(network, data, source)
    return network


def _tensors(data: bytes, source: str) -> list[np.ndarray[Any, Any]]:
    """Return the tensors of the program's data in their order, without running anything."""
    records = read_archive(data, source=source)
    calls = [
        call for call in read_pickle(records["data.pkl"], source=source).calls if call.function.name == REBUILD_TENSOR
    ]
    check_tensors(iter(calls), {k.removeprefix("data/"): len(v) for k, v in records.items()}, source=source)
    found: dict[str, np.ndarray[Any, Any]] = {}
    for call in calls:
        storage, offset, shape, _ = call.arguments[:4]
        if isinstance(call, Call) and isinstance(storage, Storage) and storage.dtype == torch.float32:
            values = np.frombuffer(records[f"data/{storage.key}"], dtype="<f4")
            found.setdefault(storage.key, values[offset : offset + int(np.prod(shape))].reshape(shape))
    return list(found.values())


def _network(tensors: list[np.ndarray[Any, Any]], description: Description, source: str) -> MotorNetwork:
    """Return a network of scales (1, 1, 2) and (1), LSTM layers in torch's order, and linear layers."""
    scales: dict[str, Any] = {"error_scale": 1.0, "velocity_scale": 1.0, "torque_scale": 1.0}
    rest = list(tensors)
    if len(rest) > 1 and rest[0].shape == (1, 1, 2) and rest[1].shape == (1,):
        first, second = rest.pop(0).flatten(), rest.pop(0)
        scales = {"error_scale": float(first[0]), "velocity_scale": float(first[1]), "torque_scale": float(second[0])}
    arrays: dict[str, Any] = {}
    layer = 0
    while len(rest) >= 4 and rest[2].ndim == rest[3].ndim == 1 and rest[0].ndim == rest[1].ndim == 2:
        enter, hidden, one, two = rest[:4]
        if not len(enter) == len(hidden) == len(one) == len(two) == 4 * hidden.shape[1]:
            break
        arrays |= {f"lstm_{layer}_input": enter, f"lstm_{layer}_hidden": hidden, f"lstm_{layer}_bias": one + two}
        rest, layer = rest[4:], layer + 1
    if len(rest) % 2 or not rest:
        raise MotorNetworkError(f"'{source}' is neither linear layers nor LSTM layers with linear ones behind them")
    for i in range(len(rest) // 2):
        arrays |= {f"weight_{i}": rest[2 * i], f"bias_{i}": rest[2 * i + 1]}
    try:
        return MotorNetwork(
            kind="lstm" if layer else "feed-forward",
            error_sign=description.error_sign,
            activation=description.activation,
            arrays=arrays,
            **scales,
        )
    except MotorNetworkError as problem:
        raise MotorNetworkError(f"'{source}' is no actuator network that is known: {problem}") from problem


class _MotorProgram:
    """The program where it runs."""

    def __init__(self, data: bytes, source: str) -> None:
        self._module, self._source = load_module(data, source=source), source

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the torques of ``inputs``, (calls, rows, width), a row a joint of its own; ``hidden`` (layers, units) for an LSTM."""
        inputs = torch.tensor(request["inputs"], dtype=torch.float32)
        layers, units = request["hidden"]
        memory = tuple(torch.zeros(layers, inputs.shape[1], units) for _ in range(2))
        torques = []
        try:
            with torch.inference_mode():
                for rows in inputs:
                    if layers:
                        torque, memory = self._module(rows[:, None], memory)
                    else:
                        torque = self._module(rows)
                    torques.append(torque.reshape(-1).tolist())
        except (RuntimeError, TypeError, ValueError) as problem:
            raise PolicyError(f"'{self._source}' fails as an actuator network: {one_line(problem)}") from problem
        return {"torques": torques}

    def session(self, rows: int, *, rowwise: bool) -> PolicySession:
        """Raise ``PolicyError``: motors have no sessions."""
        raise PolicyError(f"'{self._source}' is no policy")


def _compare(network: MotorNetwork, data: bytes, source: str) -> None:
    """Refuse a network that gives other torques than the program that it was read from."""
    from ...backends.network_motors import NetworkState

    random = np.random.default_rng(0)
    raw = random.normal(size=(_CALLS, 2, _TRIES)).astype(np.float32) * np.array([0.5, 4.0], dtype=np.float32)[:, None]
    state = NetworkState(network, 1, _TRIES, torch.device("cpu"))
    every = torch.ones(1, dtype=torch.bool)
    ours, inputs = [], []
    past = np.zeros((network.history + _CALLS, 2, _TRIES), dtype=np.float32)
    for call in range(_CALLS):
        error, velocity = raw[call]
        ours.append(state.call(torch.tensor(error)[None], torch.tensor(velocity)[None], every)[0].numpy())
        past = np.concatenate([raw[call][None], past[:-1]])
        seen = past[: network.history].copy()
        seen[:, 0] *= network.error_sign
        inputs.append(seen.transpose(2, 1, 0).reshape(_TRIES, -1).tolist())
    child = Child(_MotorProgram, data, source=source)
    theirs = child.ask("torques", inputs=inputs, hidden=[network.lstm_layers, network.hidden])["torques"]
    apart = float(np.abs(np.array(ours) - np.array(theirs)).max())
    if apart > 1e-3:
        raise MotorNetworkError(
            f"'{source}' gives torques that differ by {apart:.3g} N·m from its layers read as a network with '{network.activation}' "
            "between them; choose another --activation"
        )
