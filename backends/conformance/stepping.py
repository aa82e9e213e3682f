"""Checks of the effects of a step and a reset: samples, masks, independence, repeatability."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..base import PhysicsState, Support
from .bench import WORLDS, Bench, Worlds, expect, expect_close
from .check import check
from .reference import Reference, level_stance

MOTION_FIELDS = (
    "base_position_w", "base_quaternion_w", "base_linear_velocity_w", "base_angular_velocity_b",
    "joint_position", "joint_velocity", "foot_position_w", "foot_velocity_w",
)  # fmt: skip


SPEEDS = np.linspace(0.0, 0.6, WORLDS)[:, None] * [1.0, 0.0, 0.0]
"""Velocity of each world's robot in ``stand`` [m/s], (N, 3)."""


def stand(bench: Bench, worlds: Worlds, *, speed: np.ndarray = SPEEDS, held: bool = True) -> None:
    """Reset all worlds just above level ground, each with another speed."""
    stance = level_stance(Reference(bench.robot, bench.soft()), clearance=0.02)
    worlds.reset(
        base_position=(0.0, 0.0, stance.height),
        base_quaternion=stance.quaternion,
        base_linear_velocity=speed,
        held_target=worlds.default_pose if held else None,
    )


@contextmanager
def twins(bench: Bench, *, periods: int = 0) -> Iterator[tuple[Worlds, Worlds]]:
    """Build the same worlds twice, which have stood for so many control periods."""
    with bench.worlds() as first, bench.worlds() as second:
        for each in (first, second):
            stand(bench, each)
            for period in range(periods):
                each.step(wave(each, period))
        yield first, second


def wave(worlds: Worlds, period: int) -> np.ndarray:
    """Return joint targets that differ in every world and control period, (N, J) [rad]."""
    phase = np.arange(worlds.count)[:, None] + np.arange(worlds.robot.num_joints)[None, :]
    return worlds.default_pose + 0.15 * np.sin(0.9 * period + phase)


def expect_same(what: str, first: SimpleNamespace, second: SimpleNamespace, rows: Iterable[int]) -> None:
    """Check that rows of two states are equal to the last bit."""
    chosen = list(rows)
    for field in fields(PhysicsState):
        a, b = getattr(first, field.name)[chosen], getattr(second, field.name)[chosen]
        equal = np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        expect(equal, f"{what}: state.{field.name} differs by {_difference(a, b):.3g}; it must not change at all")


def expect_same_motion(
    what: str, found: SimpleNamespace, wanted: SimpleNamespace, tolerance: float, rows: Any = slice(None)
) -> float:
    """Check that poses and joints of two states agree to a tolerance, velocities to 20 times that; return the bases' distance [m]."""
    errors = {}
    for name in MOTION_FIELDS:
        allowed = 20.0 * tolerance if "velocity" in name else tolerance
        errors[name] = expect_close(f"{name} {what}", getattr(found, name)[rows], getattr(wanted, name)[rows], allowed)
    return errors["base_position_w"]


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a.astype(np.float64) - b.astype(np.float64)).max())


@check("stepping/substeps")
def single_substeps(bench: Bench) -> str:
    """A control period equals its substeps taken one by one, contacts included."""
    with twins(bench) as (worlds, single):
        for period in range(6):
            target = wave(worlds, period)
            worlds.step(target)
            for _ in range(10):
                single.step(target, substeps=1)
        error = expect_same_motion("after 60 substeps", worlds.read(), single.read(), worlds.precision(1e-7, 5e-3))
    return f"base positions equal to {error:.1e} m"


@check("stepping/sample_at")
def sample_at(bench: Bench) -> str:
    """The sample is the state after the substep that each world asked for, forces included."""
    at = np.array([1, 4, 10, 7])
    with twins(bench, periods=1) as (worlds, single):
        target = wave(worlds, 1)
        worlds.step(target, sample_at=at)
        history = []
        for _ in range(10):
            single.step(target, substeps=1)
            history.append(single.read())
        sample, tolerance = worlds.read_sample(), worlds.precision(1e-7, 2e-3)
        for row, substep in enumerate(at):
            expected = history[substep - 1]
            for name in (*MOTION_FIELDS, "time", "joint_torque"):
                factor = 50.0 if "velocity" in name or "torque" in name else 1.0
                found, wanted = getattr(sample, name)[row], getattr(expected, name)[row]
                expect_close(f"sample.{name} of world {row} at substep {substep}", found, wanted, factor * tolerance)
            if bench.supports("contact_forces"):
                found, wanted = sample.ground_force_w[row], expected.ground_force_w[row]
                allowed = worlds.precision(1e-3, 5.0) + 0.05 * np.abs(wanted).max()
                expect_close(f"sample.ground_force_w of world {row} at substep {substep} [N]", found, wanted, allowed)
        expect_close("state.time after a sampled step [s]", worlds.read().time, 0.04, 1e-6)
        worlds.step(sample_at=[0, 2, 0, 0])
        expect_close("sample.time of the only world that asked [s]", worlds.read_sample().time[1], 0.044, 1e-6)
    return ""


@check("stepping/mask")
def step_mask(bench: Bench) -> str:
    """Worlds outside of a step's mask do not change at all, their targets included."""
    stepped = np.array([True, False, True, False])
    with twins(bench, periods=1) as (worlds, other):
        before = worlds.read()
        worlds.step(wave(worlds, 5), worlds=stepped)
        after = worlds.read()
        expect_same("worlds outside of the mask", before, after, np.flatnonzero(~stepped))
        expect_close("time of the masked worlds [s]", after.time, [0.04, 0.02, 0.04, 0.02], 1e-6)
        moved = np.abs(after.joint_position - before.joint_position).max(axis=1)
        expect(moved[stepped] > 1e-4, "worlds inside of the mask did not move")
        # worlds outside of the mask go on undisturbed: the targets of the masked step were for others
        worlds.step(worlds=~stepped)
        other.step()
        tolerance = worlds.precision(1e-9, 1e-4)
        rows = np.flatnonzero(~stepped)
        found, wanted = worlds.read().joint_position[rows], other.read().joint_position[rows]
        expect_close("joint_position of worlds that sat out a step [rad]", found, wanted, tolerance)
        before = worlds.read()
        worlds.step(wave(worlds, 2), worlds=[False] * worlds.count)
        expect_same("an empty mask", before, worlds.read(), range(worlds.count))
    return ""


@check("reset/mask")
def reset_mask(bench: Bench) -> str:
    """Worlds outside of a reset's mask do not change at all and go on undisturbed."""
    chosen = np.array([False, True, False, True])
    with twins(bench, periods=1) as (worlds, other):
        before = worlds.read()
        worlds.reset(chosen, base_position=(2.0, 2.0, 2.0))
        after = worlds.read()
        rows = np.flatnonzero(~chosen)
        expect_same("worlds outside of the reset's mask", before, after, rows)
        expect_close("base_position_w of reset worlds [m]", after.base_position_w[chosen], 2.0, 1e-5)
        for each in (worlds, other):
            each.step()
        tolerance = worlds.precision(1e-9, 1e-4)
        found, wanted = worlds.read(), other.read()
        for name in ("joint_position", "base_position_w"):
            expect_close(f"{name} beside a reset", getattr(found, name)[rows], getattr(wanted, name)[rows], tolerance)
        expect_close("joint_torque of worlds reset to limp [N·m]", found.joint_torque[chosen], 0.0, 1e-5)
    return ""


@check("reset/repeat")
def reset_repeat(bench: Bench) -> str:
    """A reset clears the past: the same start gives the same motion."""
    with bench.worlds() as worlds:
        ends = []
        for _ in range(2):
            stand(bench, worlds, held=False)
            for period in range(4):
                worlds.step(wave(worlds, period), delay=[0, 2, 5, 10])
            ends.append(worlds.read())
        error = expect_same_motion("on the second run", ends[1], ends[0], worlds.precision(1e-9, 2e-3))
    return f"second run within {error:.1e} m"


@check("stepping/determinism")
def determinism(bench: Bench) -> str:
    """Two equal engines agree to the last bit; on a GPU only where the engine has a deterministic mode."""
    declared = bench.capabilities["deterministic"].support
    if bench.gpu and declared is not Support.EXACT:
        return f"not promised on a GPU: deterministic is '{declared.value}'"
    ends = []
    for _ in range(2):
        with bench.worlds(deterministic=declared is Support.EXACT) as worlds:
            stand(bench, worlds)
            for period in range(6):
                worlds.step(wave(worlds, period), delay=[0, 2, 5, 10])
            ends.append(worlds.read())
    first, second = ends
    expect_same("two runs", first, second, range(len(first.time)))
    return "60 substeps with contacts, to the last bit"


@check("stepping/independence")
def independence(bench: Bench) -> str:
    """A world among others moves as the same world does alone."""
    with bench.worlds() as worlds:
        stand(bench, worlds)
        for period in range(4):
            worlds.step(wave(worlds, period))
        together = worlds.read()
        targets = [wave(worlds, period) for period in range(4)]
    with bench.worlds(terrain_index=(0,)) as alone:
        row = 2
        stand(bench, alone, speed=SPEEDS[row : row + 1])
        for target in targets:
            alone.step(target[row : row + 1])
        state, tolerance = alone.read(), alone.precision(1e-7, 2e-3)
        wanted = SimpleNamespace(**{name: getattr(together, name)[row : row + 1] for name in MOTION_FIELDS})
        error = expect_same_motion("of a world alone", state, wanted, tolerance)
    return f"equal to {error:.1e} m"
