"""Training tiles: their surfaces as functions of the place, their limits, and that a seed says everything."""

import numpy as np
import pytest
from gaitgauge.terrains import TerrainError
from gaitgauge.terrains.training_tiles import (
    FIELD_KINDS,
    MAX_TILE_BOXES,
    NUM_TILE_LEVELS,
    RANDOM_KINDS,
    TILE_KINDS,
    TILE_SIZE,
    TRAINING_MIX,
    TileShape,
    make_tile,
    tile_palette,
)

LEVELS = range(NUM_TILE_LEVELS)


@pytest.fixture(scope="module")
def points():
    """Random places on and around a tile, and their radius max(|x|, |y|)."""
    xy = np.random.default_rng(0).uniform(-5.0, 5.0, (4000, 2))
    return xy[:, 0], xy[:, 1], np.abs(xy).max(axis=1)


def test_mix():
    assert sum(TRAINING_MIX.values()) == pytest.approx(1.0)
    assert list(TRAINING_MIX.values()) == [0.05, 0.10, 0.10, 0.05, 0.25, 0.10, 0.20, 0.15]


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


@pytest.mark.parametrize("level", LEVELS)
def test_stairs(level, points):
    x, y, radius = points
    riser = 0.05 + 0.023 * level
    climbed = np.clip(np.floor((radius - 1.3) / 0.3) + 1, 0, 9)
    up, down = make_tile("stairs_up", level), make_tile("stairs_down", level)
    assert up.height(x, y) == pytest.approx(climbed * riser, abs=1e-9)
    assert down.height(x, y) == pytest.approx((9 - climbed) * riser, abs=1e-9)
    assert len(up.boxes) == 36 and len(down.boxes) == 9


@pytest.mark.parametrize("level", LEVELS)
def test_obstacles(level, points):
    x, y, radius = points
    high = 0.05 + 0.025 * level
    tile = make_tile("obstacles", level, seed=3)
    assert len(tile.boxes) == 20
    height = tile.height(x, y)
    assert np.all(height[(radius < 1.5) | (radius > 4.0)] == 0.0)
    assert np.unique(np.round(height, 9)) == pytest.approx([0.0, high / 2, high])
    for box in tile.boxes:
        sides = 2 * np.array(box.half_size[:2])
        corner = (np.array(box.center[:2]) - sides / 2 + 4.0) / 0.4
        assert corner == pytest.approx(np.round(corner), abs=1e-6)
        assert {round(s, 6) for s in sides} <= {1.0, 1.4, 1.8}


@pytest.mark.parametrize("level", LEVELS)
def test_wave(level):
    amplitude = 0.05 + 0.01 * level
    tile = make_tile("wave", level, seed=1)
    field = tile.height_field
    assert field.heights.shape == (81, 81) and field.half_size == (4.0, 4.0) and field.heights.min() == 0.0
    line = np.linspace(-3.2, 3.2, 65)
    x, y = np.meshgrid(line, line)
    smooth = amplitude * (2 + np.sin(2 * np.pi * x / 1.6) + np.cos(2 * np.pi * y / 1.6)) + 0.05
    rough = tile.height(x, y) - smooth
    assert np.abs(rough).max() <= 0.05 + 1e-9 and rough.std() > 0.015 and abs(rough.mean()) < 0.005


@pytest.mark.parametrize("level", LEVELS)
def test_rough_slope(level):
    tile = make_tile("rough_slope", level, seed=1)
    assert tile.height_field.heights.shape == (81, 81) and tile.height_field.heights.min() == 0.0
    line = np.linspace(-3.2, 3.2, 65)
    x, y = np.meshgrid(line, line)
    smooth = (0.10 + 0.052 * level) * (4.0 - np.clip(np.maximum(np.abs(x), np.abs(y)), 1.3, None)) + 0.05
    rough = tile.height(x, y) - smooth
    assert np.abs(rough).max() <= 0.05 + 1e-9 and rough.std() > 0.015


@pytest.mark.parametrize("kind", sorted(FIELD_KINDS))
def test_height_fields_end_level_with_the_floor(kind):
    heights = make_tile(kind, 9).height_field.heights
    edges = np.concatenate([heights[0], heights[-1], heights[:, 0], heights[:, -1]])
    assert np.all(edges == 0.0) and heights.min() == 0.0
    # No steeper on the way down than the ramp zone's smooth step makes it.
    assert np.abs(np.diff(heights[:, -9:], axis=1)).max() < 0.15


@pytest.mark.parametrize("kind", TILE_KINDS)
@pytest.mark.parametrize("level", [0, 9])
def test_what_holds_for_every_tile(kind, level):
    tile = make_tile(kind, level, seed=5)
    assert len(tile.boxes) <= MAX_TILE_BOXES
    assert (tile.height_field is not None) == (kind in FIELD_KINDS) == (tile.family == "tile_field")
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
    assert (content(7) != content(8)) == (kind in RANDOM_KINDS)


def test_palette_has_every_tile_once():
    palette = tile_palette(variants=3, seed=10)
    assert palette.index.shape == (8, 10, 3)
    assert sorted(set(palette.index.ravel())) == list(range(len(palette.terrains)))
    assert len(palette.terrains) == 3 * 10 * 3 + 4 * 10 + 1
    for number, kind in enumerate(TILE_KINDS):
        for level in (0, 6):
            chosen = [palette.terrains[i] for i in palette.index[number, level]]
            assert {t.name for t in chosen} == {f"tile_{kind}"}
            assert {t.level for t in chosen} == ({0} if kind == "flat" else {level})
            assert len({id(t) for t in chosen}) == (3 if kind in RANDOM_KINDS else 1)
    second = palette.terrains[palette.index[TILE_KINDS.index("obstacles"), 6, 1]]
    assert second.boxes == make_tile("obstacles", 6, 11).boxes


def test_bad_requests():
    with pytest.raises(TerrainError, match="unknown kind of training tile 'stairs_upp'; did you mean 'stairs_up'"):
        make_tile("stairs_upp", 0)
    with pytest.raises(TerrainError, match="levels 0 to 9, not 10"):
        make_tile("wave", 10)
    with pytest.raises(TerrainError, match="at least 1 variant"):
        tile_palette(variants=0)
    with pytest.raises(TerrainError, match=r"do not fit within 4\.0 m"):
        TileShape(stair_count=10)
    with pytest.raises(TerrainError, match=r"obstacles of 3\.0 m do not fit"):
        TileShape(obstacle_sides=(3.0,))


def test_other_dimensions():
    shape = TileShape(stair_riser=(0.1, 0.0), stair_count=6, platform_radius=1.0)
    tile = make_tile("stairs_up", 0, shape=shape)
    assert len(tile.boxes) == 24
    assert tile.height(TILE_SIZE / 2, 0.0) == pytest.approx(0.6)
