"""Find engines by name: the project's own, and plug-ins of the entry-point group ``gaitgauge.backends``.

A name may carry a variant after a colon (``newton:steel``), which selects the engine's solver.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec

from ..files.parsing import one_line, shown
from ..files.plugins import guarded, load_plugin, origin, plugins
from .base import BackendError, DeviceError, PhysicsBackend, Randomization, Scene, Support

GROUP = "gaitgauge.backends"


@dataclass(frozen=True, kw_only=True)
class BackendListing:
    """Facts about an engine that need no import of it."""

    name: str
    """Registry name."""
    device: str
    """Device that the engine is made for: ``CPU``, ``GPU``, or ``?`` where only the engine knows."""
    note: str
    """One line for people."""
    missing: tuple[str, ...]
    """Packages that the engine needs and that are not installed."""
    install: str
    """Command that installs them."""
    version: str
    """Versions of its packages, empty where they are not installed or not known."""
    terms: str
    """Licence, empty where it is not known."""


@dataclass(frozen=True, kw_only=True)
class _Own:
    """An engine of the project."""

    place: str
    """Module and class."""
    device: str
    packages: tuple[str, ...]
    note: str
    distributions: tuple[str, ...]
    """Names of the engine's own package in pip, and of packages under other terms that it needs."""
    terms: str
    extra: str = ""
    """Extra of gaitgauge that installs the engine; empty where it always is."""


_SLOW = "runs on the CPU slowly (--device cpu)"
_OTHER_SOLVER = "newton:SOLVER runs another one (newton:steel)"
_MOSEK = "its dependency Mosek is proprietary and not used"
_OWN: dict[str, _Own] = {
    "mujoco": _Own(
        place=".mujoco:MujocoBackend",
        device="CPU",
        packages=("mujoco",),
        note="MuJoCo on a thread pool, float64, the same on any number of threads; the judge",
        distributions=("mujoco",),
        terms="Apache-2.0",
    ),
    "mujoco-warp": _Own(
        place=".mujoco_warp:MujocoWarpBackend",
        device="GPU",
        packages=("mujoco_warp", "warp"),
        note=f"MuJoCo's equations on the GPU, float32; trains; {_SLOW}",
        distributions=("mujoco-warp",),
        terms="Apache-2.0",
    ),
    "newton": _Own(
        place=".newton:NewtonBackend",
        device="GPU",
        packages=("newton", "mujoco_warp", "warp"),
        note=f"Newton with its MuJoCo solver; {_OTHER_SOLVER}",
        distributions=("newton",),
        terms="Apache-2.0",
    ),
    "drake": _Own(
        place=".drake.backend:DrakeBackend",
        device="CPU",
        packages=("pydrake",),
        note="Drake with its SAP solver, float64; an independent judge",
        distributions=("drake",),
        terms=f"BSD-3-Clause; {_MOSEK}",
        extra="drake",
    ),
    "physx": _Own(
        place=".physx.backend:PhysxBackend",
        device="CPU",
        packages=("ovphysx", "ovstage", "physx_usd_schemas"),
        note="NVIDIA PhysX by ovphysx, float32; an independent judge",
        distributions=("ovphysx", "ovstage"),
        terms="proprietary: NVIDIA Omniverse licence (ovphysx), NVIDIA's own (ovstage)",
        extra="physx",
    ),
}


def backend_names() -> list[str]:
    """Return the names of all engines, the project's own first."""
    return list(_OWN) + sorted(set(plugins(GROUP)) - set(_OWN))


def list_backends() -> list[BackendListing]:
    """Return a listing for each of ``backend_names()`` without importing any engine."""
    found = plugins(GROUP)
    listings = []
    for name in backend_names():
        if own := _OWN.get(name):
            device, packages, note, terms = own.device, own.packages, own.note, own.terms
            versions = own.distributions
        else:
            value = one_line(found[name].value, 80)
            device, packages, note = "?", (value.partition(":")[0].partition(".")[0],), f"plug-in, {value}"
            terms, versions = "", ()
        missing = tuple(p for p in packages if not p.isidentifier() or find_spec(p) is None)
        listings.append(
            BackendListing(
                name=name,
                device=device,
                note=note,
                missing=missing,
                install=_install(name, missing) if missing else "",
                version="" if missing else ", ".join(f"{each} {version(each)}" for each in versions),
                terms=terms,
            )
        )
    return listings


def _install(name: str, missing: Sequence[str]) -> str:
    """Return the command that installs what an engine lacks."""
    own = _OWN.get(name)
    if own is not None and own.extra:
        return f"pip install 'gaitgauge[{own.extra}]'"
    return "pip install " + " ".join(each.replace("_", "-") for each in missing)


def backend_class(name: str) -> type[PhysicsBackend]:
    """Import the engine's class; raise ``BackendError`` for an unknown name or a missing package."""
    engine = name.partition(":")[0]
    try:
        if engine in _OWN:
            module, _, attribute = _OWN[engine].place.partition(":")
            found = getattr(import_module(module, __package__), attribute)
        else:
            plugin = plugins(GROUP).get(engine)
            if plugin is None:
                known = ", ".join(backend_names())
                raise BackendError(f"unknown backend '{one_line(name, 80)}'; choose one of: {known}")
            found = load_plugin(plugin, BackendError)
            if not (isinstance(found, type) and issubclass(found, PhysicsBackend)):
                gave = shown(type(found).__name__)
                raise BackendError(f"{origin(plugin)} gave {gave}; it must be a subclass of PhysicsBackend")
            guarded(plugin, BackendError, found.capabilities)
    except ModuleNotFoundError as error:
        command = _install(engine, (error.name or "",))
        missing = f"needs the package '{error.name}', which is not installed: {command}"
        raise BackendError(f"backend '{name}' {missing}") from error
    except (ImportError, OSError) as error:  # such as a library of the system that a package was linked with
        own = _OWN.get(engine)
        anew = f", or the engine anew: {_install(engine, own.packages)}" if own else ""
        raise BackendError(
            f"backend '{name}' is installed but cannot be loaded ({one_line(error)}); install what it lacks{anew}"
        ) from error
    return found


def find_backend(name: str, device: str) -> type[PhysicsBackend]:
    """Return the class that ``make_backend`` builds, with variant and device checked.

    Raises:
        BackendError: unknown engine, variant or device, or a missing package.
        DeviceError: the machine lacks the device, or the engine cannot use it.
    """
    from .devices import find_device  # lists of engines must not wait for torch

    found = engine_class(name)
    find_device(device, found.name, gpu=_can_use_gpu(found))
    return found


def choose_device(name: str, asked: str | None = None) -> str:
    """Return the device of an engine: the device asked for, else a GPU where the engine can use one, else the CPU.

    Raises:
        BackendError: as ``find_backend``.
        DeviceError: as ``find_backend``, or an engine made for a GPU on a machine without one.
    """
    from torch import cuda

    found = find_backend(name, "cpu" if asked is None else asked)
    if asked is not None:
        return asked
    wants_gpu = made_for_gpu(name)
    if wants_gpu and not cuda.is_available():
        change = "add --device cpu (slow), or use --backend mujoco"
        raise DeviceError(f"backend '{name}' wants a GPU and this machine has none", change)
    foreign = name.partition(":")[0] not in _OWN
    return "cuda" if wants_gpu or (foreign and _can_use_gpu(found) and cuda.is_available()) else "cpu"


def made_for_gpu(name: str) -> bool:
    """Return whether an engine of the project, with or without a variant, is made for a GPU."""
    own = _OWN.get(name.partition(":")[0])
    return own is not None and own.device == "GPU"


def _can_use_gpu(found: type[PhysicsBackend]) -> bool:
    return found.capabilities()["gpu"].support is not Support.NONE


def make_backend(name: str, scene: Scene, *, device: str = "cpu", threads: int = 1) -> PhysicsBackend:
    """Build the worlds of ``scene`` in the engine ``name`` (``mujoco``, ``newton:steel`` …), with its offsets and motors by network.

    Raises:
        BackendError: unknown engine, missing package, or a scene that the engine cannot simulate.
    """
    found, plugin = engine_class(name), plugins(GROUP).get(name.partition(":")[0])
    build: Callable[[], PhysicsBackend] = partial(found, scene, device=device, threads=threads)
    if scene.robot.velocity_joints and not found.velocity_targets:
        raise BackendError(
            f"engine '{name}' has no targets of velocity, which {', '.join(scene.robot.velocity_joints)} of robot "
            f"'{scene.robot.name}' need; choose another --backend"
        )
    if scene.parameters.motor == "network":
        from .network_motors import NetworkMotors

        build = partial(NetworkMotors, scene, device=device, threads=threads, engine=found)
    made = build() if plugin is None or name.partition(":")[0] in _OWN else guarded(plugin, BackendError, build)
    if scene.parameters.target_offset is not None:
        import torch

        offset = torch.tensor([scene.parameters.target_offset], dtype=made.dtype, device=made.device)
        made.randomize(Randomization(motor_offset=offset.repeat(made.num_worlds, 1)))
    return made


def engine_class(name: str) -> type[PhysicsBackend]:
    """Return the engine's class with the named solver; raise as ``backend_class`` does."""
    found = backend_class(name)
    variant = name.partition(":")[2]
    if not variant:
        return found
    with_variant = getattr(found, "with_solver", None)
    if with_variant is None:
        problem = f"backend '{found.name}' has no solvers to choose from, so '{name}' cannot be built"
        raise BackendError(f"{problem}; use '{found.name}'")
    return with_variant(variant)
