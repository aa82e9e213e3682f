"""Checks of the motor law, its limits and randomized factors, and of control latency."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...robots.anatomy.body_plan import body_plan
from .bench import WORLDS, Bench, Worlds, expect, expect_close
from .check import check
from .kinematics import follow_reference, posed

FALLING = {
    "torque_limit": 20.0,
    "driving_torque_limit": 16.0,
    "full_torque_speed": 10.0,
    "no_load_speed": 20.0,
    "damping": 0.0,
}
"""Undamped motors with a torque that falls with the speed."""


def law(bench: Bench, target: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the motor torque of the default parameters before limits [N·m]."""
    parameters = bench.soft()
    return np.asarray(parameters.stiffness) * (target - position) - np.asarray(parameters.damping) * velocity


def one_step_torques(worlds: Worlds, bench: Bench, *, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the reported torque and the law's torque after one substep from random states, targets ``reach`` [rad] away."""
    random = np.random.default_rng(5)
    asked = posed(bench, worlds.count, seed=5)
    target = asked["joint_position"] + random.uniform(-reach, reach, asked["joint_position"].shape)
    worlds.reset(**asked)
    worlds.step(target, substeps=1)
    return worlds.read().joint_torque, law(bench, target, asked["joint_position"], asked["joint_velocity"])


@check("motors/law")
def motor_law(bench: Bench) -> str:
    """joint_torque = kp (target − q) − kd q̇ at the start of the substep; without limits there is no clipping."""
    with bench.worlds() as worlds:
        torque, expected = one_step_torques(worlds, bench, reach=4.0)
        error = expect_close("joint_torque [N·m]", torque, expected, 1e-3 + 1e-4 * np.abs(expected))
    return f"up to {np.abs(expected).max():.0f} N·m, largest error {error:.1e} N·m"


@check("motors/limits", "torque_limits")
def motor_limits(bench: Bench) -> str:
    """With torque limits the torque is clipped to each joint's own limit."""
    with bench.worlds(torque_limits=True) as worlds:
        torque, expected = one_step_torques(worlds, bench, reach=4.0)
        limit = np.asarray(bench.soft().torque_limit)
        clipped = np.clip(expected, -limit, limit)
        expect((clipped != expected).any(), "the check's own targets do not reach the limits")
        expect_close("joint_torque with limits [N·m]", torque, clipped, 1e-3 + 1e-4 * limit)
    return f"{int((clipped != expected).sum())} of {clipped.size} torques clipped"


@check("motors/strength", "motor_strength", "torque_limits")
def motor_strength(bench: Bench) -> str:
    """Motor strength multiplies the torque after its limit, so a strong motor exceeds it."""
    strength = np.random.default_rng(6).uniform(0.5, 1.5, (4, bench.robot.num_joints))
    with bench.worlds(torque_limits=True) as worlds:
        worlds.randomize(motor_strength=strength)
        torque, expected = one_step_torques(worlds, bench, reach=4.0)
        limit = np.asarray(bench.soft().torque_limit)
        wanted = np.clip(expected, -limit, limit) * strength
        expect_close("joint_torque with limits and strength [N·m]", torque, wanted, 1e-3 + 1e-4 * limit)
    return ""


@check("motors/speed_limit", "torque_limits", "torque_speed_limit", "motor_strength")
def motor_speed_limit(bench: Bench) -> str:
    """With limits by speed the driving torque falls linearly to zero at the no-load speed; braking torque stays whole."""
    # 15 rad/s lies half-way between full torque (16 N·m, up to 10 rad/s) and none (20 rad/s)
    parameters = bench.soft(**FALLING)
    speed = np.array([0.0, 5.0, 10.0, 12.5, 15.0, 17.5, 20.0, 25.0, -5.0, -15.0, -25.0, -2.5])
    forward = np.array([16.0, 16.0, 16.0, 12.0, 8.0, 4.0, 0.0, 0.0, 20.0, 20.0, 20.0, 20.0])
    backward = -np.array([16.0, 20.0, 20.0, 20.0, 20.0, 20.0, 20.0, 20.0, 16.0, 8.0, 0.0, 16.0])
    joints = np.arange(bench.robot.num_joints) % len(speed)
    # far beyond the limits in both directions, with half the strength, and 3 N·m, beyond the fastest joints alone
    reach = np.array([100.0, -100.0, 100.0, 3.0 / parameters.stiffness[0]])[:, None]
    wanted = np.stack([forward, backward, 0.5 * forward, np.minimum(forward, 3.0)])[:, joints]
    strength = np.ones_like(wanted)
    strength[2] = 0.5
    with bench.worlds(parameters, torque_limits=True, torque_speed_limit=True) as worlds:
        worlds.randomize(motor_strength=strength)
        worlds.reset(joint_position=worlds.default_pose, joint_velocity=speed[joints])
        worlds.step(worlds.default_pose + reach, substeps=1)
        error = expect_close("joint_torque with limits by speed [N·m]", worlds.read().joint_torque, wanted, 4e-3)
        # the speed of each substep counts
        worlds.reset(joint_velocity=np.full_like(wanted, 12.0))
        worlds.step(worlds.default_pose + 100.0, sample_at=[9] * worlds.count)
        before, after = worlds.read_sample(), worlds.read()
        share = np.clip(2.0 - before.joint_velocity / 10.0, 0.0, 1.0)
        expect((share < 0.79).any(), "the check's own joints do not become faster")
        wanted = np.where(before.joint_velocity >= 0.0, 16.0 * share, 20.0) * strength
        expect_close("joint_torque of the last substep [N·m]", after.joint_torque, wanted, 4e-3)
    return f"largest error {error:.1e} N·m"


@check("motors/speed", "torque_limits", "torque_speed_limit", "motor_speed")
def motor_speed(bench: Bench) -> str:
    """The motor speed scales the speeds at which the driving torque falls and ends; torque at rest and in braking stays."""
    parameters = bench.soft(**FALLING)
    factor = np.array([0.5, 1.0, 1.5, 2.0])[:, None].repeat(bench.robot.num_joints, 1)
    # 15 rad/s is beyond 10, half-way from 10 to 20, the end of full torque of 15 to 30, and below it for 20 to 40
    driving, still = (np.array(torques)[:, None] for torques in ([0.0, 8.0, 16.0, 16.0], [16.0] * 4))
    with bench.worlds(parameters, torque_limits=True, torque_speed_limit=True) as worlds:
        worlds.randomize(motor_speed=factor)
        braking = np.full((4, 1), -20.0)
        for speed, reach, wanted in ((15.0, 100.0, driving), (15.0, -100.0, braking), (0.0, 100.0, still)):
            worlds.reset(joint_position=worlds.default_pose, joint_velocity=np.full_like(factor, speed))
            worlds.step(worlds.default_pose + reach, substeps=1)
            torque = worlds.read().joint_torque
            expect_close("joint_torque with scaled speeds [N·m]", torque, np.broadcast_to(wanted, factor.shape), 4e-3)
    return ""


@check("motors/gains", "gains")
def motor_gains(bench: Bench) -> str:
    """Stiffness and damping have a factor for each world and joint."""
    random = np.random.default_rng(7)
    stiffness, damping = random.uniform(0.5, 1.5, (2, 4, bench.robot.num_joints))
    with bench.worlds() as worlds:
        worlds.randomize(stiffness_scale=stiffness)
        worlds.randomize(damping_scale=damping)
        asked = posed(bench, worlds.count, seed=8)
        target = asked["joint_position"] + random.uniform(-0.5, 0.5, stiffness.shape)
        worlds.reset(**asked)
        worlds.step(target, substeps=1)
        parameters = bench.soft()
        wanted = stiffness * np.asarray(parameters.stiffness) * (target - asked["joint_position"])
        wanted -= damping * np.asarray(parameters.damping) * asked["joint_velocity"]
        expect_close("joint_torque with scaled gains [N·m]", worlds.read().joint_torque, wanted, 2e-3)
    return ""


@check("motors/offset", "motor_offset")
def motor_offset(bench: Bench) -> str:
    """The motor offset is added to the position error; a limp motor ignores it."""
    offset = np.random.default_rng(9).uniform(-0.2, 0.2, (4, bench.robot.num_joints))
    with bench.worlds() as worlds:
        worlds.randomize(motor_offset=offset)
        torque, expected = one_step_torques(worlds, bench, reach=0.5)
        wanted = expected + np.asarray(bench.soft().stiffness) * offset
        expect_close("joint_torque with offset [N·m]", torque, wanted, 2e-3)
        worlds.reset()
        worlds.step()
        expect_close("joint_torque of limp motors with offset [N·m]", worlds.read().joint_torque, 0.0, 1e-6)
    return ""


@check("motors/torque", "torque_limits", "motor_strength")
def torque_motor(bench: Bench) -> str:
    """A motor that takes torques gives what it is told, limited and then scaled; an engine without such motors is skipped."""
    parameters = replace(bench.soft(torque_limit=16.0), motor="torque", measured="conformance")
    strength = np.array([1.0, 0.5, 1.2, 1.0])[:, None].repeat(bench.robot.num_joints, 1)
    with bench.worlds(parameters, torque_limits=True) as worlds:
        if not worlds.backend.torque_motors:
            return "no such motors"
        worlds.randomize(motor_strength=strength)
        asked = posed(bench, worlds.count, seed=11)
        told = np.array([3.0, -7.0, 10.0, 40.0])[:, None].repeat(bench.robot.num_joints, 1)
        worlds.reset(**asked)
        worlds.step(told, substeps=1)
        wanted = told.clip(-16.0, 16.0) * strength
        expect_close("joint_torque of torque motors [N·m]", worlds.read().joint_torque, wanted, 2e-3)
    return ""


@check("motors/velocity", "torque_limits", "motor_strength", "gains", "motor_offset", "latency")
def velocity_targets(bench: Bench) -> str:
    """Joints with targets of velocity follow kd (target − q̇) with factors, limits, strength and latency; others keep their law."""
    calves = tuple(leg[-1] for leg in body_plan(bench.robot).legs)
    names = tuple(bench.robot.joint_names[j] for j in calves)
    wheeled = replace(bench, robot=replace(bench.robot, velocity_joints=names))
    random, shape = np.random.default_rng(13), (WORLDS, bench.robot.num_joints)
    stiffness, damping, strength = random.uniform(0.5, 1.5, (3, *shape))
    with bench.worlds() as plain:
        if not plain.backend.velocity_targets:
            return "no such targets"
    with wheeled.worlds(bench.soft(torque_limit=16.0, damping=1.0), torque_limits=True) as worlds:
        worlds.randomize(
            stiffness_scale=stiffness, damping_scale=damping, motor_strength=strength, motor_offset=np.full(shape, 0.05)
        )
        asked = posed(bench, worlds.count, seed=13)
        first, then = asked["joint_position"] + random.uniform(-0.3, 0.3, (2, *shape))
        first[:, calves], then[:, calves] = random.uniform(-30.0, 30.0, (2, WORLDS, len(calves)))
        worlds.reset(**asked, held_target=first)
        for target, late in ((first, 1), (then, 0)):
            before = worlds.read()
            worlds.step(then, delay=[late] * worlds.count, substeps=1)
            kp = stiffness * np.asarray(bench.soft().stiffness)
            wanted = kp * (target + 0.05 - before.joint_position) - damping * before.joint_velocity
            wanted[:, calves] = (damping * (target - before.joint_velocity))[:, calves]
            wanted = wanted.clip(-16.0, 16.0) * strength
            expect(
                (np.abs(wanted[:, calves]) == 16.0 * strength[:, calves]).any(), "the check's targets reach no limit"
            )
            expect_close("joint_torque [N·m]", worlds.read().joint_torque, wanted, 2e-3 + 1e-3 * np.abs(wanted))
    with wheeled.worlds(bench.soft(torque_limit=1000.0)) as worlds:
        asked = {k: v for k, v in posed(bench, WORLDS, seed=14).items() if k in ("base_position", "base_quaternion")}
        target = worlds.default_pose.copy()
        target[:, calves] = np.array([0.5, -0.5, 1.0, -1.0])[:, None]
        worlds.reset(**asked)
        worlds.step(target)
        worlds.run(0.08)
        error = follow_reference(
            wheeled, worlds, asked, worlds.read(), seconds=0.1, target=target, angle=0.01, position=0.003
        )
    return f"0.1 s with targets of up to 1 rad/s: {error}"


@check("motors/limp_and_held")
def limp_and_held(bench: Bench) -> str:
    """Motors are limp from a reset to the first target, or hold the reset's target; step(None) keeps a target."""
    with bench.worlds() as worlds:
        asked = posed(bench, worlds.count, seed=10)
        worlds.reset(**asked)
        for _ in range(2):
            worlds.step()
            expect_close("joint_torque of limp motors [N·m]", worlds.read().joint_torque, 0.0, 1e-5)
        target = worlds.default_pose + 0.1
        worlds.reset(**asked, held_target=target)
        worlds.step(substeps=1)
        expected = law(bench, target, asked["joint_position"], asked["joint_velocity"])
        expect_close("joint_torque with a held target [N·m]", worlds.read().joint_torque, expected, 2e-3)
        for given, what in ((worlds.default_pose, "of a new target"), (None, "after step(None)")):
            before = worlds.read()
            worlds.step(given, substeps=1)
            expected = law(bench, worlds.default_pose, before.joint_position, before.joint_velocity)
            expect_close(f"joint_torque {what} [N·m]", worlds.read().joint_torque, expected, 2e-3)
        worlds.reset(**asked)
        worlds.step()
        expect_close("joint_torque after a reset without held target [N·m]", worlds.read().joint_torque, 0.0, 1e-5)
    return ""


@check("motors/step_response")
def step_response(bench: Bench) -> str:
    """Joints in the air follow a step of their targets as in a plain reference loop with the explicit motor law."""
    with bench.worlds() as worlds:
        asked = posed(bench, worlds.count, seed=11)
        asked = {name: asked[name] for name in ("base_position", "base_quaternion")}
        target = worlds.default_pose.copy()
        for row in range(worlds.count):
            target[row, row % 3 :: 3] += 0.3 if row < 3 else -0.2  # hips, thighs, calves, hips
        worlds.reset(**asked)
        worlds.step(target)
        worlds.run(0.18)
        bounds: dict[str, Any] = {"angle": 0.01, "position": 0.003}
        error = follow_reference(bench, worlds, asked, worlds.read(), seconds=0.2, target=target, **bounds)
    return f"0.2 s after a step of 0.3 rad: {error}"


@check("motors/joint_friction", "joint_friction")
def joint_friction(bench: Bench) -> str:
    """Dry friction, viscous damping and rotor inertia of the joints act as in the reference."""
    with bench.worlds(bench.soft(friction_loss=0.2, joint_damping=0.1, armature=0.02)) as worlds:
        asked = posed(bench, worlds.count, seed=12)
        asked["joint_velocity"] = 3.0 * np.sign(asked["joint_velocity"])
        worlds.reset(**asked)
        worlds.run(0.04)
        bound = bench.bound("joint_friction", exact=0.01, approximate=0.05)
        error = follow_reference(bench, worlds, asked, worlds.read(), seconds=0.04, angle=bound, position=0.005)
    with bench.worlds(bench.soft(joint_damping=0.1, armature=0.02)) as worlds:
        worlds.reset(**asked)
        worlds.run(0.04)
        try:
            follow_reference(bench, worlds, asked, worlds.read(), seconds=0.04, angle=bound, position=0.005)
        except AssertionError as wrong:
            raise AssertionError(f"without dry friction: {wrong}") from wrong
    return f"0.04 s from 3 rad/s: {error}"


@check("motors/latency", "latency")
def latency(bench: Bench) -> str:
    """A delay of k lets the previous target act for exactly k substeps, with another k in each world."""
    delay = np.array([0, 3, 9, 10])
    with bench.worlds() as worlds, bench.worlds() as single:
        first, second = worlds.default_pose + 0.2, worlds.default_pose - 0.3
        for each in (worlds, single):
            each.reset(held_target=each.default_pose)
        previous = worlds.default_pose
        for target in (first, second):
            worlds.step(target, delay=delay)
            for substep in range(10):
                now = np.where((delay <= substep)[:, None], target, previous)
                single.step(now, substeps=1)
            previous = target
            tolerance = worlds.precision(1e-9, 2e-4)
            state, expected = worlds.read(), single.read()
            position = expected.joint_position
            error = expect_close("joint_position with latency [rad]", state.joint_position, position, tolerance)
            expect_close("joint_torque with latency [N·m]", state.joint_torque, expected.joint_torque, 200 * tolerance)
        spread = np.abs(state.joint_position[1:] - state.joint_position[:-1]).max(axis=1).min()
        expect(spread > 10 * tolerance, f"delays 0, 3, 9 and 10 make no difference ({spread:.1e} rad)")
        # a target that came too late to act in its own period acts from the next one on
        worlds.step()
        single.step(np.where((delay == 10)[:, None], second, previous))
        position = single.read().joint_position
        expect_close("joint_position in the next period [rad]", worlds.read().joint_position, position, tolerance)
        worlds.reset()
        worlds.step(first, delay=[0, 10, 10, 10])
        torque = worlds.read().joint_torque
        expect_close("joint_torque of a limp robot whose first target is late [N·m]", torque[1:], 0.0, 1e-5)
        expect(np.abs(torque[0]).max() > 0.1, "the first target of a limp robot without delay has no effect")
    return f"equal to switching targets between single substeps to {error:.1e} rad"
