"""The motor law and its limits by speed, against hand calculation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends import BackendError, PhysicsOptions, Randomization, ResetState, Scene, make_backend
from gaitgauge.backends.motor_law import MotorLimits, motor_torque
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Terrain

GO2 = load_robot("go2")
BOTH = {"torque_limits": True, "torque_speed_limit": True}


def scene(worlds=1, parameters=GO2.parameters["gauge"], **physics):
    return Scene(
        robot=GO2,
        parameters=parameters,
        terrains=(Terrain(name="flat", family="flat"),),
        terrain_index=(0,) * worlds,
        physics=PhysicsOptions(**physics),
    )


def test_the_go2_drives_with_less_torque_the_faster_it_turns():
    lower, upper = MotorLimits.of(scene(**BOTH)).bounds(np.full(12, 10.0))
    # hip and thigh below the 13.5 rad/s of full torque; calf 38.72 · (15.65 − 10) / (15.65 − 7.04) = 25.41 N·m
    np.testing.assert_allclose(upper, [20.2, 20.2, 25.41] * 4, atol=5e-3)
    np.testing.assert_allclose(lower, [-23.7, -23.7, -45.43] * 4)
    lower, upper = MotorLimits.of(scene(**BOTH)).bounds(np.full(12, -25.0))
    # 20.2 · (30 − 25) / (30 − 13.5) = 6.12 N·m; the calf is beyond its 15.65 rad/s
    np.testing.assert_allclose(lower, [-6.12, -6.12, 0.0] * 4, atol=5e-3)
    np.testing.assert_allclose(upper, [23.7, 23.7, 45.43] * 4)


@pytest.mark.parametrize("limited", [True, False])
def test_without_the_option_the_speed_does_not_matter(limited):
    limits = MotorLimits.of(scene(torque_limits=limited))
    limit = np.array([23.7, 23.7, 45.43] * 4) if limited else np.full(12, np.inf)
    for speed in (0.0, 100.0):
        np.testing.assert_array_equal(limits.bounds(np.full(12, speed)), [-limit, limit])


def test_the_law_is_the_same_in_torch_and_hides_no_invalid_number():
    limits = MotorLimits.of(scene(**BOTH))
    random = np.random.default_rng(0)
    error, velocity = random.uniform(-3, 3, (5, 12)), random.uniform(-30, 30, (5, 12))
    error[0, 0], velocity[1, 1] = np.nan, np.nan
    constants = {"stiffness": 20.0, "damping": 0.5, "strength": 0.8}
    torque = motor_torque(error, velocity, **constants, limits=limits)
    tensors = limits.to(device=torch.device("cpu"), dtype=torch.float64)
    same = motor_torque(torch.tensor(error), torch.tensor(velocity), **constants, limits=tensors)
    np.testing.assert_array_equal(torque, same.numpy())
    assert np.argwhere(np.isnan(torque)).tolist() == [[0, 0], [1, 1]]


def test_a_motor_s_speed_stretches_the_limit_by_speed():
    limits = MotorLimits.of(scene(**BOTH))
    constants = {"stiffness": 1000.0, "damping": 0.0, "strength": 0.8}
    factor = np.random.default_rng(0).uniform(0.5, 2.5, (4, 12))
    for velocity in (np.full((4, 12), 25.0), np.full((4, 12), -25.0), np.zeros((4, 12))):
        lower, upper = limits.bounds(velocity / factor)
        for error, bound in ((1.0, upper), (-1.0, lower)):
            torque = motor_torque(np.full((4, 12), error), velocity, **constants, speed=factor, limits=limits)
            np.testing.assert_array_equal(torque, 0.8 * bound)
            same = motor_torque(
                torch.full((4, 12), error, dtype=torch.float64),
                torch.tensor(velocity),
                **constants,
                speed=torch.tensor(factor),
                limits=limits.to(device=torch.device("cpu"), dtype=torch.float64),
            )
            np.testing.assert_array_equal(torque, same.numpy())
    # 25 rad/s at twice the speed is 12.5 rad/s: below 13.5; calf 38.72 · (31.3 − 25) / (31.3 − 14.08) = 14.17 N·m
    twice = motor_torque(np.ones(12), np.full(12, 25.0), **{**constants, "strength": 1.0}, speed=2.0, limits=limits)
    np.testing.assert_allclose(twice, [20.2, 20.2, 14.17] * 4, atol=5e-3)


@pytest.mark.parametrize("engine", ["mujoco", "fake"])
def test_a_robot_whose_motors_are_unknown_is_refused_in_a_sentence(engine):
    unknown = replace(GO2.parameters["gauge"], full_torque_speed=None, no_load_speed=None)
    with pytest.raises(BackendError, match=r"'go2' does not say how fast its motors turn; add full_torque_speed"):
        make_backend(engine, scene(parameters=unknown, **BOTH))
    with pytest.raises(BackendError, match=r"torque_speed_limit is on without torque_limits"):
        make_backend(engine, scene(torque_limits=False, torque_speed_limit=True))


def walk(physics, target):
    backend = make_backend("mujoco", scene(worlds=2, **physics))
    pose = torch.tensor(GO2.default_joint_position, dtype=torch.float64)
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(2, 1)
    backend.reset(ResetState(base_position=torch.tensor([0.0, 0.0, 1.0]).repeat(2, 1), base_quaternion=upright))
    speeds = []
    for step in range(5):
        backend.step((pose + target * (-1) ** step).repeat(2, 1), delay=torch.tensor([0, 4]))
        speeds.append(backend.state.joint_velocity.abs().max(dim=0).values)
    final = backend.state.joint_position.clone()
    backend.close()
    return final, torch.stack(speeds).amax(dim=0)


def test_mujoco_moves_slow_joints_alike_and_holds_fast_ones_back():
    slow, speed = walk(BOTH, 0.1)
    assert speed.max() < 7.0
    assert torch.equal(slow, walk({"torque_limits": True}, 0.1)[0])
    _, free = walk({"torque_limits": True}, 1.5)
    _, limited = walk(BOTH, 1.5)
    calves = slice(2, 12, 3)
    assert free[calves].max() > 17.0
    assert limited[calves].max() < 15.65 + 0.5  # gravity and the thighs may push a little


def test_no_gain_and_no_offset_acts_on_a_torque():
    direct = replace(GO2.parameters["gauge"], motor="torque")
    backend = make_backend("mujoco", scene(parameters=direct), device="cpu")
    still = torch.zeros(1, 12, dtype=torch.float64)
    pose = torch.tensor([GO2.default_joint_position], dtype=torch.float64)
    backend.randomize(Randomization(motor_offset=still + 0.5, stiffness_scale=still + 1.3, motor_strength=still + 0.5))
    backend.reset(
        ResetState(
            base_position=torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64),
            base_quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
            joint_position=pose,
        )
    )
    backend.step(still + 2.0)
    np.testing.assert_allclose(backend.state.joint_torque.numpy(), 1.0)  # half as strong
