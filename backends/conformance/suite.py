"""Run the checks against an engine and return the outcome of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from time import perf_counter

from ...robots import Robot, load_robot
from ..base import CAPABILITY_NAMES, BackendError, PhysicsBackend, Scene, Support, unsupported
from ..registry import engine_class, make_backend
from . import contact, disturbance, friction, ground, health, kinematics, legs, model, motors, refusal, soles, stepping
from .bench import Bench
from .check import ENGINE_ERRORS, Check, registered

ROOMS = (kinematics, motors, stepping, health, contact, soles, legs, ground, friction, model, disturbance, refusal)


class Outcome(Enum):
    """Outcome of a check."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_SUPPORTED = "not supported"
    """The engine declares no support; ``refusal/…`` checks that it refuses."""


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """Result of one check."""

    name: str
    outcome: Outcome
    detail: str
    """The measured values, the fault, or the capabilities that the engine lacks."""
    seconds: float
    """Wall-clock time [s]."""


def all_checks() -> tuple[Check, ...]:
    """Return all checks in the order in which they run, the fundamental ones first."""
    return tuple(check for room in ROOMS for check in registered(room.__name__))


def run_check(check: Check, bench: Bench) -> CheckResult:
    """Run one check; an error in the engine is a failed check."""
    start = perf_counter()
    missing = unsupported(check.needs, bench.capabilities)
    if missing:
        outcome = Outcome.NOT_SUPPORTED
        notes = {name: bench.capabilities[name].note for name in missing}
        none = Support.NONE.value
        detail = ", ".join(f"{name}: {none}" + (f" ({note})" if note else "") for name, note in notes.items())
    else:
        try:
            outcome, detail = Outcome.PASSED, check.run(bench)
        except ENGINE_ERRORS as error:
            kind = "" if isinstance(error, AssertionError) else f"{type(error).__name__}: "
            outcome, detail = Outcome.FAILED, f"{kind}{error}"
    return CheckResult(name=check.name, outcome=outcome, detail=detail, seconds=perf_counter() - start)


def make_bench(backend: str | type[PhysicsBackend], device: str = "cpu", *, robot: Robot | None = None) -> Bench:
    """Return the test bench of an engine, for ``run_check``.

    Args:
        backend: registry name (``mujoco``, ``newton:steel``, a plug-in's name), or a class.
        device: of the engine's worlds, ``cpu`` or ``cuda``.
        robot: the robot in the scenes, four-legged with spherical feet; None for the Go2.

    Raises:
        BackendError: the engine is unknown or not installed, or does not declare all capabilities, or the robot has not four feet.
    """
    if robot is not None and len(robot.foot_names) != 4:
        told = f"robot '{robot.name}' has {len(robot.foot_names)} feet, and conformance takes one that stands on four"
        raise BackendError(f"{told}; leave robot out: the checks named soles/ bring a robot of two legs")
    name = backend if isinstance(backend, str) else backend.name
    found = engine_class(name) if isinstance(backend, str) else backend
    capabilities = found.capabilities()
    undeclared = [n for n in CAPABILITY_NAMES if n not in capabilities]
    if undeclared:
        missing = f"does not declare {', '.join(undeclared)}; capabilities() needs one entry for each"
        raise BackendError(f"backend '{name}' {missing}")

    def make(scene: Scene, on: str) -> PhysicsBackend:
        return make_backend(name, scene, device=on) if isinstance(backend, str) else found(scene, device=on)

    return Bench(make=make, capabilities=capabilities, robot=robot or load_robot("go2"), device=device)


def run_conformance(
    backend: str | type[PhysicsBackend],
    device: str = "cpu",
    *,
    robot: Robot | None = None,
    only: Sequence[str] = (),
    report: Callable[[CheckResult], None] | None = None,
) -> list[CheckResult]:
    """Run the conformance checks against an engine and return one result for each.

    Args:
        only: beginnings of the names of the checks to run (``motors``, ``contact/rest``); empty for all.

    Raises:
        BackendError: no check has such a name, or as ``make_bench``.
    """
    bench = make_bench(backend, device, robot=robot)
    chosen = [c for c in all_checks() if not only or any(c.name.startswith(o) for o in only)]
    if not chosen:
        known = ", ".join(sorted({c.name.partition("/")[0] for c in all_checks()}))
        raise BackendError(f"no conformance check begins with {', '.join(map(repr, only))}; choose from {known}")
    results = []
    for each in chosen:
        result = run_check(each, bench)
        if report is not None:
            report(result)
        results.append(result)
    return results
