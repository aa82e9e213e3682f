"""A digest of what a policy is once it is loaded, whichever files it came from."""

from __future__ import annotations

import hashlib
import json

import torch

from .native import FilePolicy, ForeignFile


def policy_digest(policy: FilePolicy) -> str:
    """SHA-256, hexadecimal, over the contract and the whole network.

    A file's own digest would not do: weights may lie beside an ONNX file, gains in a ``deploy.yaml``, and the activation of a
    checkpoint in an ``agent.yaml``.
    """
    total = hashlib.sha256(policy.contract.hash.encode())
    stored = policy.stored
    if isinstance(stored, ForeignFile):
        total.update(stored.kind.encode())
        total.update(stored.data)
        return total.hexdigest()
    total.update(json.dumps([stored.architecture, dict(stored.arguments)], sort_keys=True).encode())
    for name, tensor in sorted(stored.state_dict.items()):
        total.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        total.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()
