"""What tests of the rooms above rely on in the scripted engine."""

import math
from dataclasses import fields, replace

import pytest
import torch
from gaitgauge.backends import (
    BackendError,
    PhysicsOptions,
    PhysicsState,
    Randomization,
    ResetState,
    Scene,
    backend_names,
    make_backend,
)
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Terrain
from gaitgauge_fake_engine import FALL_DURATION, GRAVITY, FakeBackend, FakeScript, rotate, turn

ROBOT = load_robot("go2")
NEVER = math.inf


def scene(worlds=3, **physics):
    return Scene(
        robot=ROBOT,
        parameters=ROBOT.parameters["gauge"],
        terrains=(Terrain(name="flat", family="flat"),) * 2,
        terrain_index=(0,) * worlds,
        physics=PhysicsOptions(**physics),
    )


def started(script=None, worlds=3, **physics):
    backend = FakeBackend(scene(worlds, **physics), script=script)
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(worlds, 1)
    backend.reset(ResetState(base_position=torch.tensor([0.0, 0.0, 0.3]).repeat(worlds, 1), base_quaternion=upright))
    return backend


def times(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_the_registry_finds_it_as_it_finds_any_plugin():
    assert isinstance(make_backend("fake", scene()), FakeBackend)
    assert backend_names()[-1] == "fake"


def test_a_constant_twist_draws_a_circle():
    forward, yaw_rate = 0.8, 0.5

    def motion(backend):
        linear, angular = torch.zeros(2, backend.num_worlds, 3, dtype=torch.float64)
        linear[:, 0], angular[:, 2] = forward, yaw_rate
        return linear, angular

    backend = started(FakeScript(motion=motion), worlds=1)
    for _ in range(50):
        backend.step(None)
    state, angle, radius = backend.state, yaw_rate * 1.0, forward / yaw_rate
    assert state.base_quaternion_w[0, 3].item() == pytest.approx(math.sin(angle / 2))
    expected = torch.tensor([radius * math.sin(angle), radius * (1 - math.cos(angle)), 0.3], dtype=torch.float64)
    torch.testing.assert_close(state.base_position_w[0], expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(
        state.base_linear_velocity_w[0],
        forward * torch.tensor([math.cos(angle), math.sin(angle), 0.0]).double(),
        atol=1e-3,
        rtol=0,
    )


def test_a_motion_may_follow_the_joint_targets():
    def motion(backend):
        linear, angular = torch.zeros(2, backend.num_worlds, 3, dtype=torch.float64)
        linear[:, 0] = backend.targets[:, 0]
        return linear, angular

    backend = started(FakeScript(motion=motion))
    targets = torch.zeros(3, 12)
    targets[:, 0] = torch.tensor([0.0, 0.5, 1.0])
    backend.step(targets)
    torch.testing.assert_close(backend.state.base_linear_velocity_w[:, 0], times(0.0, 0.5, 1.0))
    torch.testing.assert_close(backend.state.base_position_w[:, 0], times(0.0, 0.01, 0.02))


def test_joints_follow_the_motor_law_or_their_targets():
    backend = started()
    target = backend.default_pose + 0.1
    backend.step(target, substeps=1)
    torch.testing.assert_close(backend.state.joint_torque, torch.full((3, 12), 2.0).double())
    torch.testing.assert_close(backend.state.joint_velocity, torch.full((3, 12), 2.0 * 0.002).double())
    backend = started(FakeScript(joint_law="track"))
    backend.step(target, delay=torch.tensor([0, 9, 10]))
    torch.testing.assert_close(backend.state.joint_position[:2], target[:2])
    torch.testing.assert_close(backend.state.joint_position[2], backend.default_pose[2])
    torch.testing.assert_close(backend.state.joint_velocity[1], torch.full((12,), 0.1 / 0.002).double())
    torch.testing.assert_close(backend.state.joint_velocity[0], torch.zeros(12).double())
    with pytest.raises(BackendError, match="joint_law 'magic'"):
        started(FakeScript(joint_law="magic")).step(target)


def test_a_fall_tips_the_base_and_trips_the_watch():
    backend = started(FakeScript(fall_time=times(0.05, NEVER, 0.0)), watch_tilt=math.radians(45))
    tripped = []
    for _ in range(20):
        backend.step(None)
        tripped.append(backend.state.tilt_substep.clone())
    state = backend.state
    up = rotate(state.base_quaternion_w, torch.tensor([0.0, 0.0, 1.0]).double())
    torch.testing.assert_close(up[:, 2], times(0.0, 1.0, 0.0), atol=0.05, rtol=0)
    first = [next((i for i, t in enumerate(tripped) if t[w]), None) for w in range(3)]
    # 45 degrees are half of the fall: 0.05 + 0.125 s and 0.125 s after the start, in control periods of 0.02 s
    assert first[0] in (8, 9) and first[1] is None and first[2] == 6
    assert 0.0 < FALL_DURATION < 0.4
    assert state.foot_contact_force_w[0].abs().max() == 0.0
    weight = 15.0 * GRAVITY
    assert state.body_contact_force_w[0, ROBOT.collision_bodies.index(ROBOT.base_body), 2].item() == pytest.approx(
        weight
    )
    assert state.base_position_w[1, 2].item() == pytest.approx(0.3)
    assert state.base_position_w[0, 2].item() < 0.2
    assert state.base_angular_velocity_b[0].abs().max() == 0.0


def test_divergence_penetration_and_overflow_come_at_their_times():
    script = FakeScript(
        diverge_time=times(0.03, NEVER, NEVER),
        penetration_time=times(NEVER, 0.026, NEVER),
        overflow_time=times(NEVER, NEVER, 0.04),
    )
    backend = started(script, watch_penetration=0.01)
    backend.step(None)
    assert not backend.state.diverged.any() and not backend.state.overflowed.any()
    assert backend.state.penetration_substep.tolist() == [0, 0, 0]
    backend.step(None)
    state = backend.state
    assert state.diverged.tolist() == [True, False, False]
    assert state.base_position_w[0].isnan().all() and state.joint_position[0].isnan().all()
    assert state.base_position_w[1:].isfinite().all()
    assert state.penetration_substep.tolist() == [0, 3, 0]
    assert state.overflowed.tolist() == [False, False, True]
    start = torch.zeros(3, 3)
    backend.reset(ResetState(base_position=start, base_quaternion=torch.tensor([1.0, 0, 0, 0]).repeat(3, 1)))
    for field in fields(PhysicsState):
        assert getattr(backend.state, field.name).isfinite().all(), field.name
    assert not backend.state.diverged.any() and not backend.state.overflowed.any()


def test_contacts_share_the_weight_and_add_up():
    backend = started()
    backend.randomize(Randomization(base_mass_offset=times(3.0)), torch.tensor([False, True, False]))
    backend.step(None)
    state = backend.state
    torch.testing.assert_close(state.ground_force_w[:, 2], GRAVITY * times(15.0, 18.0, 15.0))
    torch.testing.assert_close(state.foot_normal_force.sum(1), state.ground_force_w[:, 2])
    torch.testing.assert_close(state.contact_center_w[:, :2], state.base_position_w[:, :2])
    assert state.contact_count.tolist() == [4, 4, 4]
    assert state.ground_moment_w.abs().max().item() < 1e-12


def test_foot_forces_can_be_scripted():
    def force(backend):
        forces = torch.zeros(backend.num_worlds, 4, 3, dtype=torch.float64)
        forces[:, 0] = torch.tensor([3.0, 4.0, 100.0])
        return forces

    backend = started(FakeScript(foot_force=force))
    backend.step(None)
    state = backend.state
    assert state.contact_count.tolist() == [1, 1, 1]
    torch.testing.assert_close(state.contact_center_w, state.foot_position_w[:, 0])
    torch.testing.assert_close(state.foot_tangential_force[:, 0], times(5.0, 5.0, 5.0))
    torch.testing.assert_close(state.ground_force_w[0], times(3.0, 4.0, 100.0))


def test_feet_move_with_the_base():
    backend = started()
    backend.push(angular_velocity_b=torch.tensor([0.0, 0.0, 2.0]).repeat(3, 1))
    before = backend.state.foot_position_w.clone()
    backend.step(None, substeps=1)
    moved = (backend.state.foot_position_w - before) / 0.002
    torch.testing.assert_close(moved, backend.state.foot_velocity_w, atol=2e-3, rtol=0)
    assert moved[0, 0, 0].item() == pytest.approx(-2.0 * 0.14, abs=5e-3)


def test_external_force_and_terrain_are_kept_until_a_reset():
    backend = started()
    backend.apply_force(torch.tensor([15.0, 0.0, 0.0]).repeat(3, 1))
    backend.step(None)
    torch.testing.assert_close(backend.state.base_linear_velocity_w[:, 0], times(0.02, 0.02, 0.02))
    backend.reset(
        ResetState(
            base_position=torch.zeros(3, 3),
            base_quaternion=torch.tensor([1.0, 0, 0, 0]).repeat(3, 1),
            terrain_index=torch.tensor([1, 1, 1]),
        ),
        torch.tensor([True, False, False]),
    )
    backend.step(None)
    torch.testing.assert_close(backend.state.base_linear_velocity_w[:, 0], times(0.0, 0.04, 0.04))
    assert backend.terrain_index.tolist() == [1, 0, 0]
    assert backend.resets.tolist() == [2, 1, 1]


def test_randomized_values_are_recorded():
    backend = started()
    assert backend.randomized.friction.isnan().all()
    backend.randomize(Randomization(friction=times(0.3, 0.9)), torch.tensor([True, False, True]))
    assert backend.randomized.friction[[0, 2]].tolist() == [0.3, 0.9] and backend.randomized.friction[1].isnan()


def test_turn_and_rotate():
    quarter = turn(torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([[0.0, 0.0, math.pi]]), 0.5)
    torch.testing.assert_close(rotate(quarter, torch.tensor([[1.0, 0.0, 0.0]])), torch.tensor([[0.0, 1.0, 0.0]]))
    # a turn in the body frame: the pitch comes about the axis that the yaw has turned
    pitched = turn(quarter, torch.tensor([[0.0, math.pi, 0.0]]), 0.5)
    torch.testing.assert_close(rotate(pitched, torch.tensor([[1.0, 0.0, 0.0]])), torch.tensor([[0.0, 0.0, -1.0]]))


def test_other_numbers_of_feet_are_refused():
    biped = replace(ROBOT, foot_names=ROBOT.foot_names[:2])
    with pytest.raises(BackendError, match="4 feet, 'go2' has 2"):
        FakeBackend(replace(scene(), robot=biped))


def test_no_gpu_is_one_sentence():
    if torch.cuda.is_available():
        pytest.skip("a CUDA device is there")
    with pytest.raises(BackendError, match="torch finds none"):
        FakeBackend(scene(), device="cuda")
