"""The Newton engine beyond the conformance checks: its solvers, its import of the robot, its tables, and other engines' company.

Newton takes seconds to import, so only those who run these tests do.
"""

from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.backends import BackendError, PhysicsOptions, Randomization, ResetState, Scene, Support
from gaitgauge.backends.base import CAPABILITY_NAMES
from gaitgauge.backends.mujoco.model import robot_spec
from gaitgauge.backends.registry import backend_class, make_backend
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Box, HeightField, Terrain
from gaitgauge.terrains.registry import make_terrain
from mujoco_warp_scenes import with_shell

ROBOT = load_robot("go2")
FLAT = Terrain(name="flat", family="flat")
BLOCK = Box(center=(0.0, 0.0, 0.1), half_size=(2.0, 2.0, 0.1))
WALL = Box(center=(3.0, 0.0, 0.5), half_size=(0.1, 2.0, 0.5), quaternion=(0.70710678, 0, 0, 0.70710678), wall=True)
BOXES = Terrain(name="boxes", family="boxes", boxes=(BLOCK, WALL))


def field(height):
    heights = np.full((4, 5), height)
    heights[0, 0] += 0.1
    return Terrain(
        name="field",
        family="field",
        height_field=HeightField(center=(0.5, 0.0), half_size=(2.0, 1.5), heights=heights),
    )


def scene(*terrains, index=None, **physics):
    terrains = terrains or (FLAT,)
    return Scene(
        robot=ROBOT,
        parameters=ROBOT.parameters["gauge"],
        terrains=terrains,
        terrain_index=tuple(range(len(terrains))) if index is None else index,
        physics=PhysicsOptions(**physics),
    )


def compiled(change=lambda spec: None):
    spec = robot_spec(scene())
    change(spec)
    return spec.compile()


def test_solvers_declare_every_capability():
    from gaitgauge.backends.newton.solvers import SOLVERS

    assert set(SOLVERS) == {"mujoco", "steel"}
    for name in SOLVERS:
        capabilities = backend_class("newton").with_solver(name).capabilities()
        assert set(capabilities) == set(CAPABILITY_NAMES)
        # what is not exact says why
        assert all(c.note for c in capabilities.values() if c.support is not Support.EXACT)


def test_solver_names():
    newton = backend_class("newton")
    assert newton.with_solver("mujoco") is newton
    steel = newton.with_solver("steel")
    assert steel.name == "newton:steel"
    assert steel.capabilities() is not newton.capabilities()
    with pytest.raises(BackendError, match="unknown Newton solver 'bullet'; 'newton:NAME' runs mujoco and steel"):
        make_backend("newton:bullet", scene())


@pytest.mark.parametrize(
    ("solver", "physics", "says"),
    [
        ("steel", {"foot_condim": 6}, "foot_condim_6"),
        ("steel", {"foot_condim": 4}, "foot_condim_6"),
        ("steel", {"cone": "pyramidal"}, "pyramidal"),
        ("mujoco", {"contacts_per_world": 0}, "contacts_per_world is 0"),
    ],
)
def test_refusals_say_what_to_change(solver, physics, says):
    with pytest.raises(BackendError, match=says) as refused:
        make_backend(f"newton:{solver}", scene(**physics))
    assert "PhysicsOptions" in str(refused.value)


def test_what_is_seen_alone_is_weighed_before_it_is_left_out(tmp_path):
    """Newton imports no such shapes; where MuJoCo weighs shapes, they are part of what a body weighs."""
    pytest.importorskip("newton")
    from gaitgauge.backends.newton.model import _compiled_robot

    wanted = replace(scene(), robot=with_shell(tmp_path, 'inertiafromgeom="true" '))
    expected = mujoco.MjModel.from_xml_path(str(wanted.robot.mjcf))
    model, _ = _compiled_robot(wanted)
    assert model.geom_contype.all()
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_allclose(getattr(model, name), getattr(expected, name), rtol=1e-9, atol=1e-12, err_msg=name)


def test_devices_that_do_not_exist():
    with pytest.raises(BackendError, match="no device 'tpu'; give cpu, cuda or cuda:N"):
        make_backend("newton", scene(), device="tpu")


@pytest.mark.parametrize("legs_meet", [True, False])
def test_ground_meets_all_but_ground(legs_meet):
    """Newton sorts who may touch whom into 32 masks. Ground that may touch ground filled them all."""
    from gaitgauge.backends.newton.model import build_world_model

    world = build_world_model(scene(BOXES, self_collision=legs_meet), device="cpu", gap=0.0, skin=True)
    groups = world.model.shape_collision_group.numpy()
    ground = world.layout.shape_ground.astype(bool)
    assert len(set(groups[ground])) == 1 and groups[ground][0] < 0 and groups[ground][0] not in groups[~ground]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["go2", "go1", "anymal_c"])
@pytest.mark.parametrize("legs_meet", [True, False])
def test_boxes_a_height_field_and_legs_that_meet_fit_into_one_scene(name, legs_meet):
    robot = load_robot(name)
    terrains = tuple(make_terrain(ground, level) for ground, level in (("flat", 0), ("stairs_fd", 5), ("wave", 4)))
    parameters = robot.parameters[robot.default_parameters]
    physics = PhysicsOptions(self_collision=legs_meet)
    whole = Scene(robot=robot, parameters=parameters, terrains=terrains, terrain_index=(0, 1, 2), physics=physics)
    with closing(make_backend("newton", whole)) as engine:
        model = engine._solver.solver.mj_model
        of_ground = model.geom_bodyid == 0
        meet = (model.geom_contype[:, None] & model.geom_conaffinity[None]) != 0
        meet |= meet.T
        assert of_ground.sum() > 20 and meet[np.ix_(of_ground, ~of_ground)].all(), "every part meets every ground"
        robots = meet[np.ix_(~of_ground, ~of_ground)]
        assert robots.any() == legs_meet
        start = engine.standing()
        engine.reset(start)
        for _ in range(25):
            engine.step(start.held_target)
        assert (engine.state.foot_contact_force_w.norm(dim=-1).sum(1) > 50.0).all()


def test_collisions_that_do_not_fit_into_newtons_masks_are_refused_in_a_sentence(monkeypatch):
    def full(*_, **__):
        raise ValueError("the masks are full")

    newton = pytest.importorskip("newton")
    monkeypatch.setattr(newton.solvers, "SolverMuJoCo", full)
    with pytest.raises(BackendError, match=r"masks are full; .*PhysicsOptions\(self_collision=False\)"):
        make_backend("newton", scene())


def test_slots_of_a_palette():
    from gaitgauge.backends.newton.model import PARKED, _slot_tables

    slots = _slot_tables((FLAT, BOXES, field(0.2), field(0.3)))
    assert slots.pose.shape == (4, 3, 7)
    np.testing.assert_allclose(slots.pose[0, :, :3], np.tile(PARKED, (3, 1)))
    np.testing.assert_allclose(slots.pose[1, 1], [3.0, 0.0, 0.5, 0.0, 0.0, 0.70710678, 0.70710678])  # xyzw
    np.testing.assert_allclose(slots.scale[1, 0], BLOCK.half_size)
    np.testing.assert_array_equal(slots.wall, [[0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(slots.pose[2, 2, :3], [0.5, 0.0, 0.0])
    np.testing.assert_array_equal(slots.field, [0, 0, 0, 1])


def test_import_differences_are_found():
    from gaitgauge.backends.newton.import_check import import_differences

    order = np.arange(compiled().ngeom)
    assert import_differences(compiled(), compiled(), order) == []

    def heavier(spec):
        spec.body("FL_calf").mass *= 1.01

    def slippery(spec):
        spec.geom("FL").condim = 3

    def alone(spec):
        spec.geom("base_trunk").contype = spec.geom("base_trunk").conaffinity = 0

    assert "body_mass is off" in import_differences(compiled(heavier), compiled(), order)[0]
    assert "geom_condim is off by 3" in import_differences(compiled(slippery), compiled(), order)[0]
    assert any(
        "'base_trunk'" in w and "do not collide" in w for w in import_differences(compiled(alone), compiled(), order)
    )


def test_dry_friction_slope_stops_a_joint_within_a_step_or_two():
    from gaitgauge.backends.dry_friction import dry_friction_slope

    reference = compiled()
    dofs = np.array([int(reference.joint(name).dofadr[0]) for name in ROBOT.joint_names])
    timestep = 0.002
    slope = dry_friction_slope(reference, dofs, timestep)
    # explicit damping with this slope is stable in all coupled directions: the largest eigenvalue of dt M⁻¹ K is below 2
    data = mujoco.MjData(reference)
    mujoco.mj_forward(reference, data)
    inertia = np.zeros((reference.nv, reference.nv))
    mujoco.mj_fullM(reference, data, inertia)
    damping = np.zeros(reference.nv)
    damping[dofs] = slope
    largest = np.linalg.eigvals(timestep * np.linalg.inv(inertia) * damping).real.max()
    assert 0.5 < largest < 2.0


@pytest.mark.slow
def test_every_field_of_the_palette_is_in_the_model():
    from gaitgauge.backends.newton.model import build_world_model, carriers

    for worlds in (1, 2, 5):
        terrains = (field(0.1), FLAT, field(0.2), field(0.3))
        world = build_world_model(scene(*terrains, index=(0,) * worlds), device="cpu", gap=0.0, skin=True)
        found = [world.model.shape_source[s] for s in carriers(world.layout, world.slots, worlds)]
        np.testing.assert_allclose([f.min_z for f in found], [0.1, 0.2, 0.3])
        assert len(set(carriers(world.layout, world.slots, worlds))) == 3


def stand(name, *, height=0.36, friction=0.6, periods=25, **physics):
    """Two robots dropped on the floor and on a block, held at their default pose."""
    engine = make_backend(name, scene(FLAT, BOXES, **physics))
    kind = engine.dtype
    engine.randomize(Randomization(friction=torch.full((2,), friction, dtype=kind)))
    engine.reset(
        ResetState(
            base_position=torch.tensor([[0.0, 0.0, height], [0.0, 0.0, height + 0.2]], dtype=kind),
            base_quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=kind).repeat(2, 1),
            held_target=torch.tensor(ROBOT.default_joint_position, dtype=kind).repeat(2, 1),
        )
    )
    for _ in range(periods):
        engine.step(None)
    state = engine.state
    return SimpleNamespace(
        base=state.base_position_w.double().numpy(),
        joints=state.joint_position.double().numpy(),
        force=state.ground_force_w.double().numpy(),
        feet=state.foot_normal_force.double().numpy(),
        overflowed=bool(state.overflowed.any()),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "physics", [{}, {"timestep": 0.005, "substeps": 4, "cone": "pyramidal", "foot_condim": 3, "self_collision": False}]
)
def test_the_mujoco_solver_stands_as_mujoco_does(physics):
    expected, found = stand("mujoco", **physics), stand("newton", **physics)
    np.testing.assert_allclose(found.base, expected.base, atol=2e-4)
    np.testing.assert_allclose(found.joints, expected.joints, atol=2e-3)
    np.testing.assert_allclose(found.feet, expected.feet, rtol=0.02, atol=0.5)
    assert not found.overflowed


@pytest.mark.slow
def test_steel_stands_nearly_as_mujoco_does():
    expected, found = stand("mujoco"), stand("newton:steel")
    np.testing.assert_allclose(found.base[:, 2], expected.base[:, 2], atol=0.015)
    np.testing.assert_allclose(found.joints, expected.joints, atol=0.15)
    np.testing.assert_allclose(found.base[1] - found.base[0], [0.0, 0.0, 0.2], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["mujoco", "steel"])
def test_a_small_buffer_overflows_and_says_so(solver):
    assert stand(f"newton:{solver}", contacts_per_world=4, height=0.05, periods=2).overflowed
    assert not stand(f"newton:{solver}", contacts_per_world=60, height=0.3, periods=2).overflowed


@pytest.mark.slow
def test_every_alarm_but_that_of_a_spent_solver_is_an_overflow():
    """A pair of shapes whose search has no room for its horizon ends without a contact (``mujoco_warp/_src/collision_gjk.py``)."""
    mujoco_warp = pytest.importorskip("mujoco_warp")
    warp = pytest.importorskip("warp")
    adapter = make_backend("newton", scene())._solver
    told = set()
    for alarm in mujoco_warp.OverflowType:
        adapter._data.overflow.fill_(int(alarm))
        overflowed = warp.zeros(1, dtype=warp.bool)
        adapter.collect_overflow(warp.ones(1, dtype=int), overflowed)
        if overflowed.numpy()[0]:
            told.add(alarm.name)
    assert told == {a.name for a in mujoco_warp.OverflowType} - {"NONE", "ITERATIONS", "LS_ITERATIONS"}


@pytest.mark.slow
def test_randomizing_some_worlds_takes_a_row_for_each():
    engine = make_backend("newton:steel", scene(index=(0, 0, 0)))
    mask = torch.tensor([True, False, True])
    engine.randomize(Randomization(motor_offset=torch.ones(2, 12), friction=torch.tensor([0.3, 0.7])), mask)
    assert engine._motors.offset[:, 0].tolist() == [1.0, 0.0, 1.0]
    np.testing.assert_allclose(engine._masses.friction[:, 5], [0.3, 0.4, 0.7])
    engine.randomize(Randomization(friction=torch.tensor([0.5, 0.6, 0.8])), mask)  # a row for every world does as well
    np.testing.assert_allclose(engine._masses.friction[:, 5], [0.5, 0.4, 0.8])
    with pytest.raises(BackendError, match="friction has 4 rows for 2 worlds"):
        engine.randomize(Randomization(friction=torch.ones(4)), mask)


def test_the_solver_settings_told_are_those_asked_for():
    asked = PhysicsOptions(tolerance=1e-8, iterations=30)
    newton = backend_class("newton")
    assert newton.solver_settings(asked)["tolerance"] == 1e-6
    assert newton.with_solver("steel").solver_settings(asked) == {"cone": "elliptic", "iterations": 30}


@pytest.mark.slow  # compiles its kernels on the first machine that runs it: minutes
def test_the_solver_settings_told_are_those_that_act():
    option = make_backend("newton", scene(tolerance=1e-8, iterations=30))._solver._model.opt
    np.testing.assert_allclose(option.tolerance.numpy(), 1e-6)
    assert option.iterations == 30
