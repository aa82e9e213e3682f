"""Simulate worlds: the physics contract and one package per engine."""

from .base import (
    BackendError,
    Capability,
    PhysicsBackend,
    PhysicsOptions,
    PhysicsState,
    Randomization,
    ResetState,
    Scene,
    Support,
)
from .registry import backend_class, backend_names, make_backend

__all__ = [
    "BackendError", "Capability", "PhysicsBackend", "PhysicsOptions", "PhysicsState", "Randomization", "ResetState",
    "Scene", "Support", "backend_class", "backend_names", "make_backend",
]  # fmt: skip
