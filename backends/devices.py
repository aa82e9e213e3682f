"""Find the device that an engine computes on."""

from __future__ import annotations

import torch

from ..files.parsing import one_line, shown
from .base import BackendError, DeviceError


def find_device(name: str, backend: str, *, gpu: bool = True) -> torch.device:
    """Return the torch device of a name, with its number for a GPU.

    Args:
        name: ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        BackendError: no device has this name.
        DeviceError: the machine has no such device, or the engine does not run on it.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise BackendError(f"there is no device {shown(name)}; give cpu, cuda or cuda:N (--device)") from error
    if device.type not in ("cpu", "cuda"):
        raise BackendError(f"device {shown(name)} is not supported; give cpu, cuda or cuda:N (--device)")
    if device.type == "cpu":
        return torch.device("cpu")
    if not gpu:
        raise DeviceError(f"backend '{backend}' runs on the CPU, not on '{name}'", "use --device cpu, or mujoco-warp")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (device.index or 0) >= count:
        have = f"torch finds {count}" if count else "torch finds none (see 'gaitgauge doctor')"
        raise DeviceError(f"there is no GPU for device '{name}': {have}", "use --device cpu")
    if device.index is not None:
        return device
    try:
        return torch.device("cuda", torch.cuda.current_device())
    except (AssertionError, RuntimeError) as error:  # a torch for the CPU alone asserts
        reason = f"the GPU of device '{name}' cannot be used: {one_line(error)}"
        raise DeviceError(reason, "use --device cpu") from error
