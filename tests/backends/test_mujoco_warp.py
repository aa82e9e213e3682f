"""The mujoco_warp engine beyond the conformance checks: its tables, its errors, and its agreement with the C engine."""

import json
import math
import re
from dataclasses import fields, replace
from pathlib import Path

import mujoco
import mujoco_warp
import numpy as np
import pytest
import torch
import warp_throughput
from gaitgauge.backends import BackendError, PhysicsOptions, PhysicsState, Randomization, Scene
from gaitgauge.backends.mujoco_warp import MujocoWarpBackend
from gaitgauge.backends.mujoco_warp.device import (
    DeviceScope,
    bytes_per_world,
    is_memory_error,
    memory_advice,
)
from gaitgauge.backends.mujoco_warp.model import PARKED, Capacity, buffer_capacity, build_shared_model
from gaitgauge.backends.mujoco_warp.order import CONTACT_FIELDS, ROW_FIELDS
from gaitgauge.backends.registry import make_backend
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Box, HeightField, Terrain

ROOT = Path(__file__).parents[2]
ROBOT = load_robot("go2")
FLAT = Terrain(name="flat", family="flat")
BLOCK = Box(center=(0.0, 0.0, 0.1), half_size=(2.0, 2.0, 0.1))
WALL = Box(
    center=(3.0, 0.0, 0.5), half_size=(0.1, 2.0, 0.5), quaternion=(math.sqrt(0.5), 0, 0, math.sqrt(0.5)), wall=True
)
BOXES = Terrain(name="boxes", family="boxes", boxes=(BLOCK, WALL))
COARSE = Terrain(
    name="coarse",
    family="field",
    height_field=HeightField(center=(0.5, 0.0), half_size=(2.0, 1.5), heights=np.full((4, 5), 0.3)),
)
FINE = Terrain(
    name="fine",
    family="field",
    height_field=HeightField(center=(0.0, 0.0), half_size=(2.0, 2.0), heights=np.full((21, 31), 0.05), base=0.2),
)
TRAINING = {
    "timestep": 0.005,
    "substeps": 4,
    "cone": "pyramidal",
    "impratio": 1.0,
    "foot_condim": 3,
    "self_collision": False,
}


def scene(*terrains, index=None, **physics):
    terrains = terrains or (FLAT,)
    index = tuple(range(len(terrains))) if index is None else index
    return Scene(
        robot=ROBOT,
        parameters=ROBOT.parameters["gauge"],
        terrains=terrains,
        terrain_index=index,
        physics=PhysicsOptions(**physics),
    )


def upright(backend, height):
    """Arguments of a reset at the given base heights, in the default pose, held there."""
    n = backend.num_worlds
    position = torch.zeros((n, 3), dtype=backend.dtype, device=backend.device)
    position[:, 2] = torch.as_tensor(height, dtype=backend.dtype)
    quaternion = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=backend.dtype, device=backend.device).repeat(n, 1)
    pose = torch.tensor(ROBOT.default_joint_position, dtype=backend.dtype, device=backend.device).repeat(n, 1)
    return {"base_position": position, "base_quaternion": quaternion, "held_target": pose}


# ---- tables --------------------------------------------------------------------------------------------------------


def test_palette_parks_unused_slots_and_bounds_the_used():
    shared = build_shared_model(scene(FLAT, BOXES, COARSE, FINE))
    palette = shared.palette
    assert palette.position.shape == (4, 3, 3)
    assert (palette.position[0] == PARKED).all() and (palette.position[1, 2] == PARKED).all()
    np.testing.assert_allclose(palette.position[1, :2], [BLOCK.center, WALL.center])
    np.testing.assert_array_equal(palette.wall, [[0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]])
    # the wall is turned by 90° about z: its own x axis points along the world's y
    np.testing.assert_allclose(palette.rotation[1, 1] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(palette.radius[1, 0], np.linalg.norm(BLOCK.half_size))
    np.testing.assert_array_equal(palette.field, [0, 0, 0, 1])
    np.testing.assert_allclose(palette.position[2:, 2], [(0.5, 0, 0), (0, 0, 0)])
    low, high = palette.bound_center - palette.bound_half, palette.bound_center + palette.bound_half
    np.testing.assert_allclose((low[3, 2, 2], high[3, 2, 2]), (-0.2, 0.05))


def test_bounds_are_those_of_the_compiler():
    shared = build_shared_model(scene(COARSE))
    model, geom = shared.model, shared.slot_geom[-1]
    np.testing.assert_allclose(shared.palette.bound_center[0, -1], model.geom_aabb[geom, :3], atol=1e-6)
    np.testing.assert_allclose(shared.palette.bound_half[0, -1], model.geom_aabb[geom, 3:], atol=1e-6)
    np.testing.assert_allclose(shared.palette.radius[0, -1], model.geom_rbound[geom], rtol=1e-6)
    np.testing.assert_allclose(shared.palette.size[0, -1], model.geom_size[geom], rtol=1e-6)


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
    assert [names[g] for g in np.flatnonzero(shared.geom_ground)] == ["floor", "box_0", "box_1"]
    assert [names[g] for g in np.flatnonzero(shared.geom_foot >= 0)] == list(ROBOT.foot_names)
    assert shared.geom_body[names.index("FL")] == ROBOT.collision_bodies.index("FL_calf")
    assert (shared.geom_body[shared.geom_ground == 1] == -1).all()


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
    def fail(_):
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


def test_capacity_is_plain_data():
    assert Capacity(contacts=1, convex=1, rows=16) == Capacity(contacts=1, convex=1, rows=16)


# ---- physics against the C engine ----------------------------------------------------------------------------------


def run_both(wanted, height, targets, **step):
    """The same targets in both engines; the two states as dictionaries of float64 arrays, one entry per step."""
    out = []
    for name in ("mujoco", "mujoco-warp"):
        backend = make_backend(name, wanted)
        backend.randomize(Randomization(friction=torch.full((backend.num_worlds,), 0.8, dtype=backend.dtype)))
        backend.reset(**upright(backend, height))
        states = []
        for target in targets:
            backend.step(torch.as_tensor(target, dtype=backend.dtype), **step)
            state = backend.state
            states.append({f.name: getattr(state, f.name).double().numpy().copy() for f in fields(PhysicsState)})
        backend.close()
        out.append(states)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("physics", [{}, TRAINING], ids=["elliptic", "pyramidal"])
def test_trajectories_and_forces_agree_with_mujoco(physics):
    random = np.random.default_rng(1)
    wanted = scene(FLAT, BOXES, **physics)
    pose = np.tile(ROBOT.default_joint_position, (2, 1))
    targets = [pose + 0.1 * random.standard_normal(pose.shape) for _ in range(12)]
    delay = torch.tensor([0, 2])
    reference, found = run_both(wanted, [0.36, 0.56], targets, delay=delay)
    for a, b in zip(reference, found, strict=True):
        np.testing.assert_allclose(b["base_position_w"], a["base_position_w"], atol=2e-3)
        np.testing.assert_allclose(b["joint_position"], a["joint_position"], atol=2e-2)
    for name, tolerance in (("foot_position_w", 1e-4), ("foot_velocity_w", 2e-2), ("joint_torque", 0.05)):
        np.testing.assert_allclose(found[0][name], reference[0][name], atol=tolerance, err_msg=name)
    # then both stand still: the forces are those of equal poses
    reference, found = run_both(wanted, [0.30, 0.50], [pose] * 60)
    a, b = reference[-1], found[-1]
    for name, tolerance in (
        ("foot_contact_force_w", 0.3),
        ("foot_normal_force", 0.3),
        ("foot_tangential_force", 0.3),
        ("ground_force_w", 0.1),
        ("ground_moment_w", 0.1),
        ("contact_center_w", 1e-3),
        ("contact_count", 0),
        ("joint_torque", 0.05),
    ):
        np.testing.assert_allclose(b[name], a[name], atol=tolerance, err_msg=name)


@pytest.mark.slow
def test_palette_of_boxes_and_unequal_height_fields():
    backend = MujocoWarpBackend(scene(FLAT, BOXES, COARSE, FINE))
    ground = np.array([0.0, 0.2, 0.3, 0.05])
    order = torch.tensor([2, 3, 0, 1])
    pose = upright(backend, ground + 0.31)
    backend.reset(**pose)
    for _ in range(50):
        backend.step(pose["held_target"])
    height = backend.state.base_position_w[:, 2].numpy() - ground
    np.testing.assert_allclose(height, height[0], atol=4e-3)  # dry friction in the joints leaves that much open
    # every world on another world's terrain
    moved = upright(backend, ground[order] + 0.31)
    backend.reset(**moved, terrain_index=order)
    for _ in range(50):
        backend.step(pose["held_target"])
    np.testing.assert_allclose(backend.state.base_position_w[:, 2].numpy() - ground[order], height[0], atol=4e-3)
    np.testing.assert_allclose(backend.state.ground_force_w[:, 2].numpy(), 15.2 * 9.81, rtol=0.05)
    assert not backend.state.overflowed.any()
    with pytest.raises(BackendError, match="terrains are 0 to 3"):
        backend.reset(**moved, terrain_index=torch.tensor([0, 1, 2, 4]))


@pytest.mark.slow
def test_too_few_contacts_are_reported_until_the_reset():
    backend = MujocoWarpBackend(scene(FLAT, FLAT, contacts_per_world=1, foot_condim=3))
    # one robot lies on its side, with more contacts than its constraint rows can hold; the other hangs in the air
    arguments = upright(backend, [0.1, 5.0])
    backend.reset(**arguments)
    for _ in range(8):
        backend.step(arguments["held_target"])
    assert backend.state.overflowed.tolist() == [True, False]
    arguments["base_position"][:, 2] = 5.0
    backend.reset(**arguments)
    assert backend.state.overflowed.tolist() == [False, False]


@pytest.mark.slow
def test_a_diverged_world_is_parked_and_the_others_do_not_notice():
    wanted = scene(FLAT, index=(0, 0, 0))
    pose = torch.tensor(ROBOT.default_joint_position).repeat(3, 1)
    heights = []
    for broken in (False, True):
        backend = MujocoWarpBackend(wanted)
        backend.reset(**upright(backend, 0.33))
        for i in range(4):
            targets = pose.clone()
            if broken and i == 1:
                targets[1, 4] = math.nan
            backend.step(targets)
        heights.append(backend.state.base_position_w.clone())
        assert backend.state.diverged.tolist() == [False, broken, False]
    assert torch.isfinite(heights[1]).all() and heights[1][1, 2] > 50.0
    assert torch.equal(heights[0][[0, 2]], heights[1][[0, 2]])
    assert (backend.state.ground_force_w[1] == 0).all() and (backend.state.joint_torque[1] == 0).all()


@pytest.mark.slow
def test_worlds_that_must_not_step_have_no_contacts_meanwhile_and_go_on_as_if_nothing_had_been():
    """Contacts are what a step takes its time for. Interrupted between two steps, a robot that lands goes on to the last bit."""
    pose = torch.tensor(ROBOT.default_joint_position).repeat(2, 1)
    ends = []
    for pauses in (0, 3):
        backend = MujocoWarpBackend(scene(FLAT, index=(0, 0)))
        backend.reset(**upright(backend, 0.3))
        for step in range(6):
            backend.step(pose)
            for _ in range(pauses if step == 3 else 0):
                backend.step(pose, worlds=torch.tensor([True, False]))
                count = int(backend._data.nacon.numpy()[0])
                assert count > 0 and not backend._data.contact.worldid.numpy()[:count].any()
        ends.append({f.name: getattr(backend.state, f.name)[1].clone() for f in fields(PhysicsState)})
    assert ends[0]["foot_normal_force"].sum() > 50.0
    for name, value in ends[0].items():
        assert torch.equal(value, ends[1][name]), name


@pytest.mark.slow
def test_randomization_rows_for_masked_worlds_or_for_all():
    backend = MujocoWarpBackend(scene(FLAT, index=(0, 0, 0, 0)))
    mask = torch.tensor([False, True, False, True])
    whole = torch.tensor([0.1, 0.2, 0.3, 0.4])
    friction = backend._parameters._friction
    before = friction.clone()
    backend.randomize(Randomization(friction=whole[mask]), mask)
    assert torch.equal(friction[mask, :, 0], whole[mask][:, None].expand(-1, friction.shape[1]))
    assert torch.equal(friction[~mask], before[~mask])
    backend.randomize(Randomization(friction=1.0 + whole), mask)
    assert torch.allclose(friction[mask, :, 0], 1.0 + whole[mask][:, None])
    assert torch.equal(friction[~mask], before[~mask])
    with pytest.raises(BackendError, match="3 rows for 2 worlds"):
        backend.randomize(Randomization(friction=whole[:3]), mask)
    # constants that follow from masses are those that MuJoCo computes
    backend.randomize(Randomization(base_mass_offset=torch.tensor([2.0])), torch.tensor([False, True, False, False]))
    model = build_shared_model(backend.scene).model
    model.body_mass[1] += 2.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    np.testing.assert_allclose(backend._model.dof_invweight0.numpy()[1], model.dof_invweight0, rtol=1e-4)
    np.testing.assert_allclose(backend._model.body_invweight0.numpy()[1], model.body_invweight0, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(backend._model.body_subtreemass.numpy()[1], model.body_subtreemass, rtol=1e-5)
    assert np.all(backend._model.body_subtreemass.numpy()[0, 1] == pytest.approx(model.body_subtreemass[1] - 2.0))


@pytest.mark.slow
def test_a_target_delayed_by_the_whole_period_acts_in_the_next():
    backend = MujocoWarpBackend(scene(FLAT, index=(0, 0), substeps=4))
    backend.reset(**upright(backend, 2.0))
    pose = torch.tensor(ROBOT.default_joint_position).repeat(2, 1)
    whole = torch.tensor([4, 4])
    backend.step(pose + 0.1, delay=whole)
    assert backend.state.joint_torque.abs().max() < 0.5  # still the held pose
    backend.step(pose + 0.5, delay=whole)
    assert (backend.state.joint_torque > 0.5).all()  # the first step's target


# ---- order -----------------------------------------------------------------------------------------------------------


def shuffle_contacts(data, random):
    count = int(data.nacon.numpy()[0])
    order = random.permutation(count)
    for name in CONTACT_FIELDS:
        array = getattr(data.contact, name)
        values = array.numpy().copy()
        values[:count] = values[:count][order]
        array.assign(values)


@pytest.mark.slow
def test_deterministic_mode_does_not_depend_on_the_order_of_contacts():
    wanted = scene(FLAT, BOXES, COARSE, deterministic=True, **TRAINING)
    runs = []
    for shuffled in (False, True):
        backend, random = MujocoWarpBackend(wanted), np.random.default_rng(0)
        callback, generator = backend._model.callback, torch.Generator().manual_seed(0)
        if shuffled:
            inner = callback.contactfilter

            def mix(model, data, inner=inner, random=random):
                shuffle_contacts(data, random)
                inner(model, data)

            callback.contactfilter = mix
        arguments = upright(backend, [0.31, 0.51, 0.61])
        backend.reset(**arguments)
        for _ in range(12):
            backend.step(arguments["held_target"] + 0.3 * torch.randn((3, 12), generator=generator))
        runs.append(backend.state)
    assert (runs[0].contact_count > 0).all()
    for item in fields(PhysicsState):
        assert torch.equal(getattr(runs[0], item.name), getattr(runs[1], item.name)), item.name


@pytest.mark.slow
def test_rows_come_into_order_and_contacts_find_theirs():
    backend = MujocoWarpBackend(scene(FLAT, BOXES, COARSE, deterministic=True, **TRAINING))
    arguments = upright(backend, [0.31, 0.51, 0.61])
    backend.reset(**arguments)
    for _ in range(12):
        backend.step(arguments["held_target"])
    data, random = backend._data, np.random.default_rng(0)
    before = {name: getattr(data.efc, name).numpy().copy() for name in ROW_FIELDS}
    address = data.contact.efc_address.numpy().copy()
    for name in ROW_FIELDS:
        mixed = before[name].copy()
        for world in range(3):
            first = int(data.ne.numpy()[world] + data.nf.numpy()[world] + data.nl.numpy()[world])
            last = int(data.nefc.numpy()[world])
            assert last - first >= 8 and (last - first) % 4 == 0  # pyramids of sliding contacts have 4 rows
            blocks = np.arange(first, last).reshape(-1, 4)[::-1].ravel()
            mixed[world, first:last] = before[name][world, blocks]
            joints = slice(int(data.ne.numpy()[world]), int(data.ne.numpy()[world] + data.nf.numpy()[world]))
            mixed[world, joints] = before[name][world, joints][::-1]
        getattr(data.efc, name).assign(mixed)
    data.contact.efc_address.assign(random.permutation(address))
    backend._order.sort_rows(data)
    for name in ROW_FIELDS:
        np.testing.assert_array_equal(getattr(data.efc, name).numpy(), before[name], err_msg=name)
    count = int(data.nacon.numpy()[0])
    active = address[:count, 0] >= 0
    np.testing.assert_array_equal(data.contact.efc_address.numpy()[:count][active], address[:count][active])


# ---- GPU ---------------------------------------------------------------------------------------------------------


@pytest.mark.gpu
def test_nothing_waits_for_the_gpu():
    backend = MujocoWarpBackend(scene(FLAT, BOXES, index=(0, 1) * 32, **TRAINING), device="cuda")
    arguments, n = upright(backend, 0.6), backend.num_worlds
    pose, mask = arguments["held_target"], torch.rand(n, device="cuda") < 0.5
    delay, index = torch.randint(0, 5, (n,), device="cuda"), torch.randint(0, 2, (n,), device="cuda")
    backend.step(pose, delay=delay, sample_at=delay)  # records the graph
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        backend.reset(mask, **arguments, terrain_index=index)
        backend.randomize(Randomization(friction=torch.rand(n, device="cuda"), motor_strength=0.9 * pose), mask)
        backend.step(pose, delay=delay, worlds=mask)
        backend.step(pose, delay=delay, sample_at=delay)
        backend.push(mask, linear_velocity_w=torch.zeros((n, 3), device="cuda"))
        backend.apply_force(torch.zeros((n, 3), device="cuda"))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.isfinite(backend.state.base_position_w).all()


@pytest.mark.gpu
def test_gpu_and_cpu_agree():
    wanted = scene(FLAT, BOXES, COARSE, index=(0, 1, 2), **TRAINING)
    states = []
    for device in ("cpu", "cuda"):
        backend = MujocoWarpBackend(wanted, device=device)
        arguments = upright(backend, [0.31, 0.51, 0.61])
        backend.reset(**arguments)
        for _ in range(40):
            backend.step(arguments["held_target"])
        states.append(backend.state)
    a, b = states
    np.testing.assert_allclose(b.base_position_w.cpu(), a.base_position_w, atol=1e-3)
    np.testing.assert_allclose(b.ground_force_w.cpu(), a.ground_force_w, atol=1.0)
    np.testing.assert_allclose(b.joint_torque.cpu(), a.joint_torque, atol=0.2)


def test_the_solver_settings_told_are_those_that_act():
    with_defaults = scene(tolerance=1e-8, iterations=30)
    told = MujocoWarpBackend.solver_settings(with_defaults.physics)
    assert told == {"cone": "elliptic", "impratio": 100.0, "iterations": 30, "ls_iterations": 50, "tolerance": 1e-6}
    option = MujocoWarpBackend(with_defaults)._model.opt
    assert option.iterations == 30
    np.testing.assert_allclose(option.tolerance.numpy(), 1e-6)
    loose = scene(tolerance=1e-4)
    assert MujocoWarpBackend.solver_settings(loose.physics)["tolerance"] == 1e-4
    np.testing.assert_allclose(MujocoWarpBackend(loose)._model.opt.tolerance.numpy(), 1e-4)
