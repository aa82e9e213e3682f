"""Checks of reported contacts: at rest, forces add up to the weight and moments to the centre of mass."""

from __future__ import annotations

from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...robots.anatomy.body_plan import body_plan
from ...terrains.base import Box, Terrain
from ..base import TRAINING_PHYSICS, BackendError, PhysicsOptions
from .bench import FLAT, WORLDS, Bench, Worlds, expect, expect_close
from .check import check
from .reference import GRAVITY, Reference, angle_between, axis_angle, composed, level_stance, rotated


def stand_still(
    bench: Bench,
    worlds: Worlds,
    *,
    seconds: float = 0.5,
    ground: ArrayLike = 0.0,
    xy: ArrayLike = (0.0, 0.0),
    turn: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    **reset: Any,
) -> SimpleNamespace:
    """Put robots on their feet, let them come to rest and read the state.

    Args:
        worlds: worlds with ``Bench.stiff()`` joints.
        seconds: time to come to rest [s].
        ground: height of the ground at ``xy`` [m], (N,).
        xy: place below each robot, along the robot's own vertical [m], (N, 2).
        turn: turn of the whole, level robot, quaternions (N, 4); None for another heading in each world.
        mask: worlds to reset, (N,) bool; None for all.
    """
    stance = level_stance(Reference(bench.robot, worlds.backend.scene.parameters))
    if turn is None:
        turn = [axis_angle((0.0, 0.0, 1.0), angle) for angle in np.linspace(0.0, 2.5, worlds.count)]
    below = np.c_[np.broadcast_to(xy, (worlds.count, 2)), np.broadcast_to(ground, (worlds.count,))]
    worlds.reset(
        mask,
        base_position=below + [rotated(each, (0.0, 0.0, stance.height)) for each in np.asarray(turn)],
        base_quaternion=np.array([composed(each, stance.quaternion) for each in np.asarray(turn)]),
        held_target=worlds.default_pose,
        **reset,
    )
    worlds.run(seconds)
    return worlds.read()


def pressure_point(state: SimpleNamespace) -> np.ndarray:
    """Return the point of attack of the ground force at the height of the contact centre, (N, 2) [m], from force and moment."""
    force, moment, center = state.ground_force_w, state.ground_moment_w, state.contact_center_w
    return center[:, :2] + np.stack([-moment[:, 1], moment[:, 0]], axis=1) / force[:, 2:3]


def centers_of_mass(
    bench: Bench, worlds: Worlds, state: SimpleNamespace, changes: list[dict[str, Any]] | None = None
) -> np.ndarray:
    """Return the reference's centre of mass in each world's pose, (N, 3) [m]; ``changes`` as in ``Reference.change``."""
    found = []
    for row, change in enumerate(changes or [{}] * worlds.count):
        reference = Reference(bench.robot, worlds.backend.scene.parameters)
        reference.change(**change)
        reference.place(state.base_position_w[row], state.base_quaternion_w[row], state.joint_position[row])
        found.append(reference.center_of_mass)
    return np.array(found)


@check("contact/rest", "contact_forces", "plane")
def rest(bench: Bench) -> str:
    """A standing robot presses on the ground with its weight and nothing else, and stands at the height of its legs."""
    with bench.worlds(bench.stiff()) as worlds:
        state = stand_still(bench, worlds)
        reference = Reference(bench.robot, bench.stiff())
        weight = reference.mass * GRAVITY
        bound = bench.bound("contact_forces", exact=0.01, approximate=0.05) * weight
        error = expect_close("ground_force_w of a standing robot [N]", state.ground_force_w, [0, 0, weight], bound)
        expect_close("base velocity at rest [m/s]", state.base_linear_velocity_w, 0.0, 0.01)
        expect_close("joint velocity at rest [rad/s]", state.joint_velocity, 0.0, 0.05)
        feet = state.foot_position_w[..., 2]
        expect_close("height of the foot centres [m]", feet, reference.foot_radius, 0.004)
        expect(not state.overflowed.any() and not state.diverged.any(), "a standing robot overflows or diverges")
    return f"weight {weight:.2f} N to {error:.1e} N, feet sink {1e3 * (reference.foot_radius - feet.min()):.2f} mm"


@check("contact/feet", "contact_forces", "plane")
def feet(bench: Bench) -> str:
    """Foot forces, normal and tangential forces, body forces and the number of contacts fit the net ground force."""
    with bench.worlds(bench.stiff()) as worlds:
        state = stand_still(bench, worlds)
        force, weight = state.foot_contact_force_w, Reference(bench.robot, bench.stiff()).mass * GRAVITY
        bound = 0.01 * weight
        expect_close("sum of foot_contact_force_w and ground_force_w [N]", force.sum(1), state.ground_force_w, bound)
        expect_close("foot_normal_force against the vertical [N]", state.foot_normal_force, force[..., 2], bound)
        horizontal = np.linalg.norm(force[..., :2], axis=-1)
        expect_close("foot_tangential_force against the horizontal [N]", state.foot_tangential_force, horizontal, bound)
        least = force[..., 2].min()
        expect(least > 0.05 * weight, f"a foot of a standing robot carries {least:.3g} N")
        expect_close("body_contact_force_w of a robot on its feet [N]", state.body_contact_force_w, 0.0, 1e-3)
        expect_close("trunk_contact_force_w of a robot on its feet [N]", state.trunk_contact_force_w, 0.0, 1e-3)
        expect_close("contact_count on four spheres", state.contact_count, len(bench.robot.foot_names), 0)
    return f"{least:.1f} to {force[..., 2].max():.1f} N a foot"


@check("contact/moment", "contact_forces", "plane")
def moment(bench: Bench) -> str:
    """The ground moment is about the mean contact point; at rest its pressure is below the centre of mass."""
    with bench.worlds(bench.stiff()) as worlds:
        state = stand_still(bench, worlds, xy=[[0.0, 0.0], [0.8, 0.0], [0.0, -0.7], [1.0, 1.0]])
        points = state.foot_position_w - [0.0, 0.0, Reference(bench.robot, bench.stiff()).foot_radius]
        expect_close("contact_center_w [m]", state.contact_center_w, points.mean(1), 0.005)
        expected = np.cross(points - state.contact_center_w[:, None, :], state.foot_contact_force_w).sum(1)
        # rolling and torsional friction of six-dimensional contacts add moments of their own
        expect_close("ground_moment_w against the feet's forces [N·m]", state.ground_moment_w, expected, 1.0)
        found, below = pressure_point(state), centers_of_mass(bench, worlds, state)[:, :2]
        error = expect_close("pressure point against the centre of mass [m]", found, below, 0.004)
    return f"pressure point below the centre of mass to {1e3 * error:.2f} mm"


@check("contact/bodies", "contact_forces", "plane")
def bodies(bench: Bench) -> str:
    """On its back, a robot's body and foot forces add up to the ground force, its weight; the base carries some."""
    with bench.worlds(bench.stiff()) as worlds:
        yaws, back = np.linspace(0, 2, worlds.count), [0.0, 1.0, 0.0, 0.0]
        turned = np.array([composed(axis_angle((0, 0, 1), yaw), back) for yaw in yaws])
        lay_on_back(bench, worlds, base_quaternion=turned, held_target=worlds.default_pose)
        worlds.run(0.8)
        state = worlds.read()
        weight = Reference(bench.robot, bench.stiff()).mass * GRAVITY
        total, force = state.body_contact_force_w.sum(1) + state.foot_contact_force_w.sum(1), state.ground_force_w
        expect_close("sum of body and foot forces against ground_force_w [N]", total, force, 0.01 * weight)
        expect_close("ground_force_w of a robot on its back [N]", force, [0, 0, weight], 0.03 * weight)
        expect_close("foot_contact_force_w of feet in the air [N]", state.foot_contact_force_w, 0.0, 1e-3)
        base = bench.robot.collision_bodies.index(bench.robot.base_body)
        share = state.body_contact_force_w[:, base, 2] / weight
        expect(share > 0.1, f"the base of a robot on its back carries only {share.min():.0%} of the weight")
        expect_close("turn of a robot on its back [rad]", angle_between(state.base_quaternion_w, turned), 0.0, 0.4)
    return f"the base carries {share.min():.0%} to {share.max():.0%}"


@check("contact/trunk", "contact_forces", "plane", "boxes", "per_world_terrain")
def trunk(bench: Bench) -> str:
    """On its trunk on a pillar the base carries by the trunk alone; on its back the trunk carries a part, on its nose nothing."""
    reference = Reference(bench.robot, bench.stiff())
    pillar, height = trunk_pillar(reference)
    base = bench.robot.collision_bodies.index(bench.robot.base_body)
    with bench.worlds(bench.stiff(), terrains=(FLAT, pillar), terrain_index=(1, 1, 1, 1)) as worlds:
        worlds.reset(base_position=(0.0, 0.0, height), held_target=worlds.default_pose)
        worlds.run(0.3)
        state = worlds.read()
        weight, force = reference.mass * GRAVITY, state.trunk_contact_force_w
        expect_close("trunk_contact_force_w of a trunk on a pillar [N]", force, [0, 0, weight], 0.03 * weight)
        whole = state.body_contact_force_w[:, base]
        expect_close("body_contact_force_w of a base on its trunk [N]", whole, force, 1e-3)
        carried = force[:, 2].min()

        lay_on_back(bench, worlds, held_target=worlds.default_pose, terrain_index=np.zeros(worlds.count))
        worlds.run(0.3)
        state = worlds.read()
        whole, part = state.body_contact_force_w[:, base, 2], state.trunk_contact_force_w[:, 2]
        expect(part <= whole + 1e-3, "the trunk carries more than the whole base")
        model = reference.model
        meets = (model.geom_contype | model.geom_conaffinity) != 0
        own = np.flatnonzero(meets & (model.geom_bodyid == model.body(bench.robot.base_body).id))
        if {model.geom(int(geom)).name for geom in own} <= set(bench.robot.trunk_shapes):
            expect_close("trunk_contact_force_w of a base that is all trunk [N]", part, whole, 1e-3)
            return f"{carried:.0f} N on the pillar; the base is all trunk"
        nose_down = axis_angle((0, 1, 0), np.pi / 2)
        position = (0.0, 0.0, clear_height(reference, nose_down))
        worlds.reset(base_position=position, base_quaternion=nose_down, held_target=worlds.default_pose)
        worlds.run(0.06)
        state = worlds.read()
        head = np.linalg.norm(state.body_contact_force_w[:, base], axis=1)
        expect(head > 1.0, f"the base of a robot on its nose carries only {head.min():.3g} N")
        expect_close("trunk_contact_force_w of a robot on its nose [N]", state.trunk_contact_force_w, 0.0, 1e-3)
    return f"{carried:.0f} N on the pillar, {part.min():.0f} N of {whole.min():.0f} N on the back, none on the nose"


@check("contact/training", "contact_forces", "plane")
def training(bench: Bench) -> str:
    """In the physics of training a robot that lands and trots feels the foot forces of a solver that has converged."""
    try:
        return hold_to_converged(bench, TRAINING_PHYSICS)
    except BackendError as refusal:
        return f"refused: {refusal}"  # the check is void for an engine that cannot train in this physics


def hold_to_converged(bench: Bench, physics: PhysicsOptions) -> str:
    """Compare foot forces of robots that land and trot with those of MuJoCo's solver after up to 200 iterations.

    Raises:
        ConformanceError: the 99 % quantile of the forces is off by more than 10 %, or the 99.9 % quantile by more than 20 %.
    """
    changes = {f.name: getattr(physics, f.name) for f in fields(PhysicsOptions)}
    changes |= {"torque_limits": False, "torque_speed_limit": False}
    count, steps = 4, round(1.5 / physics.timestep)
    parameters, pose = bench.soft(), np.asarray(bench.robot.default_joint_position)
    plan, legs = body_plan(bench.robot), np.zeros(len(pose))
    for joints, foot in zip(plan.legs, plan.foot_position, strict=True):
        for joint in joints:  # legs that are diagonal to each other swing together
            legs[joint] = np.sign(foot[0] * foot[1]) * {"hip": 0.1, "thigh": -0.35, "calf": 0.5}[plan.part(joint)]
    phase = 2.0 * np.pi * 2.5 * physics.timestep * np.arange(steps)[:, None] + 0.7 * np.arange(count)
    targets = pose + np.sin(phase)[..., None] * legs
    speed = np.c_[np.linspace(-1.0, 1.0, count), np.zeros((count, 2))]
    start = (0.0, 0.0, bench.robot.stand_height)
    expected = []
    for row in range(count):
        reference = Reference(bench.robot, parameters, timestep=physics.timestep, ground=physics)
        reference.place(start, base_linear_velocity=speed[row])
        for target in targets[:, row]:
            reference.step(target)
            expected.append(reference.foot_force)
    found = []
    with bench.worlds(parameters, **changes) as worlds:
        worlds.reset(base_position=start, base_linear_velocity=speed)
        for target in targets:
            worlds.step(target, substeps=1)
            found.append(np.linalg.norm(worlds.read().foot_contact_force_w, axis=-1))
    said = []
    for share, allowed in ((0.99, 0.1), (0.999, 0.2)):
        wanted, force = np.quantile(expected, share), np.quantile(found, share)
        expect_close(f"foot force that {share:.1%} stay below [N]", force, wanted, allowed * wanted)
        said.append(f"{share:.1%} of the foot forces below {force:.0f} N ({wanted:.0f} N)")
    return ", ".join(said)


@check("contact/torsion", "foot_condim_6", "plane")
def torsion(bench: Bench) -> str:
    """Spinning on one foot below its centre of mass, a robot slows down as the reference does, by torsional friction (dimension 4)."""
    parameters, seconds = bench.stiff(), 0.1
    reference, feet = Reference(bench.robot, parameters), len(bench.robot.foot_names)
    starts = [spun(reference, foot=row % feet, rate=3.0 * (-1.0) ** row) for row in range(WORLDS)]
    reset = {name: [start[name] for start in starts] for name in starts[0]}
    found, expected = {}, {}
    for condim in (3, 4):
        physics = bench.physics(foot_condim=condim)
        with bench.worlds(parameters, foot_condim=condim) as worlds:
            worlds.reset(**reset, held_target=worlds.default_pose)
            worlds.run(seconds)
            found[condim] = yaw_rate(worlds.read())
        expected[condim] = np.array([spun_down(bench, physics, start, seconds)[0] for start in starts])
    slowed = np.abs(expected[3] - expected[4])
    what = f"yaw rate after {seconds} s on a foot of dimension {{}} [rad/s]"
    error = max(
        expect_close(what.format(condim), rate, expected[condim], 0.02 * slowed + 0.001)
        for condim, rate in found.items()
    )
    return f"torsional friction takes {slowed.min():.3f} to {slowed.max():.3f} of 3 rad/s, to {error:.1e} rad/s"


@check("contact/foot_change", "foot_contact", "foot_condim_6", "plane")
def foot_change(bench: Bench) -> str:
    """Spinning on one foot, each world slows down and sinks in by its own torsional friction and softness, as the reference does."""
    parameters, seconds, physics = bench.stiff(), 0.1, bench.physics(foot_condim=4)
    changes = [{"foot_torsion": 0.25 * row, "foot_softness": 1.0 + 0.5 * row} for row in range(WORLDS)]
    start = spun(Reference(bench.robot, parameters), foot=0, rate=3.0)
    rate, height = np.array([spun_down(bench, physics, start, seconds, **change) for change in changes]).T
    with bench.worlds(parameters, foot_condim=4) as worlds:
        worlds.randomize(**{name: np.array([change[name] for change in changes]) for name in changes[0]})
        worlds.reset(**{name: [value] * WORLDS for name, value in start.items()}, held_target=worlds.default_pose)
        worlds.run(seconds)
        found = worlds.read()
    slowed, sunk = np.ptp(rate), np.ptp(height)
    error = expect_close(f"yaw rate after {seconds} s on a foot [rad/s]", yaw_rate(found), rate, 0.02 * slowed + 0.001)
    expect_close("height of the base on a foot [m]", found.base_position_w[:, 2], height, 0.02 * sunk + 1e-5)
    return f"rates differ by {slowed:.3f} rad/s and heights by {1e3 * sunk:.1f} mm between worlds, to {error:.1e} rad/s"


def spun(reference: Reference, *, foot: int, rate: float) -> dict[str, np.ndarray]:
    """Return a reset of the robot in its default pose, its centre of mass above one foot on the ground, spinning at ``rate`` [rad/s]."""
    reference.place((0.0, 0.0, 0.0))
    to_foot = reference.foot_position[foot]
    upwards = reference.center_of_mass - to_foot
    axis = np.cross(upwards, [0.0, 0.0, 1.0])
    turn = axis_angle(axis, float(np.arctan2(np.linalg.norm(axis), upwards[2])))
    arm, spin = -rotated(turn, to_foot), np.array([0.0, 0.0, rate])
    return {
        "base_position": arm + np.array([0.0, 0.0, reference.foot_radius]),
        "base_quaternion": turn,
        "base_linear_velocity": np.cross(spin, arm),
        "base_angular_velocity": rotated(turn * [1.0, -1.0, -1.0, -1.0], spin),
    }


def spun_down(
    bench: Bench, physics: PhysicsOptions, start: dict[str, np.ndarray], seconds: float, **change: float
) -> tuple[float, float]:
    """Return yaw rate [rad/s] and base height [m] of the reference, changed as ``Reference.change`` does, after a start of ``spun``."""
    reference = Reference(bench.robot, bench.stiff(), timestep=physics.timestep, ground=physics)
    reference.change(**change)
    reference.place(**start)
    reference.step(bench.robot.default_joint_position, substeps=round(seconds / physics.timestep))
    return rotated(reference.base_quaternion, reference.base_angular_velocity)[2], reference.base_position[2]


def yaw_rate(state: SimpleNamespace) -> np.ndarray:
    """Return the angular velocity about the vertical [rad/s], (N,)."""
    pairs = zip(state.base_quaternion_w, state.base_angular_velocity_b, strict=True)
    return np.array([rotated(turn, rate)[2] for turn, rate in pairs])


def trunk_pillar(reference: Reference) -> tuple[Terrain, float]:
    """Return a pillar for the trunk's lowest shape, so high that nothing else touches, and the base's height just above it [m]."""
    ground = clear_height(reference, (1.0, 0.0, 0.0, 0.0), clearance=0.0)  # places the base at the origin
    model, data = reference.model, reference.data
    lowest, below = np.inf, (np.zeros(3), np.zeros(3))
    for name in reference.robot.trunk_shapes:
        geom = model.geom(name).id
        turn, (center, half) = data.geom_xmat[geom].reshape(3, 3), np.split(model.geom_aabb[geom], 2)
        center, half = data.geom_xpos[geom] + turn @ center, np.abs(turn) @ half
        if center[2] - half[2] < lowest - 1e-6:
            lowest, below = float(center[2] - half[2]), (center, half)
    center, half = below
    box = Box(
        center=(float(center[0]), float(center[1]), 0.5 * ground),
        half_size=(0.8 * float(half[0]), 0.8 * float(half[1]), 0.5 * ground),
    )
    return Terrain(name="conformance_pillar", family="boxes", boxes=(box,)), ground - lowest + 0.001


def lay_on_back(bench: Bench, worlds: Worlds, *, clearance: float = 0.001, **reset: Any) -> None:
    """Reset robots in their default pose on their backs, ``clearance`` above the ground [m]; ``reset`` as in ``Worlds.reset``."""
    back = (0.0, 1.0, 0.0, 0.0)
    height = clear_height(Reference(bench.robot, worlds.backend.scene.parameters), back, clearance=clearance)
    worlds.reset(**{"base_position": (0.0, 0.0, height), "base_quaternion": back, **reset})


def clear_height(reference: Reference, base_quaternion: ArrayLike, *, clearance: float = 0.001) -> float:
    """Return the height of the base origin at which a turned robot in its default pose just clears the ground [m]."""
    reference.place((0.0, 0.0, 0.0), base_quaternion)
    model, data = reference.model, reference.data
    depth = 0.0
    for geom in range(model.ngeom):
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            up = data.geom_xmat[geom].reshape(3, 3)[2]
            depth = max(depth, float(-data.geom_xpos[geom, 2] - up @ center + np.abs(up) @ half))
    return depth + clearance
