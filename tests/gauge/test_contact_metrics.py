"""The two contact metrics in MuJoCo, against physics worked out apart."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.backends import Randomization, ResetState, Scene, make_backend
from gaitgauge.backends.mujoco.model import build_models
from gaitgauge.gauge.metrics import (
    fill_flight,
    friction_margin,
    quality,
    zmp_margin,
)
from gaitgauge.robots import JointParameters, Robot
from gaitgauge.robots.anatomy.body_plan import stance_span
from gaitgauge.terrains.base import Box, Terrain
from metric_states import OWN, SPAN, evaluate, evaluator, rows, scalar, turned
from scripted_gauge import GO2

FLAT = Terrain(name="flat", family="flat")


PLAIN = replace(OWN.physics, torque_speed_limit=False)
"""Motors that MuJoCo's own actuators can mirror."""


def scene(robot=GO2, terrain=FLAT, *, parameters=None, physics=PLAIN):
    return Scene(
        robot=robot,
        parameters=parameters or robot.parameters["gauge"],
        terrains=(terrain,),
        terrain_index=(0,),
        physics=physics,
    )


@pytest.fixture(scope="module")
def bench():
    backend = make_backend("mujoco", scene())
    yield backend
    backend.close()


def put(backend, height, *, quaternion=None, joint_velocity=None, **motion):
    """Reset the one world of a backend at a height above the origin, in the default pose, holding it."""
    pose = rows(*backend.scene.robot.default_joint_position)
    quaternion = rows(1, 0, 0, 0) if quaternion is None else quaternion
    backend.reset(
        ResetState(
            base_position=rows(0, 0, height),
            base_quaternion=quaternion,
            held_target=pose,
            joint_velocity=joint_velocity,
            **motion,
        )
    )
    return pose


def mirror(model, state):
    """The same instant in MuJoCo alone."""
    data = mujoco.MjData(model)
    data.qpos[:] = torch.cat((state.base_position_w, state.base_quaternion_w, state.joint_position), dim=1)[0].numpy()
    data.qvel[:] = torch.cat(
        (state.base_linear_velocity_w, state.base_angular_velocity_b, state.joint_velocity), dim=1
    )[0].numpy()
    return data


def test_the_stance_span_is_that_of_the_default_pose():
    assert stance_span(GO2) == pytest.approx(SPAN, abs=2e-4)


def test_a_standing_robot_has_its_zmp_under_its_centre_of_mass(bench):
    pose = put(bench, 0.33)
    for _ in range(100):
        bench.step(pose)
    state = bench.state
    data = mirror(build_models(bench.scene)[0], state)
    mujoco.mj_forward(build_models(bench.scene)[0], data)
    centre_of_mass = data.subtree_com[0, :2]
    feet = state.foot_position_w[0, :, :2].mean(0).numpy()
    assert state.contact_center_w[0, :2].numpy() == pytest.approx(feet, abs=3e-3)
    values = evaluate(OWN, state)
    assert values["zmp_margin"] == pytest.approx(1 - np.linalg.norm(centre_of_mass - feet) / SPAN, abs=0.01)
    assert values["zmp_margin"] > 0.93
    # the feet press outwards: they use up some of their friction though nothing pulls at the robot
    assert 0.2 < values["friction_margin"] < 0.95
    assert values["dof_power"] > 0.99
    assert values["orientation_stability"] > 0.99
    assert values["lin_vel_err"] > 0.99


def body_sum(model, data, origin):
    """The paper's sums over all bodies: F = Σ m (g - p̈) and M = Σ p x m (g - p̈) - (I ω̇ + ω x I ω), about an origin."""
    mujoco.mj_rnePostConstraint(model, data)
    force, moment = np.zeros(3), np.zeros(3)
    acceleration, velocity = np.zeros(6), np.zeros(6)
    for body in range(1, model.nbody):
        mass = model.body_mass[body]
        mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, body, acceleration, 0)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        if mass == 0.0:
            continue
        axes = data.ximat[body].reshape(3, 3)
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
        spin, spin_rate = velocity[:3], acceleration[:3]
        pull = -mass * acceleration[3:]  # MuJoCo's acceleration has that of free fall in it
        force += pull
        moment += np.cross(data.xipos[body] - origin, pull) - (inertia @ spin_rate + np.cross(spin, inertia @ spin))
    return force, moment


def test_the_contact_wrench_is_that_of_all_bodies(bench):
    """A robot that drops, stumbles and flails: at every instant with contact both ways give the same ZMP."""
    model = build_models(bench.scene)[0]
    generator = torch.Generator().manual_seed(4)
    pose = put(
        bench,
        0.36,
        quaternion=turned(roll=8.0, pitch=-6.0),
        base_linear_velocity=rows(0.8, -0.4, -0.5),
        base_angular_velocity=rows(0.5, -1.0, 0.8),
    )
    compared, margins = 0, []
    for step in range(400):
        if step % 10 == 0:
            target = pose + 0.5 * (2 * torch.rand(1, 12, generator=generator, dtype=torch.float64) - 1)
        state = bench.state
        data = mirror(model, state)
        data.ctrl[:] = target[0].numpy()
        bench.step(target, substeps=1)
        state = bench.state
        if step % 7 or int(state.contact_count[0]) == 0:
            continue
        data.qacc_warmstart[:] = 0.0
        mujoco.mj_forward(model, data)
        force, moment = body_sum(model, data, state.contact_center_w[0].numpy())
        scale = max(1.0, float(np.linalg.norm(force)))
        assert -state.ground_force_w[0].numpy() == pytest.approx(force, abs=2e-4 * scale)
        assert -state.ground_moment_w[0].numpy() == pytest.approx(moment, abs=2e-4 * scale)
        paper = np.array([-moment[1], moment[0]]) / force[2]
        expected = max(0.0, 1 - np.linalg.norm(paper) / SPAN)
        mine = zmp_margin(state.ground_moment_w, state.ground_force_w, SPAN).item()
        if abs(force[2]) > 0.05 * 9.81 * 15.2:
            assert mine == pytest.approx(expected, abs=1e-3)
            margins.append(mine)
        compared += 1
    assert compared > 25
    assert max(margins) - min(margins) > 0.1


def test_a_robot_in_flight_has_no_contact_metrics(bench):
    pose = put(bench, 3.0)
    for _ in range(3):
        bench.step(pose)
    left_out = replace(OWN, metrics=replace(OWN.metrics, flight="left-out"))
    values, counted = evaluate(left_out, bench.state), evaluate(OWN, bench.state)
    assert math.isnan(values["zmp_margin"]) and math.isnan(counted["zmp_margin"])
    assert math.isnan(values["friction_margin"]) and math.isnan(counted["friction_margin"])
    weights = OWN.metrics.weights
    rest = {n: v for n, v in values.items() if n in weights and not math.isnan(v)}
    product = sum(weights[n] * math.log(min(v, 1.0)) for n, v in rest.items())
    assert values["quality"] == pytest.approx(math.exp(product / sum(weights[n] for n in rest)))
    # nothing but flight: two metrics are zero, of which 1e-9 is left in the product
    assert counted["quality"] == pytest.approx(math.exp((product + 2 * math.log(1e-9)) / sum(weights.values())))


def test_flight_neither_raises_nor_lowers_what_contacts_say():
    """Four instants, the second and the fourth in flight; the fourth does not count, nor what it would define."""
    nan = math.nan
    values = torch.tensor([[0.9, 0.4], [0.9, nan], [0.9, 0.6], [0.9, 0.1]])
    filled = fill_flight(values, torch.tensor([True, True, True, False]))
    assert filled[:, 1].tolist() == pytest.approx([0.4, 0.5, 0.6, 0.1])
    assert torch.equal(filled[:, 0], values[:, 0])
    assert fill_flight(values[1:2], torch.tensor([True]))[0, 1] == 0.0
    # the quality of flight is that of a sample whose contacts are as usual: it was .9, above all others
    weights = torch.ones(2)
    flying, usual = quality(filled[1:2], weights), quality(torch.tensor([[0.9, 0.5]]), weights)
    assert flying == pytest.approx(usual) and quality(values[1:2], weights) > 1.3 * flying


def test_segments_stand_in_for_themselves_alone_in_flight():
    metrics = evaluator(OWN)
    values = torch.full((4, 9), 0.5)
    values[1, 6:8] = values[3, 6:8] = math.nan
    values[2, 6:8] = 0.9
    together = metrics.with_quality(values, torch.ones(4, dtype=torch.bool), [2, 2])
    apart = [metrics.with_quality(v, torch.ones(2, dtype=torch.bool), [2]) for v in values.split(2)]
    assert torch.equal(together[:, -1], torch.cat(apart)[:, -1])
    assert together[1, -1] == pytest.approx(0.5) and together[3, -1] > 0.55
    assert together[1, 6:8].isnan().all()


BLOCK = """
<mujoco>
  <worldbody>
    <body name="block">
      <freejoint/>
      <inertial pos="0 0 0" mass="5" diaginertia="0.05 0.05 0.05"/>
      <geom name="A" type="sphere" size="0.02" pos="0.2 0.15 -0.03"/> <site name="A" pos="0.2 0.15 -0.03"/>
      <geom name="B" type="sphere" size="0.02" pos="0.2 -0.15 -0.03"/> <site name="B" pos="0.2 -0.15 -0.03"/>
      <geom name="C" type="sphere" size="0.02" pos="-0.2 0.15 -0.03"/> <site name="C" pos="-0.2 0.15 -0.03"/>
      <geom name="D" type="sphere" size="0.02" pos="-0.2 -0.15 -0.03"/> <site name="D" pos="-0.2 -0.15 -0.03"/>
      <body name="needle">
        <joint name="hinge" axis="0 0 1" range="-1 1"/>
        <inertial pos="0 0 0" mass="0.001" diaginertia="1e-4 1e-4 1e-4"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    file = tmp_path_factory.mktemp("block") / "block.xml"
    file.write_text(BLOCK)
    constants = JointParameters(
        stiffness=(1.0,),
        damping=(0.1,),
        torque_limit=(1.0,),
        armature=(0.01,),
        joint_damping=(0.1,),
        friction_loss=(0.0,),
    )
    return Robot(
        name="block",
        title="Block on four points",
        mjcf=file,
        joint_names=("hinge",),
        default_joint_position=(0.0,),
        base_body="block",
        foot_names=("A", "B", "C", "D"),
        collision_bodies=("block",),
        trunk_shapes=("A",),
        imu_site="A",
        stand_height=0.05,
        default_parameters="gauge",
        parameters={"gauge": constants},
        command_limits=(1.0, 1.0, 1.0),
    )


@pytest.mark.parametrize(("angle", "friction"), [(0.0, 0.5), (10.0, 0.6), (20.0, 0.6), (20.0, 1.0), (25.0, 0.2)])
def test_a_block_on_an_incline_has_the_margin_of_the_textbook(block, angle, friction):
    """At rest 1 - tan(angle)/μ, measured along each contact's own normal; nothing is left once it slides."""
    radians = math.radians(angle)
    up = np.array([-math.sin(radians), 0.0, math.cos(radians)])
    tilt = (math.cos(radians / 2), 0.0, -math.sin(radians / 2), 0.0)
    lift = np.array([0.0, 0.0, 4.0])  # high above the floor, which would carry the block otherwise
    ramp = Box(center=tuple(-0.5 * up + lift), half_size=(3.0, 3.0, 0.5), quaternion=tilt)
    terrain = Terrain(name="ramp", family="slope", boxes=(ramp,))
    backend = make_backend("mujoco", scene(block, terrain))
    backend.randomize(Randomization(friction=scalar(friction)))
    backend.reset(
        ResetState(
            base_position=rows(*(0.05 * up + lift)),
            base_quaternion=rows(*tilt),
            held_target=torch.zeros(1, 1, dtype=torch.float64),
        )
    )
    for _ in range(25):
        backend.step(torch.zeros(1, 1, dtype=torch.float64))
    state = backend.state
    margin = friction_margin(state.foot_normal_force, state.foot_tangential_force, scalar(friction)).item()
    assert margin == pytest.approx(max(0.0, 1 - math.tan(radians) / friction), abs=0.01)
    if margin > 0.02:  # a sliding block rattles
        normal = state.foot_normal_force.sum().item()
        assert normal == pytest.approx(5.001 * 9.81 * math.cos(radians), rel=0.01)
    backend.close()
