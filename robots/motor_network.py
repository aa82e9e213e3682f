"""Motors learned on a real robot: a small network from errors and speeds of a joint to its torque, as plain arrays."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..files.parsing import Text, check_fields, one_line, shown

Array = NDArray[np.float32]
ACTIVATIONS = ("softsign", "tanh", "relu", "elu", "identity")
LARGEST = 10_000_000
"""Largest size of a network's file, unpacked [bytes]."""
_FORMAT = "gaitgauge motor network 1"
_Scale = Annotated[float, Field(gt=0.0, le=1e4)]


class MotorNetworkError(ValueError):
    """A motor network that cannot be used; the message says what is wrong and what to change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotorNetwork:
    """One network for all joints; a call takes each joint alone.

    Its inputs are ``error_sign · (target − position) · error_scale`` [rad] and ``velocity · velocity_scale`` [rad/s] of this
    call and, for a feed-forward network, of the calls before: all errors, newest first, then all velocities. Its output times
    ``torque_scale`` is the torque [N·m]. Limits, strength and offsets of motors act outside of it.
    """

    kind: Literal["feed-forward", "lstm"]
    period: Annotated[float, Field(gt=0.0, le=0.1)] = 0.005
    """Time between calls, for which a torque is held [s]."""
    error_sign: Literal[1, -1] = 1
    """1 for a network of target − position, −1 for one of position − target."""
    error_scale: _Scale = 1.0
    velocity_scale: _Scale = 1.0
    torque_scale: _Scale = 1.0
    activation: Literal["softsign", "tanh", "relu", "elu", "identity"] = "softsign"
    """Between the layers of a feed-forward network."""
    source: Text = "unknown"
    """Origin, licence and digest of the file that it was read from."""
    arrays: Mapping[str, Any] = field(default_factory=dict)
    """``weight_0``, ``bias_0`` … of the linear layers; LSTM layers add ``lstm_0_input``, ``lstm_0_hidden``, ``lstm_0_bias`` …,
    gates in the order input, forget, cell, output."""

    def __post_init__(self) -> None:
        check_fields(self, "motor network", MotorNetworkError)
        arrays = {name: np.asarray(value, dtype=np.float32) for name, value in self.arrays.items()}
        object.__setattr__(self, "arrays", arrays)
        if not all(np.isfinite(value).all() for value in arrays.values()):
            raise MotorNetworkError("motor network: its weights are not all finite numbers")
        width = self.inputs
        for i in range(self.lstm_layers):
            names = [f"lstm_{i}_{part}" for part in ("input", "hidden", "bias")]
            hidden = self.hidden
            self._check(names, ((4 * hidden, width), (4 * hidden, hidden), (4 * hidden,)))
            width = hidden
        for i in range(self.layers):
            weight = arrays[f"weight_{i}"]
            out = 1 if i == self.layers - 1 else len(weight)
            self._check([f"weight_{i}", f"bias_{i}"], ((out, width), (out,)))
            width = out
        if not self.layers:
            raise MotorNetworkError("motor network: it lacks weight_0; a linear layer must give the torque")

    def _check(self, names: list[str], shapes: tuple[tuple[int, ...], ...]) -> None:
        for name, shape in zip(names, shapes, strict=True):
            value = self.arrays.get(name)
            if value is None or value.shape != shape:
                found = "is missing" if value is None else f"has the shape {value.shape}"
                raise MotorNetworkError(f"motor network: {name} {found}; it must be {shape}")

    @property
    def layers(self) -> int:
        """Return the number of linear layers."""
        return sum(name.startswith("weight_") for name in self.arrays)

    @property
    def lstm_layers(self) -> int:
        """Return the number of LSTM layers."""
        return sum(name.endswith("_hidden") for name in self.arrays) if self.kind == "lstm" else 0

    @property
    def hidden(self) -> int:
        """Return the number of units of an LSTM layer; 0 without one."""
        return int(self.arrays["lstm_0_hidden"].shape[-1]) if self.lstm_layers else 0

    @property
    def inputs(self) -> int:
        """Return the number of inputs: two for each call that a network sees."""
        first = self.arrays.get("lstm_0_input" if self.kind == "lstm" else "weight_0")
        if first is None or first.ndim != 2 or first.shape[1] % 2 or (self.kind == "lstm" and first.shape[1] != 2):
            found = "nothing" if first is None else f"an array of shape {first.shape}"
            raise MotorNetworkError(
                f"motor network: its first layer is {found}; it must take errors and as many velocities"
            )
        return int(first.shape[1])

    @property
    def history(self) -> int:
        """Return the number of calls that a call sees, itself included."""
        return self.inputs // 2


_FIELDS = ("kind", "period", "error_sign", "error_scale", "velocity_scale", "torque_scale", "activation", "source")


def save_motor_network(network: MotorNetwork, path: Path) -> None:
    """Write a network as an ``.npz`` file of plain arrays."""
    from ..files.writing import replacing

    values: dict[str, Any] = {name: np.array(getattr(network, name)) for name in _FIELDS} | dict(network.arrays)
    with replacing(path, MotorNetworkError, ending=".npz") as partial:
        np.savez(partial, format=np.array(_FORMAT), **values)


def load_motor_network(path: str | Path) -> MotorNetwork:
    """Read a network; raise ``MotorNetworkError`` for a file that is missing, damaged or of another format."""
    file = Path(path)
    source = f"motor network '{one_line(file)}'"
    try:
        with zipfile.ZipFile(file) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
                raise MotorNetworkError(f"{source} is larger than {LARGEST / 1e6:g} MB")
        with np.load(file, allow_pickle=False) as opened:
            data = {name: opened[name] for name in opened.files}
    except OSError as problem:
        raise MotorNetworkError(f"{source} cannot be read: {(problem.strerror or str(problem)).lower()}") from problem
    except (ValueError, zipfile.BadZipFile, EOFError, KeyError) as problem:
        if isinstance(problem, MotorNetworkError):
            raise
        raise MotorNetworkError(f"{source} is no .npz file: {one_line(problem)}") from problem
    found = str(data.pop("format", ""))
    if found != _FORMAT:
        convert = "convert a TorchScript file with gaitgauge robot motor"
        raise MotorNetworkError(f"{source} has the format {shown(found)}, not '{_FORMAT}'; {convert}")
    values = {name: data.pop(name).item() for name in _FIELDS if name in data}
    try:
        return MotorNetwork(**values, arrays=data)
    except MotorNetworkError as problem:
        raise MotorNetworkError(f"{source}: {problem}") from problem
