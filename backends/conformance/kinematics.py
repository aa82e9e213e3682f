"""Checks of state, frames and free motion, the base of all other checks."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import torch

from ..base import PhysicsState
from .bench import Bench, ConformanceError, Worlds, expect, expect_close
from .check import check
from .reference import GRAVITY, Reference, angle_between, axis_angle, composed, rotated

FORCE_FIELDS = (
    "joint_torque", "foot_contact_force_w", "foot_normal_force", "foot_tangential_force", "body_contact_force_w",
    "trunk_contact_force_w", "ground_force_w", "ground_moment_w", "contact_center_w", "contact_count",
)  # fmt: skip
FINER = 16
"""Steps of the finer reference in one of the engine's."""


def posed(bench: Bench, count: int, *, seed: int = 1) -> dict[str, Any]:
    """Return a reset to a different place, turn about all axes, pose and motion in every world."""
    random = np.random.default_rng(seed)
    low, high = Reference(bench.robot, bench.soft()).joint_range.T
    pose = np.asarray(bench.robot.default_joint_position)
    joints = np.clip(pose + random.uniform(-0.3, 0.3, (count, len(pose))), low + 0.02, high - 0.02)
    return {
        "base_position": np.array([0.0, 0.0, 2.0]) + random.uniform(-0.5, 0.5, (count, 3)),
        "base_quaternion": np.array([axis_angle(random.normal(size=3), a) for a in random.uniform(0.5, 2.5, count)]),
        "joint_position": joints,
        "base_linear_velocity": random.uniform(-1.0, 1.0, (count, 3)),
        "base_angular_velocity": random.uniform(-1.0, 1.0, (count, 3)),
        "joint_velocity": random.uniform(-1.0, 1.0, joints.shape),
    }


@check("state/fields")
def state_fields(bench: Bench) -> str:
    """Every field has the shape, type and device of the contract; after a reset time and forces are zero."""
    with bench.worlds() as worlds:
        worlds.reset()
        backend, robot = worlds.backend, bench.robot
        n, j, f, b = worlds.count, robot.num_joints, len(robot.foot_names), len(robot.collision_bodies)
        shapes: dict[str, tuple[int, ...]] = {"base_quaternion_w": (n, 4), "body_contact_force_w": (n, b, 3)}
        shapes |= dict.fromkeys(("foot_position_w", "foot_velocity_w", "foot_contact_force_w"), (n, f, 3))
        shapes |= dict.fromkeys(("foot_normal_force", "foot_tangential_force"), (n, f))
        types = {"tilt_substep": torch.int64, "penetration_substep": torch.int64}
        types |= {"diverged": torch.bool, "overflowed": torch.bool}
        expect(backend.dtype in (torch.float32, torch.float64), f"dtype is {backend.dtype}, not a floating-point type")
        for field in fields(PhysicsState):
            name, value = field.name, getattr(backend.state, field.name)
            default = (n, j) if name.startswith("joint_") else (n, 3) if name.endswith(("_w", "_b")) else (n,)
            shape = shapes.get(name, default)
            expect(tuple(value.shape) == shape, f"state.{name} has shape {tuple(value.shape)}, must be {shape}")
            kind = types.get(name, backend.dtype)
            whole = name == "contact_count" and not value.dtype.is_floating_point
            expect(whole or value.dtype == kind, f"state.{name} is {value.dtype}, must be {kind}")
            expect(value.device.type == backend.device.type, f"state.{name} is on {value.device}, not {backend.device}")
        worlds.reset(base_position=(0.0, 0.0, 0.0))  # in the floor, so that the next reset has forces to clear
        worlds.step(worlds.default_pose + 0.1, substeps=1)
        worlds.reset()
        state = worlds.read()
        expect_close("time after a reset [s]", state.time, 0.0, 0.0)
        for name in FORCE_FIELDS:
            expect_close(f"{name} after a reset", getattr(state, name), 0.0, 0.0)
        expect(not state.diverged.any() and not state.overflowed.any(), "a fresh world is diverged or overflowed")
        kept = backend.state.clone()
        worlds.reset(base_position=(2.0, 2.0, 2.0))
        expect_close("base height in a clone of an earlier state [m]", kept.base_position_w[:, 2].cpu(), 1.0, 1e-6)
        expect_close("base height of the present state [m]", worlds.read().base_position_w[:, 2], 2.0, 1e-6)
    return f"{str(backend.dtype).removeprefix('torch.')} on {backend.device}"


@check("state/time")
def state_time(bench: Bench) -> str:
    """Time counts the physics steps since the last reset."""
    with bench.worlds(timestep=0.004, substeps=5) as worlds:
        worlds.reset()
        worlds.step()
        worlds.step(substeps=2)
        expect_close("time after 5 + 2 steps of 4 ms [s]", worlds.read().time, 0.028, 1e-6)
        worlds.reset([True, False] * (worlds.count // 2))
        worlds.step(substeps=1)
        times = [0.004, 0.032] * (worlds.count // 2)
        expect_close("time of reset and other worlds [s]", worlds.read().time, times, 1e-6)
    return ""


@check("reset/state")
def reset_state(bench: Bench) -> str:
    """A reset gives every field its requested value, in the contract's frames and orders."""
    with bench.worlds() as worlds:
        asked = posed(bench, worlds.count)
        worlds.reset(**asked)
        state, tolerance = worlds.read(), worlds.precision(1e-9, 1e-5)
        turned = angle_between(state.base_quaternion_w, asked["base_quaternion"])
        worst = expect_close("angle of base_quaternion_w (wxyz) from the request [rad]", turned, 0.0, tolerance)
        frames = {"base_position": "_w", "base_linear_velocity": "_w", "base_angular_velocity": "_b"}
        for name in (*frames, "joint_position", "joint_velocity"):
            field = name + frames.get(name, "")
            worst = max(worst, expect_close(f"{field} after a reset", getattr(state, field), asked[name], tolerance))
        worlds.reset()
        state = worlds.read()
        expect_close("default joint position [rad]", state.joint_position, worlds.default_pose, tolerance)
        for field in ("base_linear_velocity_w", "base_angular_velocity_b", "joint_velocity"):
            expect_close(f"{field} after a reset without velocities", getattr(state, field), 0.0, tolerance)
    return f"largest error {worst:.1e}"


@check("kinematics/feet")
def feet(bench: Bench) -> str:
    """Foot positions and velocities follow from base and joints, turned bases included."""
    with bench.worlds() as worlds:
        asked = posed(bench, worlds.count, seed=2)
        worlds.reset(**asked)
        reference = Reference(bench.robot, bench.soft())
        positions, velocities = [], []
        for row in range(worlds.count):
            reference.place(**{name: value[row] for name, value in asked.items()})
            positions.append(reference.foot_position)
            velocities.append(reference.foot_velocity)
        state, tolerance = worlds.read(), worlds.precision(1e-7, 2e-5)
        error = expect_close("foot_position_w [m]", state.foot_position_w, positions, tolerance)
        expect_close("foot_velocity_w [m/s]", state.foot_velocity_w, velocities, 5 * tolerance)
    return f"largest position error {error:.1e} m"


@check("kinematics/frames")
def frames(bench: Bench) -> str:
    """Poses move as the velocities say: linear in the world frame at the base origin, angular in the body frame."""
    with bench.worlds() as worlds:
        asked = posed(bench, worlds.count, seed=3)
        asked["base_angular_velocity"] *= 3.0
        asked["joint_velocity"] *= 0.0
        worlds.reset(**asked)
        h = worlds.backend.scene.physics.timestep
        before = worlds.read()
        for _ in range(3):
            worlds.step(substeps=1)
            after = worlds.read()
            moved = (after.base_position_w - before.base_position_w) / h
            midway = 0.5 * (before.base_linear_velocity_w + after.base_linear_velocity_w)
            # Explicit, midpoint and semi-implicit integrators all move with a velocity between the old and the new one.
            slack = 0.5 * np.abs(after.base_linear_velocity_w - before.base_linear_velocity_w)
            linear = "change of base_position_w per second against base_linear_velocity_w [m/s]"
            expect_close(linear, moved, midway, slack + 5e-3)
            for row in range(worlds.count):
                spin = 0.5 * (before.base_angular_velocity_b[row] + after.base_angular_velocity_b[row])
                expected = composed(before.base_quaternion_w[row], axis_angle(spin, h * float(np.linalg.norm(spin))))
                off = float(angle_between(after.base_quaternion_w[row], expected)) / h
                change = np.linalg.norm(after.base_angular_velocity_b[row] - before.base_angular_velocity_b[row])
                angular = "change of base_quaternion_w per second against base_angular_velocity_b [rad/s]"
                expect_close(angular, off, 0.0, change + 5e-3)
            before = after
    return ""


@check("kinematics/free_fall")
def free_fall(bench: Bench) -> str:
    """A limp robot falls with g = 9.81 m/s² and does not turn."""
    with bench.worlds() as worlds:
        start, thrown = np.array([0.3, -0.2, 3.0]), np.array([0.5, 0.25, 1.0])
        yawed = np.array([axis_angle((0.0, 0.3, 1.0), a) for a in np.linspace(0.0, 3.0, worlds.count)])
        worlds.reset(base_position=start, base_quaternion=yawed, base_linear_velocity=thrown)
        h, count = worlds.backend.scene.physics.timestep, 100
        worlds.run(h * count)
        state, t = worlds.read(), h * count
        velocity = thrown - [0.0, 0.0, GRAVITY * t]
        expect_close("velocity after 0.2 s of free fall [m/s]", state.base_linear_velocity_w, velocity, 2e-3)
        continuous = start + thrown * t - [0.0, 0.0, 0.5 * GRAVITY * t * t]
        euler = continuous - [0.0, 0.0, 0.5 * GRAVITY * t * h]
        middle, slack = 0.5 * (continuous + euler), np.abs(continuous - euler) / 2 + 5e-4
        expect_close("position after 0.2 s of free fall [m]", state.base_position_w, middle, slack)
        expect_close("turn during free fall [rad]", angle_between(state.base_quaternion_w, yawed), 0.0, 2e-3)
        to_euler = float(np.abs(state.base_position_w - euler).max())
        to_exact = float(np.abs(state.base_position_w - continuous).max())
    kind = "semi-implicit Euler" if to_euler < to_exact else "the continuous law"
    return f"follows {kind} to {min(to_euler, to_exact):.1e} m"


@check("kinematics/tumble")
def tumble(bench: Bench) -> str:
    """A limp tumbling robot with moving joints follows the reference, by the right masses, inertias and joint axes."""
    with bench.worlds() as worlds:
        asked = posed(bench, worlds.count, seed=4)
        worlds.reset(**asked)
        worlds.run(0.1)
        error = follow_reference(bench, worlds, asked, worlds.read(), seconds=0.1, angle=0.01, position=0.003)
    return f"after 0.1 s: {error}"


def follow_reference(
    bench: Bench,
    worlds: Worlds,
    asked: dict[str, Any],
    state: Any,
    *,
    seconds: float,
    angle: float,
    position: float,
    target: np.ndarray | None = None,
    changes: list[dict[str, Any]] | None = None,
    force_w: np.ndarray | None = None,
) -> str:
    """Compare a state with one reference run per world.

    The reference takes steps as long as the engine's. An engine that divides its steps comes nearer to the continuous motion than
    that: it may follow the reference with the same motor torques over steps ``FINER`` times shorter instead.

    Args:
        asked: the arguments of the reset at the start.
        state: the engine's state at the end.
        seconds: duration in between [s].
        angle: tolerance of base orientation and joints [rad].
        position: tolerance of the base position [m].
        target: joint targets of every world, (N, J); None for limp motors.
        changes: arguments of ``Reference.change`` for every world.
        force_w: force on the base of every world [N], (N, 3).
    """

    def follow(finer: int) -> str:
        physics = worlds.backend.scene.physics
        quaternions, positions, joints = [], [], []
        for row, change in enumerate(changes or [{}] * worlds.count):
            reference = Reference(bench.robot, worlds.backend.scene.parameters, timestep=physics.timestep / finer)
            reference.change(**change)
            if force_w is not None:
                reference.force_w = force_w[row]
            reference.place(**{name: value[row] for name, value in asked.items()})
            steps = round(seconds / physics.timestep)
            reference.step(None if target is None else target[row], substeps=steps, finer=finer)
            quaternions.append(reference.base_quaternion)
            positions.append(reference.base_position)
            joints.append(reference.joint_position)
        turned = angle_between(state.base_quaternion_w, quaternions)
        turn = expect_close("base orientation against the reference [rad]", turned, 0.0, angle)
        joint = expect_close("joint_position against the reference [rad]", state.joint_position, joints, angle)
        place = expect_close("base_position_w against the reference [m]", state.base_position_w, positions, position)
        return f"joints {joint:.1e} rad, base {turn:.1e} rad and {place:.1e} m from the reference"

    try:
        return follow(1)
    except ConformanceError as coarse:
        try:
            return f"{follow(FINER)} in finer steps"
        except ConformanceError:
            raise coarse from None


def base_up(quaternion: np.ndarray) -> np.ndarray:
    """Return the base's z axis in the world frame, (N, 3), of quaternions (N, 4)."""
    return np.array([rotated(q, (0.0, 0.0, 1.0)) for q in quaternion])
