"""A backend that stands before another one, for those that change a single thing of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, ClassVar

from .base import CAPABILITY_NAMES, Capability, PhysicsBackend, Scene, Support


def _handed_on(name: str) -> Callable[..., Any]:
    """Return a method that calls the method of this name of the backend behind."""
    return lambda self, *arguments, **options: getattr(self.inner, name)(*arguments, **options)


class WrappedBackend(PhysicsBackend):
    """Hands every call on to the backend behind it."""

    name: ClassVar[str] = "wrapped"

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Those of the engine behind it, which alone knows them."""
        noted = Capability(support=Support.APPROXIMATE, note="what the engine behind it does")
        return dict.fromkeys(CAPABILITY_NAMES, noted)

    def __init__(self, inner: PhysicsBackend, scene: Scene | None = None) -> None:
        """Stand before ``inner``; ``scene`` is the one shown to the outside, None for its own."""
        self.inner = inner
        self.scene = scene or inner.scene
        self.device, self.dtype = inner.device, inner.dtype

    engine_seconds: Any = property(attrgetter("inner.engine_seconds"))
    state: Any = property(attrgetter("inner.state"))
    sample: Any = property(attrgetter("inner.sample"))
    reset = _handed_on("reset")
    step = _handed_on("step")
    randomize = _handed_on("randomize")
    push = _handed_on("push")
    apply_force = _handed_on("apply_force")
    describe = _handed_on("describe")
    close = _handed_on("close")
