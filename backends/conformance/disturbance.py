"""Checks of pushes and external forces."""

from __future__ import annotations

import numpy as np

from .bench import Bench, expect, expect_close
from .check import check
from .kinematics import follow_reference, posed
from .reference import GRAVITY, Reference


@check("disturbance/push", "push")
def push(bench: Bench) -> str:
    """A push sets base velocities of the masked worlds, world frame and body frame; NaN keeps an entry."""
    with bench.worlds() as worlds:
        asked = posed(bench, worlds.count, seed=31)
        worlds.reset(**asked)
        worlds.step()
        before = worlds.read()
        linear = np.tile([0.7, np.nan, -0.4], (worlds.count, 1))
        angular = np.tile([np.nan, 0.9, np.nan], (worlds.count, 1))
        mask = np.array([True, False, True, True])
        worlds.push(mask, linear_velocity_w=linear, angular_velocity_b=angular)
        after = worlds.read()
        tolerance = worlds.precision(1e-9, 1e-5)
        for name, asked_for in (("base_linear_velocity_w", linear), ("base_angular_velocity_b", angular)):
            wanted = np.where(np.isnan(asked_for) | ~mask[:, None], getattr(before, name), asked_for)
            expect_close(f"{name} after a push", getattr(after, name), wanted, tolerance)
        for name in ("base_position_w", "base_quaternion_w", "joint_position", "joint_velocity"):
            expect_close(f"{name} after a push", getattr(after, name), getattr(before, name), tolerance)
        # the push is part of the state: the next substep moves with it
        worlds.step(substeps=1)
        moved = worlds.read().base_position_w - after.base_position_w
        h = worlds.backend.scene.physics.timestep
        expect_close("movement in the substep after a push [m]", moved, h * after.base_linear_velocity_w, 3e-4)
        worlds.push(linear_velocity_w=np.full((worlds.count, 3), 0.25))
        expect_close("base_linear_velocity_w [m/s]", worlds.read().base_linear_velocity_w, 0.25, tolerance)
    return ""


@check("disturbance/force", "external_force")
def force(bench: Bench) -> str:
    """An external force in the world frame acts on the base's centre of mass until it is changed."""
    with bench.worlds() as worlds:
        asked = {name: v for name, v in posed(bench, worlds.count, seed=32).items() if name.startswith("base_")}
        force_w = np.array([[60.0, 0.0, 0.0], [0.0, -80.0, 0.0], [20.0, 30.0, 90.0], [0.0, 0.0, 0.0]])
        worlds.reset(**asked)
        worlds.apply_force(force_w)
        worlds.run(0.1)
        state = worlds.read()
        error = follow_reference(bench, worlds, asked, state, seconds=0.1, angle=0.01, position=0.003, force_w=force_w)
        reference = Reference(bench.robot, bench.soft())
        fallen, t, h = [], 0.1, worlds.backend.scene.physics.timestep
        for row in range(worlds.count):
            reference.place(**{name: value[row] for name, value in asked.items()})
            start, drift = reference.center_of_mass, reference.center_of_mass_velocity
            reference.place(state.base_position_w[row], state.base_quaternion_w[row], state.joint_position[row])
            fallen.append(reference.center_of_mass - start - drift * t)
        acceleration = force_w / reference.mass - [0.0, 0.0, GRAVITY]
        path, slack = 0.5 * acceleration * t * (t + 0.5 * h), np.abs(acceleration) * t * h + 1e-3
        expect_close("path of the centre of mass by F = m a [m]", fallen, path, slack)
        worlds.apply_force(np.zeros((worlds.count, 3)))
        before = worlds.read()
        worlds.step(substeps=1)
        gained = (worlds.read().base_linear_velocity_w - before.base_linear_velocity_w) / h
        expect(np.abs(gained) < 25.0, f"a force set to zero still accelerates with {np.abs(gained).max():.1f} m/s²")
    return error


@check("disturbance/force_reset", "external_force")
def force_reset(bench: Bench) -> str:
    """A reset clears the external force of its worlds only."""
    with bench.worlds() as worlds:
        worlds.reset()
        worlds.apply_force(np.tile([150.0, 0.0, 0.0], (worlds.count, 1)))
        worlds.step()
        cleared = np.array([True, False, False, True])
        worlds.reset(cleared)
        before = worlds.read().base_linear_velocity_w[:, 0]
        worlds.step()
        gained = worlds.read().base_linear_velocity_w[:, 0] - before
        expect_close("forward speed gained without force [m/s]", gained[cleared], 0.0, 1e-3)
        expect(gained[~cleared] > 0.05, f"the force is gone from worlds that were not reset: {gained[~cleared]}")
    return ""
