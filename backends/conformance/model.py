"""Checks of randomized masses and centres of mass, at rest and in motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from .bench import Bench, expect_close
from .check import check
from .contact import centers_of_mass, pressure_point, stand_still
from .kinematics import follow_reference, posed
from .reference import GRAVITY, Reference

_CHANGED = {
    "base_mass": ("base_mass_offset", "base_mass"),
    "base_com": ("base_com_offset", "base_com"),
    "link_mass": ("link_mass_scale", "link_scale"),
}
"""Field of ``Randomization`` and argument of ``Reference.change``, by capability."""
_MASSES = np.array([-1.0, 0.0, 2.0, 4.0])
_SHIFTS = np.array([[0.06, 0.0, 0.0], [0.0, 0.05, 0.0], [-0.05, -0.03, 0.04], [0.0, 0.0, 0.05]])


def _weights(bench: Bench, changes: list[dict[str, Any]]) -> np.ndarray:
    weights = []
    for change in changes:
        reference = Reference(bench.robot, bench.stiff())
        reference.change(**change)
        weights.append(reference.mass * GRAVITY)
    return np.array(weights)


def _at_rest(bench: Bench, capability: str, *values: np.ndarray) -> str:
    """Compare weight and pressure point of robots at rest with those of references changed by the last of ``values``."""
    field, argument = _CHANGED[capability]
    changes = [{argument: value} for value in values[-1]]
    with bench.worlds(bench.stiff()) as worlds:
        for value in values:
            worlds.randomize(**{field: value})
        state = stand_still(bench, worlds)
        weight = _weights(bench, changes)
        bound = bench.bound(capability, exact=0.01, approximate=0.05)
        off = expect_close("weight on the ground [N]", state.ground_force_w[:, 2], weight, bound * weight)
        below = centers_of_mass(bench, worlds, state, changes)[:, :2]
        point = pressure_point(state)
        error = expect_close("pressure point against the centre of mass [m]", point, below, 0.3 * bound + 0.002)
    return f"weight to {off:.1e} N, centre of mass to {1e3 * error:.2f} mm"


def _in_motion(bench: Bench, capability: str, values: np.ndarray) -> str:
    """Compare a step response in the air with that of changed references, which tests inertias and derived constants."""
    field, argument = _CHANGED[capability]
    with bench.worlds() as worlds:
        worlds.randomize(**{field: values})
        asked = posed(bench, worlds.count, seed=21)
        target = worlds.default_pose + np.where(np.arange(bench.robot.num_joints) % 2, 0.4, -0.3)
        worlds.reset(**asked)
        worlds.step(target)
        worlds.run(0.1)
        angle = bench.bound(capability, exact=0.003, approximate=0.02)
        position = bench.bound(capability, exact=0.001, approximate=0.005)
        run: dict[str, Any] = {"seconds": 0.12, "target": target, "changes": [{argument: value} for value in values]}
        return follow_reference(bench, worlds, asked, worlds.read(), angle=angle, position=position, **run)


def _links(bench: Bench) -> np.ndarray:
    return np.random.default_rng(22).uniform(0.6, 2.0, (4, len(bench.robot.collision_bodies)))


@check("model/base_mass", "base_mass", "contact_forces", "plane")
def base_mass(bench: Bench) -> str:
    """A base mass offset shows in the weight and replaces an earlier one."""
    return _at_rest(bench, "base_mass", np.full(4, 3.0), _MASSES)


@check("model/base_mass_motion", "base_mass")
def base_mass_motion(bench: Bench) -> str:
    """A base mass offset is a point load at the base's centre of mass and leaves the base's own inertia."""
    return _in_motion(bench, "base_mass", _MASSES)


@check("model/base_com", "base_com", "contact_forces", "plane")
def base_com(bench: Bench) -> str:
    """A shift of the base's centre of mass moves the pressure point under the robot."""
    return _at_rest(bench, "base_com", _SHIFTS * [[1.0], [1.0], [1.0], [0.0]])


@check("model/base_com_motion", "base_com")
def base_com_motion(bench: Bench) -> str:
    """A shifted centre of mass acts in motion as in the reference, along all three axes."""
    return _in_motion(bench, "base_com", _SHIFTS)


@check("model/link_mass", "link_mass", "contact_forces", "plane")
def link_mass(bench: Bench) -> str:
    """Link mass factors show in weight and pressure point; the base's entry is ignored."""
    return _at_rest(bench, "link_mass", _links(bench))


@check("model/link_mass_motion", "link_mass")
def link_mass_motion(bench: Bench) -> str:
    """Link mass factors scale the inertias too."""
    return _in_motion(bench, "link_mass", _links(bench))


@check("model/persistence", "base_mass", "contact_forces", "plane", "friction", "boxes", "per_world_terrain")
def persistence(bench: Bench) -> str:
    """Randomization outlives resets, changes of terrain and other randomizations; a mask selects its worlds."""
    from .ground import FLOOR, PLATFORM

    with bench.worlds(bench.stiff(), terrains=(FLOOR, PLATFORM), terrain_index=(0, 0, 1, 1)) as worlds:
        worlds.randomize([False, True, False, True], base_mass_offset=np.array([2.0, 4.0]))
        worlds.randomize(friction=np.full(4, 0.9))
        index = np.array([1, 1, 0, 0])
        stand_still(bench, worlds, seconds=0.04, ground=0.3 * index, terrain_index=index)
        state = stand_still(bench, worlds, ground=0.3 * index)
        weight = _weights(bench, [{"base_mass": mass} for mass in (0.0, 2.0, 0.0, 4.0)])
        force, height = state.ground_force_w[:, 2], state.base_position_w[:, 2]
        error = expect_close("weight after resets and a change of terrain [N]", force, weight, 0.02 * weight)
        expect_close("height of the new ground [m]", height - 0.3 * index, height[2], 0.01)
    return f"weight to {error:.1e} N"
