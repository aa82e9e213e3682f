"""Checks of feet with soles, on a small robot of two legs: four spheres under the left foot, a box under the right one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...robots.base import JointParameters, Robot
from ..base import Support
from . import kinematics
from .bench import Bench, expect, expect_close
from .check import check
from .contact import centers_of_mass, pressure_point
from .friction import HEADING_X
from .reference import GRAVITY, Reference, axis_angle

HEIGHT = 0.06 + 0.25 * (np.cos(0.3) + np.cos(0.3))
"""Height of the base with both soles flat on the ground [m]."""
_JOINTS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle"))


def two_soles() -> Robot:
    """Return the robot with soles."""
    ones = (1.0,) * len(_JOINTS)
    motors = JointParameters(
        stiffness=tuple(200.0 * one for one in ones),
        damping=tuple(4.0 * one for one in ones),
        torque_limit=tuple(200.0 * one for one in ones),
        armature=tuple(0.02 * one for one in ones),
        joint_damping=tuple(0.0 * one for one in ones),
        friction_loss=tuple(0.0 * one for one in ones),
    )
    spheres = tuple(f"left_{end}_{side}" for end in ("heel", "toe") for side in ("inside", "outside"))
    return Robot(
        name="two_soles",
        title="Two soles",
        mjcf=Path(__file__).with_name("soles.xml"),
        joint_names=_JOINTS,
        default_joint_position=(-0.3, 0.6, -0.3) * 2,
        base_body="trunk",
        foot_names=("left", "right"),
        foot_shapes=(spheres, "right_sole"),
        collision_bodies=("trunk", "left_thigh", "left_foot", "right_thigh", "right_foot"),
        trunk_shapes=("shell",),
        stand_height=HEIGHT,
        default_parameters="gauge",
        parameters={"gauge": motors},
        command_limits=(1.0, 0.5, 1.0),
    )


def on_soles(bench: Bench) -> Bench:
    """Return the bench with the robot that has soles."""
    return replace(bench, robot=two_soles())


@check("soles/kinematics")
def centers(bench: Bench) -> str:
    """A foot's position and velocity are those of the mean of its shapes' centres."""
    return kinematics.feet(on_soles(bench))


@check("soles/standing", "contact_forces", "plane")
def standing(bench: Bench) -> str:
    """A robot stands flat on its soles, its centre of mass before both ankles; all shapes of a foot add up to its force."""
    bench = on_soles(bench)
    with bench.worlds(bench.stiff()) as worlds:
        turns = np.array([axis_angle((0.0, 0.0, 1.0), yaw) for yaw in np.linspace(0.0, 2.5, worlds.count)])
        worlds.reset(base_position=(0.0, 0.0, HEIGHT + 0.0005), base_quaternion=turns, held_target=worlds.default_pose)
        worlds.run(0.8)
        state = worlds.read()
        weight = Reference(bench.robot, bench.stiff()).mass * GRAVITY
        bound = bench.bound("contact_forces", exact=0.01, approximate=0.05) * weight
        expect_close("ground_force_w of a robot on soles [N]", state.ground_force_w, [0, 0, weight], bound)
        force = state.foot_contact_force_w
        expect_close("sum of foot_contact_force_w and ground_force_w [N]", force.sum(1), state.ground_force_w, bound)
        expect_close("force of each of two equal feet [N]", force[..., 2], 0.5 * weight, 0.1 * weight)
        expect_close("foot_normal_force against the vertical [N]", state.foot_normal_force, force[..., 2], bound)
        # shapes of one foot may press against each other sideways, which the sum of magnitudes counts
        across = np.linalg.norm(force[..., :2], axis=-1)
        expect(
            state.foot_tangential_force > across - bound, "foot_tangential_force is below the foot's horizontal force"
        )
        expect_close("body_contact_force_w of a robot on its soles [N]", state.body_contact_force_w, 0.0, 1e-3)
        expect_close("height of the feet's centres [m]", state.foot_position_w[..., 2], [0.02, 0.01], 0.004)
        expect_close("base velocity on soles [m/s]", state.base_linear_velocity_w, 0.0, 0.01)
        mass = centers_of_mass(bench, worlds, state)[:, :2]
        error = expect_close("pressure point against the centre of mass [m]", pressure_point(state), mass, 0.005)
        middle = state.foot_position_w[..., :2].mean(1)
        ahead = np.linalg.norm(mass - middle, axis=1)
        expect(ahead > 0.02, f"the centre of mass is only {ahead.min():.3f} m from the middle of the soles")
        exact = bench.capabilities["contact_forces"].support is Support.EXACT
        expect(
            state.contact_count == 8 if exact else state.contact_count >= 5,
            f"contact_count is {state.contact_count} on four spheres and a box",
        )
    return (
        f"pressure point below the centre of mass to {1e3 * error:.2f} mm, {ahead.max():.3f} m from the soles' middle"
    )


@check("soles/slip", "contact_forces", "friction", "plane")
def slip(bench: Bench) -> str:
    """A foot that slides on its sole has friction × normal force in every shape, friction differing between worlds."""
    bench, friction = on_soles(bench), np.array([0.05, 0.08, 0.1, 0.12])
    with bench.worlds(bench.stiff()) as worlds:
        worlds.randomize(friction=friction)
        worlds.reset(
            base_position=(0.0, 0.0, HEIGHT + 0.0005), base_quaternion=HEADING_X, held_target=worlds.default_pose
        )
        worlds.run(0.3)
        worlds.push(linear_velocity_w=np.tile([1.0, 0.0, 0.0], (worlds.count, 1)))
        worlds.step(substeps=10)
        tangential, normal = np.zeros((worlds.count, 2)), np.zeros((worlds.count, 2))
        for _ in range(40):
            worlds.step(substeps=1)
            state = worlds.read()
            tangential, normal = tangential + state.foot_tangential_force, normal + state.foot_normal_force
        bound = bench.bound("friction", exact=0.05, approximate=0.15)
        ratio = tangential / normal
        error = expect_close(
            "tangential over normal force of each foot", ratio, friction[:, None], bound * friction[:, None]
        )
        speed = state.foot_velocity_w[..., 0]
        expect(speed > 0.3, f"a pushed foot on a slippery floor moves at {speed.min():.2f} m/s")
    return f"force ratios to {error:.1e}"
