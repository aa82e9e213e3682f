"""A variant is an engine with some of the suite's physics options changed: what a study compares."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, get_type_hints

from ...backends.base import BackendError, PhysicsBackend, PhysicsOptions, Scene, Support
from ...backends.registry import choose_device, find_backend, make_backend
from ...files.parsing import from_text, one_line, shown
from .request import ConsistencyError
from .wrapping import PerturbedBackend, RetimedBackend

Value = bool | int | float | str | None


@dataclass(frozen=True, kw_only=True)
class Variant:
    """An engine as it is to be run."""

    backend: str
    """Registry name, with the solver after a colon."""
    device: str = "cpu"
    overrides: tuple[tuple[str, Value], ...] = ()
    """Fields of ``PhysicsOptions`` that differ from the suite's, sorted by name."""
    perturbation: float = 0.0
    """Largest relative change of the state at each reset."""
    draw: int = 0
    """Number of the perturbation."""
    rounding: bool = False
    """True where joint targets are late by the same time in every control step, as in single precision."""

    @property
    def label(self) -> str:
        """Name for people, and the text that ``parse_variant`` reads back but for perturbations."""
        changed = "".join(f"@{name}={_shown(value)}" for name, value in self.overrides)
        off = f"~{self.perturbation:g}{'r' if self.rounding else ''}#{self.draw}" if self.perturbation else ""
        return self.backend + changed + off

    @property
    def folder(self) -> str:
        """Name of the variant's folder."""
        return re.sub(r"[^A-Za-z0-9._=@~#-]", "-", self.label)

    def switched(self, name: str, value: Value) -> Variant:
        """The same engine with one option changed."""
        return replace(self, overrides=tuple(sorted({**dict(self.overrides), name: value}.items())))

    def physics(self, suite: PhysicsOptions) -> PhysicsOptions:
        """The suite's options with the changes; another timestep brings another number of substeps.

        Raises:
            ConsistencyError: the timestep does not divide the control period.
        """
        changes: dict[str, Any] = dict(self.overrides)
        changed = replace(suite, **changes)
        if changed.timestep == suite.timestep:
            return changed
        count = suite.control_period / changed.timestep if changed.timestep > 0.0 else 0.0
        if round(count) < 1 or abs(count - round(count)) > 1e-6:
            raise ConsistencyError(
                f"timestep {changed.timestep:g} s does not divide the control period of {suite.control_period:g} s; "
                f"use for example {suite.control_period / 4:g} in '{self.label}'"
            )
        return replace(changed, substeps=round(count))

    def worlds(self, scene: Scene, *, threads: int) -> PhysicsBackend:
        """Build the worlds of a scene that has the suite's physics options.

        Raises:
            BackendError: the engine cannot do what the scene or the variant asks for.
        """
        physics = self.physics(scene.physics)
        backend = make_backend(self.backend, replace(scene, physics=physics), device=self.device, threads=threads)
        if physics.timestep != scene.physics.timestep:
            backend = RetimedBackend(backend, scene)
        if self.perturbation:
            backend = PerturbedBackend(backend, self.perturbation, draw=self.draw, targets=self.rounding)
        return backend


def parse_variant(text: str) -> Variant:
    """Read ``NAME``, ``NAME:SOLVER`` or ``NAME@option=value@option=value``; the device is left to ``place``.

    Raises:
        ConsistencyError: a malformed text, an unknown option or a value of another type.
    """
    backend, *changes = text.strip().split("@")
    if not backend:
        raise ConsistencyError(f"{shown(text)} names no engine; write for example mujoco or mujoco@timestep=0.005")
    hints = get_type_hints(PhysicsOptions, include_extras=True)
    free = [f.name for f in fields(PhysicsOptions) if f.name not in ("substeps", "watch_tilt", "watch_penetration")]
    overrides: dict[str, Value] = {}
    for change in changes:
        name, equals, value = change.partition("=")
        if not equals or name not in free:
            raise ConsistencyError(
                f"'@{one_line(change, 80)}' in {shown(text)} is no physics option; "
                f"write @option=value with one of {', '.join(free)}"
            )
        overrides[name] = from_text(hints[name], value, f"@{name}", ConsistencyError)
    return Variant(backend=backend, overrides=tuple(sorted(overrides.items())))


def parse_variants(texts: Iterable[str]) -> dict[str, Variant]:
    """Return what ``parse_variant`` reads in each text, by label.

    Raises:
        ConsistencyError: as there, or two texts name the same engine with the same options.
    """
    found: dict[str, Variant] = {}
    for variant in map(parse_variant, texts):
        if variant.label in found:
            raise ConsistencyError(f"{shown(variant.label)} is named twice; name every engine once")
        found[variant.label] = variant
    return found


def place(variant: Variant, device: str | None) -> Variant:
    """Choose the device: the one asked for, or a GPU for the engines that are made for it.

    Raises:
        BackendError: the engine is not there, or wants a GPU and there is none.
    """
    on_gpu = find_backend(variant.backend, "cpu").capabilities()["gpu"].support is not Support.NONE
    wanted = "cpu" if device == "cpu" or not on_gpu else choose_device(variant.backend, device)
    return replace(variant, device=wanted)


def place_all(
    variants: Mapping[str, Variant], suite: PhysicsOptions, device: str | None, *, needed: Callable[[str, str], bool]
) -> tuple[dict[str, Variant], dict[str, str]]:
    """Choose the devices of engines, by label; the second value says why others cannot run on this machine.

    Raises:
        BackendError: one cannot run that is ``needed``, which takes its label and the reason.
        ConsistencyError: an impossible option.
    """
    placed: dict[str, Variant] = {}
    reasons: dict[str, str] = {}
    for label, variant in variants.items():
        variant.physics(suite)
        try:
            placed[label] = place(variant, device)
        except BackendError as error:
            if needed(label, str(error)):
                raise
            reasons[label] = str(error)
    return placed, reasons


def _shown(value: Value) -> str:
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and float(short := f"{value:g}") == value:
        return short
    return str(value)
