"""Training tiles: their surfaces as functions of the place, their limits, and that a seed says everything."""

import numpy as np
import pytest
from gaitgauge.terrains import TerrainError
from gaitgauge.terrains.base import Box
from gaitgauge.terrains.gauge_terrains import STAIR_RISERS, obstacle, slope_gradient, wave_heights
from gaitgauge.terrains.training_tiles import (
    NUM_TILE_LEVELS,
    TILE_KINDS,
    TILE_SIZE,
    TileKind,
    TileShape,
    make_tile,
)

LEVELS = range(NUM_TILE_LEVELS)
FIELDS = ("wave", "rough_slope")


@pytest.fixture(scope="module")
def points():
    """Random places on and around a tile, and their radius max(|x|, |y|)."""
    xy = np.random.default_rng(0).uniform(-5.0, 5.0, (4000, 2))
    return xy[:, 0], xy[:, 1], np.abs(xy).max(axis=1)


@pytest.mark.parametrize("level", LEVELS)
def test_slope_pit_rises_in_every_direction_to_a_rim(level, points):
    x, y, radius = points
    gradient = 0.10 + 0.052 * level
    expected = gradient * (np.clip(radius, 1.3, 4.0) - 1.3)
    tile = make_tile("slope_up", level)
    assert tile.height(x, y) == pytest.approx(expected, abs=1e-9)
    assert tile.height(np.array([39.9, -39.9]), np.array([-39.9, 0.0])) == pytest.approx(2.7 * gradient)


@pytest.mark.parametrize("level", LEVELS)
def test_slope_hill_falls_in_every_direction_to_the_floor(level, points):
    x, y, radius = points
    expected = (0.10 + 0.052 * level) * (4.0 - np.clip(radius, 1.3, 4.0))
    assert make_tile("slope_down", level).height(x, y) == pytest.approx(expected, abs=1e-9)


def profile(tile, *, angle=0.0):
    """Heights every millimetre from the middle straight outwards."""
    distance = np.arange(0.0, 5.0, 0.001) + 0.0005
    return distance, tile.height(distance * np.cos(angle), distance * np.sin(angle))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("level", [0, 7, 11])
def test_stairs(level, seed, points):
    x, y, radius = points
    mean = 0.05 + 0.023 * level
    for kind, sign in (("stairs_up", 1), ("stairs_down", -1)):
        tile = make_tile(kind, level, seed)
        distance, height = profile(tile)
        places = np.flatnonzero(np.diff(height))
        risers, at = sign * np.diff(height)[places], distance[places] + 0.0005
        assert 7 <= len(risers) <= 9
        assert at[0] == pytest.approx(1.3, abs=1e-3) and at[-1] <= 3.8 + 1e-3
        assert np.all(np.abs(risers / mean - 1.0) <= 0.15 + 1e-6)
        treads = np.diff(at)
        assert np.all((treads >= 0.28 * 0.85 - 2e-3) & (treads <= 0.36 * 1.15 + 2e-3))
        # The same all round.
        line = np.interp(radius, distance, height)
        far_from_edges = np.abs(radius[:, None] - at).min(axis=1) > 2e-3
        assert tile.height(x, y)[far_from_edges] == pytest.approx(line[far_from_edges], abs=1e-9)
        assert height[0 if sign > 0 else -1] == 0.0


@pytest.mark.parametrize(("level", "mean"), [(0, 0.05), (5, 0.165), (8, 0.234), (10, 0.28), (11, 0.303)])
def test_the_second_number_of_a_pair_is_the_growth_up_to_difficulty_1(level, mean):
    shape = TileShape(stair_irregularity=0.0)
    height = profile(make_tile("stairs_up", level, shape=shape))[1]
    steps = np.diff(height)
    assert steps[steps != 0] == pytest.approx(mean)


def test_levels_go_on_beyond_the_gauge_s_hardest_ground():
    """As ``docs/reference/training-settings.md`` says: stairs from level 8 on, slopes and bars from level 10 on."""
    shape = TileShape(stair_irregularity=0.0, bar_height=(1.0, 1.0))

    def highest(kind, level):
        steps = np.diff(profile(make_tile(kind, level, shape=shape))[1])
        return steps.max()

    assert highest("stairs_up", 7) == pytest.approx(0.211) and highest("stairs_up", 8) == pytest.approx(0.234)
    assert STAIR_RISERS[-1] == 0.23
    bars = 2 * obstacle(10).boxes[0].half_size[2]
    assert (highest("bars", 9), bars, highest("bars", 10)) == pytest.approx((0.275, 0.28, 0.3))
    gradients = [float(make_tile("slope_up", level).height(2.3, 0.0)) for level in (9, 10)]
    assert (gradients[0], slope_gradient(10), gradients[1]) == pytest.approx((0.568, 0.57, 0.62))


def test_some_flights_are_regular_and_some_are_not():
    spread = []
    for seed in range(20):
        height = profile(make_tile("stairs_up", 9, seed))[1]
        risers = np.diff(height)[np.flatnonzero(np.diff(height))]
        spread.append(risers.std() / risers.mean())
    assert min(spread) < 0.02 < 0.05 < max(spread)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("level", [0, 7, 11])
def test_obstacles_are_patches_without_gaps(level, seed, points):
    x, y, radius = points
    high = 0.05 + 0.025 * level
    tile = make_tile("obstacles", level, seed)
    height = tile.height(x, y)
    assert height[(radius < 1.5) | (radius > 4.0)] == pytest.approx(high)
    seen = np.unique(np.round(height / high, 9))
    assert set(seen) <= {0.0, 0.5, 1.0, 1.5, 2.0} and len(seen) >= 4
    area = sum(4 * b.half_size[0] * b.half_size[1] for b in tile.boxes if max(b.half_size[:2]) < 4.0)
    assert area <= TILE_SIZE**2 + 1e-9
    for box in tile.boxes[5:]:
        assert 2 * min(box.half_size[:2]) >= 0.4 and 2 * max(box.half_size[:2]) <= 3.0


def test_patches_stand_next_to_pits():
    """Edges of twice the obstacle height, as on the published tile, and of every other height."""
    steps = set()
    for seed in range(10):
        tile = make_tile("obstacles", 9, seed)
        for angle in np.linspace(0, 2 * np.pi, 36):
            steps |= set(np.round(np.abs(np.diff(profile(tile, angle=angle)[1])) / 0.275, 6))
    assert steps == {0.0, 0.5, 1.0, 1.5, 2.0}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("level", [0, 7, 11])
def test_bars_cannot_be_walked_around(level, seed):
    high = 0.05 + 0.025 * level
    tile = make_tile("bars", level, seed)
    distance, straight = profile(tile)
    edges = distance[np.flatnonzero(np.diff(straight))] + 0.0005
    ups, downs = edges[0::2], edges[1::2]
    assert 1.3 - 1e-3 <= ups[0] <= 1.7 + 1e-3 and ups[-1] <= 3.8 + 1e-3
    assert np.all((downs - ups[: len(downs)] >= 0.3 - 2e-3) & (downs - ups[: len(downs)] <= 1.2 + 2e-3))
    assert np.all((ups[1:] - downs[: len(ups) - 1] >= 0.5 - 2e-3) & (ups[1:] - downs[: len(ups) - 1] <= 1.2 + 2e-3))
    tops = straight[straight > 0]
    assert np.all((tops >= 0.8 * high - 1e-9) & (tops <= high + 1e-9))
    for angle in np.linspace(0.0, 2 * np.pi, 50):
        assert len(np.unique(profile(tile, angle=angle)[1])) == len(np.unique(straight))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("level", [0, 7, 11])
def test_wave(level, seed):
    steepness = 0.20 + 0.05 * level
    field = make_tile("wave", level, seed).height_field
    assert field.heights.shape == (113, 113) and field.half_size == (5.6, 5.6) and field.heights.min() == 0.0
    inner = field.heights[8:-8, 8:-8]
    # Two waves of 0.75 to 1.0 of the steepness and 1.4 to 2.8 m, and up to 5 cm above and below them.
    swing = 2 * steepness / (2 * np.pi)
    assert 2 * swing * 0.75 * 1.4 * 0.8 <= np.ptp(inner) <= 2 * swing * 2.8 + 0.1
    assert np.abs(np.diff(inner, axis=1)).max() / 0.1 <= np.sqrt(2) * steepness + 0.5 + 1e-9


def test_waves_differ_in_height_and_direction():
    swing = [np.ptp(make_tile("wave", 10, seed).height_field.heights[8:-8, 8:-8]) for seed in range(12)]
    assert max(swing) > 1.3 * min(swing)
    assert min(swing) < np.ptp(wave_heights(10)) < max(swing)


def test_levels_go_on_beyond_the_gauge():
    """The hardest ground of the gauge is easier than the hardest of training, and harder than the easiest."""
    riser = make_tile("stairs_up", 11).height(4.5, 0.0) / 9
    assert riser > STAIR_RISERS[-1]
    assert make_tile("slope_up", 11).height(4.5, 0.0) / 2.7 > slope_gradient(10)
    assert make_tile("bars", 11).height(np.linspace(0, 5, 500), 0.0).max() > 0.05 + 0.23
    assert profile(make_tile("bars", 8))[1].max() < 0.28


@pytest.mark.parametrize("level", LEVELS)
def test_rough_slope(level):
    tile = make_tile("rough_slope", level, seed=1)
    assert tile.height_field.heights.shape == (113, 113) and tile.height_field.heights.min() == 0.0
    line = np.linspace(-3.2, 3.2, 65)
    x, y = np.meshgrid(line, line)
    smooth = (0.10 + 0.052 * level) * (4.0 - np.clip(np.maximum(np.abs(x), np.abs(y)), 1.3, None)) + 0.05
    rough = tile.height(x, y) - smooth
    assert np.abs(rough).max() <= 0.05 + 1e-9 and rough.std() > 0.015


@pytest.mark.parametrize("kind", FIELDS)
def test_height_fields_end_level_with_the_floor(kind):
    heights = make_tile(kind, 9).height_field.heights
    edges = np.concatenate([heights[0], heights[-1], heights[:, 0], heights[:, -1]])
    assert np.all(edges == 0.0) and heights.min() == 0.0


@pytest.mark.parametrize("kind", TILE_KINDS)
@pytest.mark.parametrize("level", LEVELS)
def test_what_holds_for_every_tile(kind, level):
    tile = make_tile(kind, level, seed=5)
    assert len(tile.boxes) <= 36
    assert (tile.height_field is not None) == (kind in FIELDS) == (tile.family == "tile_field")
    assert (tile.name, tile.level) == (f"tile_{kind}", level)
    x, y, z = tile.spawns["train"].position
    assert (x, y) == (0.0, 0.0) and z == tile.height(0.0, 0.0)
    assert all(b.center[2] + max(b.half_size) > 0 and min(b.half_size) > 0 and not b.wall for b in tile.boxes)


@pytest.mark.parametrize("kind", TILE_KINDS)
def test_the_seed_says_everything(kind):
    def content(seed):
        tile = make_tile(kind, 4, seed)
        return tile.boxes, None if tile.height_field is None else tile.height_field.heights.tobytes()

    assert content(7) == content(7)
    assert (content(7) != content(8)) == TILE_KINDS[kind].random


def test_a_kind_of_ones_own(monkeypatch):
    def ditch(difficulty, shape, random):
        return (Box(center=(0.0, 0.0, 0.5), half_size=(1.0, 1.0, 0.5)),)

    monkeypatch.setitem(TILE_KINDS, "ditch", TileKind(build=ditch, random=False, levelled=False))
    assert make_tile("ditch", 3).spawns["train"].position == (0.0, 0.0, 1.0)


def test_a_box_without_a_size_is_refused_by_its_terrain(monkeypatch):
    def kerb(difficulty, shape, random):
        step = Box(center=(0.0, 0.0, 0.1), half_size=(1.0, 1.0, 0.1))
        return step, Box(center=(2.0, 0.0, 0.0), half_size=(0.1, 4.0, 0.1 * difficulty))

    monkeypatch.setitem(TILE_KINDS, "kerb", TileKind(build=kerb, random=False))
    message = (
        r"terrain 'tile_kerb' level 0: box 1 \(from 0\) .* half size 0 m along z, which must be above 0; make it larger"
    )
    with pytest.raises(TerrainError, match=message):
        make_tile("kerb", 0)
    assert len(make_tile("kerb", 1).boxes) == 2


def test_bad_requests():
    with pytest.raises(TerrainError, match="unknown kind of training tile 'stairs_upp'; did you mean 'stairs_up'"):
        make_tile("stairs_upp", 0)
    with pytest.raises(TerrainError, match="levels 0 to 11, not 12"):
        make_tile("wave", 12)
    with pytest.raises(TerrainError, match=r"leaves no room for two steps of 0\.28 m within 3\.8 m"):
        TileShape(platform_radius=3.7)
    with pytest.raises(TerrainError, match=r"obstacle_free_radius is 4\.0 m"):
        TileShape(obstacle_free_radius=4.0)
    with pytest.raises(TerrainError, match=r"bar_width is 1\.0, 0\.5; a range"):
        TileShape(bar_width=(1.0, 0.5))


def test_other_dimensions():
    shape = TileShape(
        stair_riser=(0.1, 0.0), stair_count=6, platform_radius=1.0, stair_tread=(0.3, 0.3), stair_irregularity=0.0
    )
    tile = make_tile("stairs_up", 0, shape=shape)
    assert len(tile.boxes) == 24
    assert tile.height(np.array([1.05, 1.35, TILE_SIZE / 2]), 0.0) == pytest.approx([0.1, 0.2, 0.6])
