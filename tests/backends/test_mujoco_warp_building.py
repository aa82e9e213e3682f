"""What the mujoco_warp engine builds from a scene: tables, capacities, and what it says where memory is too small."""

import json
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import mujoco_warp
import numpy as np
import pytest
import torch
import warp_throughput
from gaitgauge.backends import BackendError
from gaitgauge.backends.mujoco.model import build_models
from gaitgauge.backends.mujoco_warp import MujocoWarpBackend
from gaitgauge.backends.mujoco_warp.arrays import Palette
from gaitgauge.backends.mujoco_warp.memory import bytes_per_world
from gaitgauge.backends.mujoco_warp.model import PARKED, buffer_capacity, build_shared_model
from gaitgauge.backends.warp.device import DeviceScope, is_memory_error, memory_advice
from gaitgauge.backends.warp.structures import filled
from mujoco_warp_scenes import BLOCK, BOXES, COARSE, FINE, FLAT, ROBOT, WALL, scene, with_shell

ROOT = Path(__file__).parents[2]


# ---- tables --------------------------------------------------------------------------------------------------------


def test_a_structure_that_is_not_filled_says_which_field():
    with pytest.raises(TypeError, match=r"nothing gives the field 'position' of Palette a value"):
        filled(Palette, object(), rotation=None)


def test_palette_parks_unused_slots_and_bounds_the_used():
    shared = build_shared_model(scene(FLAT, BOXES, COARSE, FINE))
    palette = shared.palette
    assert palette["position"].shape == (4, 3, 3)
    assert (palette["position"][0] == PARKED).all() and (palette["position"][1, 2] == PARKED).all()
    np.testing.assert_allclose(palette["position"][1, :2], [BLOCK.center, WALL.center])
    np.testing.assert_array_equal(palette["wall"], [[0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]])
    # the wall is turned by 90° about z: its own x axis points along the world's y
    np.testing.assert_allclose(palette["rotation"][1, 1] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(palette["radius"][1, 0], np.linalg.norm(BLOCK.half_size))
    np.testing.assert_array_equal(palette["field"], [0, 0, 0, 1])
    np.testing.assert_allclose(palette["position"][2:, 2], [(0.5, 0, 0), (0, 0, 0)])
    low, high = palette["bound_center"] - palette["bound_half"], palette["bound_center"] + palette["bound_half"]
    np.testing.assert_allclose((low[3, 2, 2], high[3, 2, 2]), (-0.2, 0.05))


def test_bounds_are_those_of_the_compiler():
    shared = build_shared_model(scene(COARSE))
    model, geom = shared.model, shared.slot_geom[-1]
    np.testing.assert_allclose(shared.palette["bound_center"][0, -1], model.geom_aabb[geom, :3], atol=1e-6)
    np.testing.assert_allclose(shared.palette["bound_half"][0, -1], model.geom_aabb[geom, 3:], atol=1e-6)
    np.testing.assert_allclose(shared.palette["radius"][0, -1], model.geom_rbound[geom], rtol=1e-6)
    np.testing.assert_allclose(shared.palette["size"][0, -1], model.geom_size[geom], rtol=1e-6)


@pytest.mark.parametrize("compiler", ["", 'inertiafromgeom="true" '])
def test_what_is_seen_alone_weighs_what_it_weighs_in_mujoco(tmp_path, compiler):
    """A shell of 3 kg that meets nothing: part of the weight only where shapes are weighed instead of what inertials say."""
    robot = with_shell(tmp_path, compiler)
    mass = mujoco.MjModel.from_xml_path(str(robot.mjcf)).body_mass.sum()
    text = ROBOT.mjcf.read_text().replace("<compiler ", f"<compiler {compiler}")
    without = mujoco.MjModel.from_xml_string(text).body_mass.sum()
    assert mass == pytest.approx(without + (3.0 if compiler else 0.0))
    wanted = replace(scene(), robot=robot)
    assert build_models(wanted)[0].body_mass.sum() == pytest.approx(mass)
    assert build_shared_model(wanted).model.body_mass.sum() == pytest.approx(mass)


def test_height_fields_keep_their_heights_and_shapes():
    model = build_shared_model(scene(COARSE, FINE)).model
    assert model.hfield_nrow.tolist() == [4, 21] and model.hfield_ncol.tolist() == [5, 31]
    for i, terrain in enumerate((COARSE, FINE)):
        start, heights = model.hfield_adr[i], terrain.height_field.heights
        stored = model.hfield_data[start : start + heights.size].reshape(heights.shape) * model.hfield_size[i, 2]
        np.testing.assert_allclose(stored, heights, rtol=1e-6)


def test_what_is_only_seen_goes_and_masses_stay():
    shared, whole = build_shared_model(scene(FLAT)), mujoco.MjModel.from_xml_path(str(ROBOT.mjcf))
    assert shared.model.ngeom < whole.ngeom and shared.model.nu == 0 and shared.model.nsensor == 0
    np.testing.assert_allclose(shared.model.body_mass, whole.body_mass, rtol=1e-12)
    np.testing.assert_allclose(shared.model.body_inertia, whole.body_inertia, rtol=1e-12)
    colliding = (whole.geom_contype | whole.geom_conaffinity) != 0
    assert shared.model.ngeom == np.count_nonzero(colliding) + 1  # and the floor


def test_geom_roles():
    shared = build_shared_model(scene(BOXES))
    names = [shared.model.geom(g).name for g in range(shared.model.ngeom)]
    assert [names[g] for g in np.flatnonzero(shared.roles["ground"])] == ["floor", "box_0", "box_1"]
    assert [names[g] for g in np.flatnonzero(shared.roles["foot"] >= 0)] == list(ROBOT.foot_names)
    assert shared.roles["body"][names.index("FL")] == ROBOT.collision_bodies.index("FL_calf")
    assert (shared.roles["body"][shared.roles["ground"] == 1] == -1).all()


@pytest.mark.parametrize(("option", "pairs"), [(False, 0), (True, 210)])
def test_pairs_of_the_robots_own_parts(option, pairs):
    model = build_shared_model(scene(BOXES, self_collision=option)).model
    tested = mujoco_warp.put_model(model).nxn_geom_pair_filtered.numpy()
    own = tested[(model.geom_bodyid[tested] > 0).all(1)]
    assert len(own) == pairs
    assert len(tested) - len(own) == 3 * np.count_nonzero(model.geom_bodyid > 0)  # the floor and two boxes


def test_capacity_follows_option_cone_and_number_of_worlds():
    def capacity(**physics):
        wanted = scene(BOXES, index=(0,) * 100, **physics)
        return buffer_capacity(wanted, build_shared_model(wanted))

    few, many = capacity(contacts_per_world=10), capacity(contacts_per_world=50)
    assert many.contacts - few.contacts == 100 * 40 and many.rows > few.rows
    # a sliding contact has 3 rows in an elliptic cone, 4 in a pyramidal one
    assert capacity(contacts_per_world=50, foot_condim=3, cone="pyramidal").rows - 50 * 4 == pytest.approx(24, abs=15)
    assert capacity(contacts_per_world=50, foot_condim=3).rows - 50 * 3 == pytest.approx(24, abs=15)
    with pytest.raises(BackendError, match="contacts_per_world"):
        capacity(contacts_per_world=-1)


# ---- errors --------------------------------------------------------------------------------------------------------


def test_memory_advice_names_a_number_that_fits():
    wanted = scene(FLAT, index=(0,) * 64)
    shared = build_shared_model(wanted)
    capacity = buffer_capacity(wanted, shared)
    per_world = bytes_per_world(shared.model, capacity, 64)
    # the dense constraint Jacobian alone has this many bytes
    assert per_world > capacity.rows * shared.model.nv * 4
    doubled = bytes_per_world(
        shared.model, replace(capacity, contacts=2 * capacity.contacts, rows=2 * capacity.rows), 64
    )
    assert 1.2 * per_world < doubled < 2.0 * per_world
    text = memory_advice(100_000, torch.device("cuda:0"), free=10**9, per_world=per_world)
    assert f"about {int(1e9 / per_world)} would" in text and "100000 worlds" in text
    assert is_memory_error(RuntimeError("Failed to allocate 12 bytes on device 'cuda:0'"))
    assert not is_memory_error(RuntimeError("something else"))


def test_the_estimate_of_memory_is_that_of_a_gpu():
    make_scene, seen = warp_throughput.training_scene, set()
    for file in sorted((ROOT / "docs" / "data").glob("throughput*_h200.json")):
        for row in json.loads(file.read_text())["rows"]:
            if row.get("backend", "mujoco-warp") != "mujoco-warp" or row["worlds"] < 8192:
                continue  # of few worlds, what all share is a large part
            wanted = make_scene(row["ground"], row["worlds"])
            # the physics that it was measured with
            wanted = replace(wanted, physics=replace(wanted.physics, iterations=10, self_collision=False))
            shared = build_shared_model(wanted)
            estimate = bytes_per_world(shared.model, buffer_capacity(wanted, shared), row["worlds"])
            assert 1.0 <= estimate / row["bytes_per_world"] < 1.15, (
                "a number of worlds would be named that does not fit"
            )
            seen.add((row["ground"], row["worlds"]))
    assert {("boxes", 8192), ("field", 8192), ("boxes", 65536)} <= seen


@pytest.mark.parametrize("where", ["make_data", "step"])
def test_too_little_memory_is_one_sentence_with_the_number_of_worlds_that_fit(monkeypatch, where):
    free = 10**7

    def fail(*_, **__):
        raise RuntimeError("Failed to allocate 123456 bytes on device 'cuda:0'")

    monkeypatch.setattr(DeviceScope, "free_bytes", lambda _: free)
    wanted = scene(FLAT, index=(0,) * 200)
    shared = build_shared_model(wanted)
    per_world = bytes_per_world(shared.model, buffer_capacity(wanted, shared), 200)
    if where == "make_data":
        plain = mujoco_warp.make_data
        # the estimate itself is made of small copies
        monkeypatch.setattr(
            mujoco_warp, "make_data", lambda m, nworld, **k: fail() if nworld == 200 else plain(m, nworld, **k)
        )
    else:
        monkeypatch.setattr(MujocoWarpBackend, "_reset_to_default", fail)
    with pytest.raises(BackendError) as error:
        MujocoWarpBackend(wanted)
    number = int(
        re.search(r"200 worlds do not fit into the memory of cpu: about (\d+) would", str(error.value)).group(1)
    )
    assert 1 <= number < 200
    assert number * per_world <= free < (number + 1) * per_world
    assert "use fewer worlds" in str(error.value) and "\n" not in str(error.value)


def test_another_error_while_building_is_not_taken_for_too_little_memory(monkeypatch):
    def fail(*_):
        raise RuntimeError("something else")

    monkeypatch.setattr(MujocoWarpBackend, "_reset_to_default", fail)
    with pytest.raises(RuntimeError, match=r"^something else$"):
        MujocoWarpBackend(scene(FLAT))


def test_memory_is_drawn_from_measured_rows(tmp_path):
    draw, source, target = warp_throughput.plot_memory, tmp_path / "rows.json", tmp_path / "memory.svg"
    rows = [{"backend": "newton", "ground": "boxes", "worlds": n, "bytes_per_world": 1e5 + n} for n in (512, 1024)]
    failed = {"backend": "newton", "ground": "field", "worlds": 2048, "error": "too many"}
    source.write_text(json.dumps({"hardware": {"device": "a GPU"}, "rows": [*rows, failed]}))
    draw([source], target)
    text = target.read_text()
    assert text.startswith("<?xml") and "newton, boxes" in text and "1,024" in text and "2,048" not in text
    source.write_text(json.dumps({"hardware": {"device": "a GPU"}, "rows": [failed]}))
    with pytest.raises(SystemExit, match="no memory was measured"):
        draw([source], target)
