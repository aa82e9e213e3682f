"""Finds engines by name: the project's own, and any installed under the entry-point group ``gaitgauge.backends``.

A name may carry a variant after a colon (``newton:kamino``); the variant is handed to the engine as ``solver``.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points

from .base import BackendError, PhysicsBackend, Scene

GROUP = "gaitgauge.backends"
_OWN = {
    "mujoco": ".mujoco:MujocoBackend",
    "mujoco-warp": ".mujoco_warp:MujocoWarpBackend",
    "newton": ".newton:NewtonBackend",
    "fake": ".fake:FakeBackend",
}


def backend_names() -> list[str]:
    """Names of all engines that can be asked for, the project's own first; ``fake`` is for tests and left out."""
    plugins = sorted({e.name for e in entry_points(group=GROUP)} - set(_OWN))
    return [n for n in _OWN if n != "fake"] + plugins


def backend_class(name: str) -> type[PhysicsBackend]:
    """The engine's class.

    Raises:
        BackendError: unknown name, or the engine's package is not installed.
    """
    engine = name.partition(":")[0]
    try:
        if engine in _OWN:
            module, _, attribute = _OWN[engine].partition(":")
            found = getattr(import_module(module, __package__), attribute)
        else:
            plugin = next((e for e in entry_points(group=GROUP) if e.name == engine), None)
            if plugin is None:
                raise BackendError(f"unknown backend '{name}'; choose one of: {', '.join(backend_names())}")
            found = plugin.load()
    except ImportError as error:
        raise BackendError(f"backend '{name}' needs the package '{error.name}', which is not installed: pip install {error.name}") from error
    return found


def make_backend(name: str, scene: Scene, *, device: str = "cpu", threads: int = 1) -> PhysicsBackend:
    """Build the worlds of ``scene`` in the engine ``name`` (``mujoco``, ``newton:kamino`` …).

    Raises:
        BackendError: unknown engine, missing package, or something the engine cannot do.
    """
    found = backend_class(name)
    variant = name.partition(":")[2]
    if not variant:
        return found(scene, device=device, threads=threads)
    with_variant = getattr(found, "with_solver", None)
    if with_variant is None:
        raise BackendError(f"backend '{found.name}' has no solvers to choose from, so '{name}' cannot be built; use '{found.name}'")
    return with_variant(variant)(scene, device=device, threads=threads)
