"""What does the world do next? The physics contract and one module per engine."""

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
    "BackendError",
    "Capability",
    "PhysicsBackend",
    "PhysicsOptions",
    "PhysicsState",
    "Randomization",
    "ResetState",
    "Scene",
    "Support",
    "backend_class",
    "backend_names",
    "make_backend",
]
