"""Checks of the ground: boxes, turned boxes, height fields, walls, and differences between worlds."""

from __future__ import annotations

import numpy as np

from ...terrains.base import Box, HeightField, Terrain
from .bench import Bench, expect, expect_close
from .check import check
from .contact import stand_still
from .reference import GRAVITY, Reference, axis_angle, level_stance

PITCH = 0.2
"""Slope of the inclined box [rad]."""


def _box(name: str, *boxes: Box) -> Terrain:
    return Terrain(name=f"conformance_{name}", family="boxes", boxes=boxes)


def _field(name: str, heights: np.ndarray, center: tuple[float, float] = (0.0, 0.0)) -> Terrain:
    field = HeightField(center=center, half_size=(3.0, 2.0), heights=heights)
    return Terrain(name=f"conformance_{name}", family="field", height_field=field)


def incline(angle: float, *, name: str = "incline") -> Terrain:
    """Return a box with a top through (0, 0, 0.8) that rises towards -x by ``angle`` [rad]: a turn about +y."""
    half = (2.0, 1.5, 0.1)
    center = (-half[2] * float(np.sin(angle)), 0.0, 0.8 - half[2] * float(np.cos(angle)))
    w, x, y, z = axis_angle((0.0, 1.0, 0.0), angle)
    return _box(name, Box(center=center, half_size=half, quaternion=(float(w), float(x), float(y), float(z))))


FLOOR = _box("floor")
PLATFORM = _box("platform", Box(center=(0.0, 0.0, 0.25), half_size=(1.0, 1.0, 0.05)))
# Turned by a right angle the plank is long in y; unturned it would leave nothing to stand on at y = 1.2.
PLANK = _box(
    "plank",
    Box(center=(0.0, 0.0, 0.1), half_size=(2.0, 0.7, 0.1), quaternion=(0.70710678, 0.0, 0.0, 0.70710678)),
    Box(center=(3.0, 0.0, 0.4), half_size=(0.2, 0.2, 0.4)),
)
PALETTE = (FLOOR, PLATFORM, PLANK, incline(PITCH))
PLACES = np.array([[0.0, 0.0], [0.5, -0.4], [0.0, 1.2], [0.0, 0.0]])
"""Places of the robots on the terrains of ``PALETTE``."""


def _standing_height(bench: Bench) -> float:
    return level_stance(Reference(bench.robot, bench.stiff())).height


@check("ground/boxes", "boxes", "per_world_terrain")
def boxes(bench: Bench) -> str:
    """Every world has the boxes of its own terrain, turned ones included, and robots stand on them."""
    with bench.worlds(bench.stiff(), terrains=PALETTE, terrain_index=(0, 1, 2, 3)) as worlds:
        heights = np.array([float(t.height(x, y)) for t, (x, y) in zip(PALETTE, PLACES, strict=True)])
        turns = np.array([axis_angle((0.0, 1.0, 0.0), PITCH if row == 3 else 0.0) for row in range(worlds.count)])
        if bench.supports("friction"):
            worlds.randomize(friction=np.ones(worlds.count))
        state = stand_still(bench, worlds, seconds=0.4, xy=PLACES, ground=heights, turn=turns)
        start = PLACES + np.array([[0.0, 0.0]] * 3 + [[_standing_height(bench) * np.sin(PITCH), 0.0]])
        reference = Reference(bench.robot, bench.stiff())
        for row, terrain in enumerate(PALETTE):
            x, y, z = state.foot_position_w[row].T
            rise = reference.foot_radius / np.cos(PITCH if row == 3 else 0.0)
            expect_close(f"foot height on terrain {terrain.name} [m]", z, terrain.height(x, y) + rise, 0.004)
            drift = float(np.linalg.norm(state.base_position_w[row, :2] - start[row]))
            expect(drift < 0.02, f"a standing robot on terrain {terrain.name} drifts by {drift:.3f} m")
        if bench.supports("contact_forces"):
            weight = reference.mass * GRAVITY
            expect_close("ground_force_w on boxes [N]", state.ground_force_w, [0, 0, weight], 0.03 * weight)
            normal = state.foot_normal_force[3].sum()
            expect_close("sum of foot_normal_force on the incline [N]", normal, weight * np.cos(PITCH), 0.03 * weight)
    return f"heights {', '.join(f'{h:.2f}' for h in heights)} m"


@check("ground/switch", "boxes", "per_world_terrain")
def switch(bench: Bench) -> str:
    """A reset moves a world to another terrain of the palette; the others keep theirs."""
    with bench.worlds(bench.stiff(), terrains=PALETTE, terrain_index=(0, 1, 0, 1)) as worlds:
        stand_still(bench, worlds, seconds=0.1, ground=np.array([0.0, 0.3, 0.0, 0.3]))
        chosen = np.array([True, True, False, False])
        index, ground = np.array([1, 0, 3, 3]), np.array([0.3, 0.0, 0.0, 0.3])
        state = stand_still(bench, worlds, seconds=0.3, mask=chosen, ground=ground, terrain_index=index)
        stance = _standing_height(bench)
        expect_close("base height above the new ground [m]", state.base_position_w[:, 2], ground + stance, 0.006)
        keep = np.array([1, 0, 0, 1])
        state = stand_still(bench, worlds, seconds=0.2, ground=ground)
        expect_close("base height after another reset [m]", state.base_position_w[:, 2], 0.3 * keep + stance, 0.006)
    return ""


def terraces() -> Terrain:
    """Return a height field of four level terraces, one in each quadrant, of different heights above 0."""
    x, y = np.meshgrid(np.linspace(-3.0, 3.0, 61), np.linspace(-2.0, 2.0, 41))
    ahead, behind = np.where(y > 0.0, 0.20, 0.05), np.where(y > 0.0, 0.15, 0.10)
    return _field("terraces", np.where(x > 0.0, ahead, behind), center=(0.5, 0.25))


def ramp_field() -> Terrain:
    """Return a height field that rises along +x and, half as much, along +y."""
    x, y = np.meshgrid(np.linspace(-3.0, 3.0, 61), np.linspace(-2.0, 2.0, 41))
    return _field("ramp", 0.5 + 0.12 * x + 0.06 * y, center=(0.5, 0.25))


@check("ground/height_field", "height_field", "per_world_terrain")
def height_field(bench: Bench) -> str:
    """Height fields lie as the terrain says: rows along +y, columns along +x, heights in metres."""
    places = np.array([[2.0, 1.25], [2.0, -0.75], [-1.0, 1.25], [0.5, 0.25]])
    terrains, index = (terraces(), ramp_field()), (0, 0, 0, 1)
    with bench.worlds(bench.stiff(), terrains=terrains, terrain_index=index) as worlds:
        if bench.supports("friction"):
            worlds.randomize(friction=np.ones(worlds.count))
        heights = np.array([float(terrains[i].height(x, y)) for i, (x, y) in zip(index, places, strict=True)])
        slope = np.array([0.0, 0.0, 0.0, np.arctan(np.hypot(0.12, 0.06))])
        # the turn that lays the robot along the ramp: about the horizontal line across its direction of ascent
        turns = np.array([axis_angle((0.06, -0.12, 0.0), float(a)) for a in slope])
        state = stand_still(bench, worlds, seconds=0.4, xy=places, ground=heights, turn=turns)
        reference = Reference(bench.robot, bench.stiff())
        for row in range(worlds.count):
            x, y, z = state.foot_position_w[row].T
            rise = reference.foot_radius / np.cos(slope[row])
            ground = terrains[index[row]].height(x, y)
            expect_close(f"foot height in world {row} on a height field [m]", z, ground + rise, 0.005)
        fluctuation = ""
        if bench.supports("contact_forces"):
            # Single contacts with a triangle mesh may come and go; over many substeps the contacts must carry the weight.
            forces = []
            for _ in range(30):
                worlds.step(substeps=1)
                forces.append(worlds.read().ground_force_w)
            weight = reference.mass * GRAVITY
            bound = bench.bound("height_field", exact=0.03, approximate=0.06) * weight
            expect_close("mean of ground_force_w on height fields [N]", np.mean(forces, axis=0), [0, 0, weight], bound)
            fluctuation = f", weight fluctuates by {np.std(forces, axis=0)[:, 2].max() / weight:.1%} between substeps"
    return f"heights {', '.join(f'{h:.2f}' for h in heights)} m{fluctuation}"


def waves() -> Terrain:
    """Return a height field of waves 0.12 m high, 1 m long along x and 1.4 m along y, with nodes every 0.08 m."""
    x, y = np.meshgrid(np.linspace(-3.0, 3.0, 76), np.linspace(-2.0, 2.0, 51))
    heights = 0.06 + 0.03 * (np.sin(2.0 * np.pi * x) + np.cos(2.0 * np.pi * y / 1.4))
    return _field("waves", heights - heights.min())


def clearance(terrain: Terrain, points: np.ndarray, reach: float) -> np.ndarray:
    """Return the distance of points from the ground [m], (M,) for (M, 3), found on a grid of ``reach`` [m] around each."""
    span = np.linspace(-reach, reach, 61)
    dx, dy = (grid.ravel() for grid in np.meshgrid(span, span))
    x, y = points[:, 0, None] + dx, points[:, 1, None] + dy
    apart = np.stack([x, y, terrain.height(x, y)], axis=-1) - points[:, None]
    return np.linalg.norm(apart, axis=-1).min(axis=1)


@check("ground/waves", "height_field", "friction")
def sliding_on_waves(bench: Bench) -> str:
    """Feet that slide over the edges of a height field meet its surface only: no false depth, no pull."""
    terrain, watch = waves(), 0.02
    watched = watch if bench.supports("penetration") else None
    with bench.worlds(bench.stiff(), terrains=(terrain,), watch_penetration=watched) as worlds:
        worlds.randomize(friction=np.full(worlds.count, 0.1))
        reference = Reference(bench.robot, bench.stiff())
        turns = np.linspace(0.0, 2.0 * np.pi, worlds.count, endpoint=False) + 0.3
        velocity = 0.6 * np.stack([np.cos(turns), np.sin(turns), np.zeros(worlds.count)], axis=1)
        top = float(terrain.height_field.heights.max()) if terrain.height_field is not None else 0.0
        # a first tenth of a second for the fall onto the ground
        stand_still(bench, worlds, seconds=0.1, ground=np.full(worlds.count, top), base_linear_velocity=velocity)
        nearest, lowest = np.inf, np.inf
        for _ in range(25):
            worlds.step()
            state = worlds.read()
            feet = state.foot_position_w.reshape(-1, 3)
            nearest = min(nearest, float(clearance(terrain, feet, 1.5 * reference.foot_radius).min()))
            if bench.supports("contact_forces"):
                lowest = min(lowest, float(state.foot_contact_force_w[..., 2].min()))
            expect(
                not state.penetration_substep.any(),
                f"penetration_substep says that a foot is {watch} m deep in the waves, while its centre was never nearer "
                f"to them than {nearest:.4f} m and its radius is {reference.foot_radius:.4f} m",
            )
        weight = reference.mass * GRAVITY
        expect(nearest > reference.foot_radius - 0.01, f"the centre of a foot is only {nearest:.4f} m above the waves")
        expect(lowest > -0.02 * weight, f"the ground pulls a foot down with {-lowest:.3g} N")
    return f"feet sink {1e3 * (reference.foot_radius - nearest):.2f} mm"


@check("ground/walls", "boxes")
def walls(bench: Bench) -> str:
    """A wall stops a sliding robot."""
    wall = Box(center=(1.25, 0.0, 1.0), half_size=(0.25, 2.0, 1.0), wall=True)
    terrain = Terrain(name="conformance_wall", family="wall", boxes=(wall,))
    with bench.worlds(bench.stiff(), terrains=(terrain,)) as worlds:
        if bench.supports("friction"):
            worlds.randomize(friction=np.full(worlds.count, 0.1))
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (worlds.count, 1))
        state = stand_still(bench, worlds, seconds=0.6, turn=turns, xy=[0.3, 0.0], base_linear_velocity=(1.5, 0.0, 0.0))
        x = state.base_position_w[:, 0]
        expect(x < 1.0, f"the base is {x.max() - 1.0:.3f} m inside of the wall or beyond it")
        expect(x > 0.3, f"the base was to slide to the wall, but is at x = {x.min():.3f} m")
        expect(not state.diverged.any(), "a robot that runs into a wall diverges")
    return f"stopped {1.0 - x.max():.2f} m before the wall's face"
