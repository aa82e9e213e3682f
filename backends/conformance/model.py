"""Checks of randomized masses and centres of mass, at rest and in motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from .bench import Bench, Worlds, expect_close
from .check import check
from .contact import centers_of_mass, pressure_point, stand_still
from .kinematics import follow_reference, posed
from .reference import GRAVITY, Reference


def _weights(bench: Bench, changes: list[dict[str, Any]]) -> np.ndarray:
    weights = []
    for change in changes:
        reference = Reference(bench.robot, bench.stiff())
        reference.change(**change)
        weights.append(reference.mass * GRAVITY)
    return np.array(weights)


def _at_rest(bench: Bench, worlds: Worlds, changes: list[dict[str, Any]], capability: str) -> str:
    """Compare the weight and the pressure point of robots at rest with those of changed references."""
    state = stand_still(bench, worlds)
    weight = _weights(bench, changes)
    bound = bench.bound(capability, exact=0.01, approximate=0.05)
    off = expect_close("weight on the ground [N]", state.ground_force_w[:, 2], weight, bound * weight)
    below = centers_of_mass(bench, worlds, state, changes)[:, :2]
    point = pressure_point(state)
    error = expect_close("pressure point against the centre of mass [m]", point, below, 0.3 * bound + 0.002)
    return f"weight to {off:.1e} N, centre of mass to {1e3 * error:.2f} mm"


def _in_motion(bench: Bench, values: dict[str, np.ndarray], changes: list[dict[str, Any]], capability: str) -> str:
    """Compare a step response in the air with that of changed references, which tests inertias and derived constants."""
    with bench.worlds() as worlds:
        worlds.randomize(**values)
        asked = posed(bench, worlds.count, seed=21)
        target = worlds.default_pose + np.where(np.arange(bench.robot.num_joints) % 2, 0.4, -0.3)
        worlds.reset(**asked)
        worlds.step(target)
        worlds.run(0.1)
        angle = bench.bound(capability, exact=0.003, approximate=0.02)
        position = bench.bound(capability, exact=0.001, approximate=0.005)
        run: dict[str, Any] = {"seconds": 0.12, "target": target, "changes": changes}
        return follow_reference(bench, worlds, asked, worlds.read(), angle=angle, position=position, **run)


def _links(bench: Bench) -> np.ndarray:
    return np.random.default_rng(22).uniform(0.6, 2.0, (4, len(bench.robot.collision_bodies)))


@check("model/base_mass", "base_mass", "contact_forces", "plane")
def base_mass(bench: Bench) -> str:
    """A base mass offset shows in the weight and replaces an earlier one."""
    changes = [{"base_mass": m} for m in (-1.0, 0.0, 2.0, 4.0)]
    with bench.worlds(bench.stiff()) as worlds:
        worlds.randomize(base_mass_offset=np.full(4, 3.0))
        worlds.randomize(base_mass_offset=np.array([c["base_mass"] for c in changes]))
        return _at_rest(bench, worlds, changes, "base_mass")


@check("model/base_mass_motion", "base_mass")
def base_mass_motion(bench: Bench) -> str:
    """A base mass offset is a point load at the base's centre of mass and leaves the base's own inertia."""
    changes = [{"base_mass": m} for m in (-1.0, 0.0, 2.0, 4.0)]
    return _in_motion(bench, {"base_mass_offset": np.array([c["base_mass"] for c in changes])}, changes, "base_mass")


@check("model/base_com", "base_com", "contact_forces", "plane")
def base_com(bench: Bench) -> str:
    """A shift of the base's centre of mass moves the pressure point under the robot."""
    shifts = np.array([[0.06, 0.0, 0.0], [0.0, 0.05, 0.0], [-0.05, -0.03, 0.04], [0.0, 0.0, 0.0]])
    with bench.worlds(bench.stiff()) as worlds:
        worlds.randomize(base_com_offset=shifts)
        return _at_rest(bench, worlds, [{"base_com": s} for s in shifts], "base_com")


@check("model/base_com_motion", "base_com")
def base_com_motion(bench: Bench) -> str:
    """A shifted centre of mass acts in motion as in the reference, along all three axes."""
    shifts = np.array([[0.06, 0.0, 0.0], [0.0, 0.05, 0.0], [-0.05, -0.03, 0.04], [0.0, 0.0, 0.05]])
    return _in_motion(bench, {"base_com_offset": shifts}, [{"base_com": s} for s in shifts], "base_com")


@check("model/link_mass", "link_mass", "contact_forces", "plane")
def link_mass(bench: Bench) -> str:
    """Link mass factors show in weight and pressure point; the base's entry is ignored."""
    scale = _links(bench)
    with bench.worlds(bench.stiff()) as worlds:
        worlds.randomize(link_mass_scale=scale)
        return _at_rest(bench, worlds, [{"link_scale": s} for s in scale], "link_mass")


@check("model/link_mass_motion", "link_mass")
def link_mass_motion(bench: Bench) -> str:
    """Link mass factors scale the inertias too."""
    scale = _links(bench)
    return _in_motion(bench, {"link_mass_scale": scale}, [{"link_scale": s} for s in scale], "link_mass")


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
        weight = _weights(bench, [{"base_mass": m} for m in (0.0, 2.0, 0.0, 4.0)])
        force, height = state.ground_force_w[:, 2], state.base_position_w[:, 2]
        error = expect_close("weight after resets and a change of terrain [N]", force, weight, 0.02 * weight)
        expect_close("height of the new ground [m]", height - 0.3 * index, height[2], 0.01)
    return f"weight to {error:.1e} N"
