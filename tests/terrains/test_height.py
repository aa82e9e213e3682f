"""Ground heights against rays cast in compiled MuJoCo models of the same terrain."""

import mujoco
import numpy as np
import pytest
from gaitgauge.terrains import Box, HeightField, Terrain, make_terrain
from gaitgauge.terrains.height import grid_height, ground_height
from gaitgauge.terrains.training_tiles import TILE_KINDS, make_tile


def compiled(terrain):
    """The terrain without its walls as a MuJoCo model."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    for box in terrain.boxes:
        if not box.wall:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, pos=box.center, quat=box.quaternion, size=box.half_size
            )
    field = terrain.height_field
    if field is not None:
        rows, columns = field.heights.shape
        highest = float(field.heights.max())
        spec.add_hfield(
            name="field",
            nrow=rows,
            ncol=columns,
            size=[*field.half_size, highest, field.base],
            userdata=(field.heights / highest).ravel(),
        )
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", pos=[*field.center, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def ray_height(model, data, x, y, start=20.0):
    geom = np.zeros(1, dtype=np.int32)
    distance = mujoco.mj_ray(model, data, np.array([x, y, start]), np.array([0.0, 0.0, -1.0]), None, 1, -1, geom)
    return start - distance


def check_against_rays(terrain, points, tolerance=1e-6):
    model, data = compiled(terrain)
    rays = [ray_height(model, data, x, y) for x, y in points]
    assert terrain.height(points[:, 0], points[:, 1]) == pytest.approx(np.array(rays), abs=tolerance)


@pytest.mark.parametrize(
    ("name", "level"), [("slope_fd", 1), ("slope_bd", 10), ("stairs_fd", 1), ("stairs_bd", 10), ("obstacle", 6)]
)
def test_boxes_agree_with_rays(name, level):
    points = np.random.default_rng(0).uniform([-1, -5.5], [12, 5.5], (300, 2))
    check_against_rays(make_terrain(name, level), points)


@pytest.mark.parametrize("level", [1, 10])
def test_wave_agrees_with_rays(level):
    points = np.random.default_rng(1).uniform([-0.5, -5.5], [10.5, 5.5], (300, 2))
    check_against_rays(make_terrain("wave", level), points, 1e-6)


@pytest.mark.parametrize("kind", TILE_KINDS)
def test_training_tiles_agree_with_rays(kind):
    points = np.random.default_rng(5).uniform(-4.5, 4.5, (200, 2))
    check_against_rays(make_tile(kind, 9, 1), points)


def test_boxes_of_any_orientation_agree_with_rays():
    random = np.random.default_rng(2)
    boxes = tuple(
        Box(
            center=tuple(random.uniform(-1, 1, 3)),
            half_size=tuple(random.uniform(0.05, 0.6, 3)),
            quaternion=tuple(q / np.linalg.norm(q)),
        )
        for q in random.normal(size=(12, 4))
    )
    points = random.uniform(-1.6, 1.6, (400, 2))
    check_against_rays(Terrain(name="test", family="test", boxes=boxes), points, 1e-6)


@pytest.fixture(scope="module")
def rough():
    """Few, large and very uneven cells, more columns than rows: a wrong diagonal or a swapped axis shows."""
    heights = np.random.default_rng(3).uniform(0.0, 1.0, (4, 6))
    heights[0, 0], heights[3, 5] = 0.0, 1.0
    return Terrain(
        name="test", family="test", height_field=HeightField(center=(0.5, -0.2), half_size=(1.5, 0.9), heights=heights)
    )


def test_height_field_agrees_with_rays(rough):
    points = np.random.default_rng(4).uniform([-1.2, -1.3], [2.2, 0.9], (500, 2))
    check_against_rays(rough, points)


def test_height_field_agrees_with_collisions(rough):
    """A tiny sphere sunk a little into the surface where the local triangle is known touches that triangle's plane."""
    field = rough.height_field
    spec = mujoco.MjSpec()
    spec.add_hfield(
        name="field", nrow=4, ncol=6, size=[*field.half_size, 1.0, field.base], userdata=field.heights.ravel()
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", pos=[*field.center, 0])
    body = spec.worldbody.add_body()
    body.add_freejoint()
    radius = 0.004
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], mass=1.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    step_x, step_y = 2 * field.half_size[0] / 5, 2 * field.half_size[1] / 3
    for row in range(3):
        for column in range(5):
            for u, v in ((0.65, 0.35), (0.35, 0.65)):
                x = field.center[0] - field.half_size[0] + (column + u) * step_x
                y = field.center[1] - field.half_size[1] + (row + v) * step_y
                z = float(rough.height(x, y))
                nudge = 1e-4
                slope = np.array([rough.height(x + nudge, y) - z, rough.height(x, y + nudge) - z]) / nudge
                normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope @ slope)
                data.qpos[:3] = np.array([x, y, z]) + 0.5 * radius * normal
                mujoco.mj_forward(model, data)
                assert data.ncon >= 1
                deepest = min(data.contact[: data.ncon], key=lambda c: c.dist)
                assert deepest.dist == pytest.approx(-0.5 * radius, abs=2e-4)
                assert np.abs(deepest.frame[:3] @ normal) == pytest.approx(1.0, abs=1e-3)


def test_walls_are_no_ground():
    terrain = make_terrain("wave", 5)
    assert terrain.height(10.25, 0.0) == 0.0
    assert any(b.wall and abs(b.center[0] - 10.25) < 1e-9 for b in terrain.boxes)


def test_shapes_broadcast_and_nan_stays_nan(rough):
    assert rough.height(np.zeros((3, 1)), np.zeros((1, 4))).shape == (3, 4)
    assert rough.height(0.0, 0.0).shape == ()
    result = rough.height(np.array([np.nan, 0.0]), 0.0)
    assert np.isnan(result[0]) and not np.isnan(result[1])
    assert make_terrain("stairs_fd", 1).height(np.zeros((0,)), np.zeros((0,))).shape == (0,)


def test_edges_belong_to_the_solid():
    bar = make_terrain("obstacle", 10)
    assert bar.height(np.array([5.0, 6.0]), np.array([5.0, -5.0])) == pytest.approx(0.28)


def test_a_grid_has_the_same_bits_as_its_points():
    """On every kind of tile, and with boxes turned any way, of which some lie half or wholly outside of the grid."""
    axis = np.linspace(-4.95, 4.95, 199)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    tiles = [make_tile(kind, 7, 3) for kind in TILE_KINDS]
    assert any(t.height_field is not None for t in tiles)
    random = np.random.default_rng(5)
    boxes = [
        Box(
            center=tuple(random.uniform([-6, -6, 0], [6, 6, 0.5])),
            half_size=tuple(random.uniform(0.02, 1.0, 3)),
            quaternion=tuple(q / np.linalg.norm(q)),
        )
        for q in random.normal(size=(40, 4))
    ]
    for found, field in [(boxes, None), *((t.boxes, t.height_field) for t in tiles)]:
        np.testing.assert_array_equal(grid_height(found, field, axis), ground_height(found, field, x, y))
