"""The mujoco_warp engine beyond the conformance checks: its agreement with the C engine, its order, its graphs."""

import math
from dataclasses import fields

import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.backends import BackendError, PhysicsState, Randomization, ResetState
from gaitgauge.backends.mujoco_warp import MujocoWarpBackend
from gaitgauge.backends.mujoco_warp.model import build_shared_model
from gaitgauge.backends.registry import make_backend
from gaitgauge.backends.upstream.order import ContactFields, RowFields
from mujoco_warp_scenes import BOXES, COARSE, FINE, FLAT, ROBOT, TRAINING, scene, upright

# ---- physics against the C engine ----------------------------------------------------------------------------------


def run_both(wanted, height, targets, **step):
    """The same targets in both engines; the two states as dictionaries of float64 arrays, one entry per step."""
    out = []
    for name in ("mujoco", "mujoco-warp"):
        backend = make_backend(name, wanted)
        backend.randomize(Randomization(friction=torch.full((backend.num_worlds,), 0.8, dtype=backend.dtype)))
        backend.reset(ResetState(**upright(backend, height)))
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
    backend.reset(ResetState(**pose))
    for _ in range(50):
        backend.step(pose["held_target"])
    height = backend.state.base_position_w[:, 2].numpy() - ground
    np.testing.assert_allclose(height, height[0], atol=4e-3)  # dry friction in the joints leaves that much open
    # every world on another world's terrain
    moved = upright(backend, ground[order] + 0.31)
    backend.reset(ResetState(**moved, terrain_index=order))
    for _ in range(50):
        backend.step(pose["held_target"])
    np.testing.assert_allclose(backend.state.base_position_w[:, 2].numpy() - ground[order], height[0], atol=4e-3)
    np.testing.assert_allclose(backend.state.ground_force_w[:, 2].numpy(), 15.2 * 9.81, rtol=0.05)
    assert not backend.state.overflowed.any()
    with pytest.raises(BackendError, match="terrains are 0 to 3"):
        backend.reset(ResetState(**moved, terrain_index=torch.tensor([0, 1, 2, 4])))


@pytest.mark.slow
def test_too_few_contacts_are_reported_until_the_reset():
    backend = MujocoWarpBackend(scene(FLAT, FLAT, contacts_per_world=1, foot_condim=3))
    # one robot lies on its side, with more contacts than its constraint rows can hold; the other hangs in the air
    arguments = upright(backend, [0.1, 5.0])
    backend.reset(ResetState(**arguments))
    for _ in range(8):
        backend.step(arguments["held_target"])
    assert backend.state.overflowed.tolist() == [True, False]
    arguments["base_position"][:, 2] = 5.0
    backend.reset(ResetState(**arguments))
    assert backend.state.overflowed.tolist() == [False, False]


@pytest.mark.slow
def test_a_diverged_world_is_parked_and_the_others_do_not_notice():
    wanted = scene(FLAT, index=(0, 0, 0))
    pose = torch.tensor(ROBOT.default_joint_position).repeat(3, 1)
    heights = []
    for broken in (False, True):
        backend = MujocoWarpBackend(wanted)
        backend.reset(ResetState(**upright(backend, 0.33)))
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
        backend.reset(ResetState(**upright(backend, 0.3)))
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
    friction = backend._masses._friction
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
    backend.reset(ResetState(**upright(backend, 2.0)))
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
    for name in ContactFields.vars:
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
        backend.reset(ResetState(**arguments))
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
    backend.reset(ResetState(**arguments))
    for _ in range(12):
        backend.step(arguments["held_target"])
    data, random = backend._data, np.random.default_rng(0)
    before = {name: getattr(data.efc, name).numpy().copy() for name in RowFields.vars}
    address = data.contact.efc_address.numpy().copy()
    for name in RowFields.vars:
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
    for name in RowFields.vars:
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
        backend.reset(ResetState(**arguments, terrain_index=index), mask)
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
        backend.reset(ResetState(**arguments))
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
